"""The fingerprint of a sweep: all inputs that determine its results, as JSON; and the differences of two, as text."""

import difflib
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Solution, scene_text, versions
from udkjax.scene.elements.friction import Friction
from udkjax.scene.model import Model
from udkjax.study.sweep.axes import AxisChoice, AxisColumn
from udkjax.study.sweep.measures import Measure
from udkjax.study.sweep.plan import SweepPlan
from udkjax.wording import abbreviate

JsonValue: TypeAlias = "str | int | float | bool | Sequence[JsonValue] | Mapping[str, JsonValue] | None"
MOST_LINES = 24  # largest number of printed differences; further ones are counted
MOST_NUMBERS = 64  # largest array written in full; larger arrays by shape, first and last number, and a digest
COUNTS_OF_STEPS = ("steps", "accepted", "rejected", "implicit", "right_hand_sides", "projections")


def fingerprint(plan: SweepPlan) -> dict[str, JsonValue]:
    """Return all inputs that determine the results; plans with equal fingerprints have the same results."""
    return {
        **describe_model(plan.mechanism, math.prod(plan.state_shape_of(plan.groups[0]))),
        "axes": {dimension.name: {c.name: _axis(plan, c) for c in dimension.columns} for dimension in plan.dimensions},
        "design": repr(plan.design) if plan.design else None,
        "ts": describe_value(plan.ts),
        "settings": {name: describe_value(value) for name, value in plan.settings.items()},
        "measures": {f"{k} {measure.name}": _measure(plan, measure) for k, measure in enumerate(plan.measures, 1)},
        "derivatives": list(plan.derivatives),
        **({"loads of runs with events": "of the constraints that hold"} if "events" in plan.settings else {}),
        "versions": {name: version for name, version in versions().items() if name != "python"},
    }


def _axis(plan: SweepPlan, column: AxisColumn) -> dict[str, JsonValue]:
    of: JsonValue = None if callable(column.of) else column.of
    if callable(column.of):
        of = describe_function(column.of, plan.mechanism, np.zeros(column.numbers.shape[1:]))
    n = math.prod(plan.state_shape_of(plan.groups[0]))

    def described(x: AxisChoice) -> JsonValue:
        return describe_model(x, n) if isinstance(x, Model) else describe_value(x)

    return {
        "of": of,
        "values": [described(value) for value in column.values] if column.is_choice else describe_value(column.values),
    }


def _measure(plan: SweepPlan, measure: Measure) -> dict[str, JsonValue]:
    found: dict[str, JsonValue] = {"variables": list(measure.labels)}
    if measure.function is not None:
        found["function"] = describe_function(measure.function, plan.mechanism, _solution(plan))
    if callable(measure.reference):
        found["reference"] = describe_function(measure.reference, plan.mechanism, plan.ts)
    elif measure.reference is not None:
        found["reference"] = describe_value(measure.reference)
    return found


def _solution(plan: SweepPlan) -> Solution:
    """Return a solution with the right shapes, for tracing the functions of measures.

    With events, or friction by which joints stick, it has the fields that such a run has.
    """
    events = {name: x for name, x in plan.settings.items() if name in ("events", "max_events")}
    if events or (plan.mechanism.has_bodies and Friction.may_stick(plan.mechanism.forces.values())):
        shapes = eqx.filter_eval_shape(lambda model: simulate(model, plan.ts, throw=False, **events), plan.mechanism)
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x, shapes)
    number, states = np.zeros(()), np.zeros((len(plan.ts), *plan.state_shape_of(plan.groups[0])))
    count, model = np.zeros((), int), plan.mechanism
    stats = dict.fromkeys(COUNTS_OF_STEPS, count)
    return Solution(plan.ts, states, states, count, number, stats, number, number, model.body_names, ())  # pyright: ignore[reportArgumentType]


def describe_function(function: Callable, *arguments: PyTree) -> dict[str, JsonValue]:
    """Return a description of a function: its name, and digests of its traced operations and constants."""
    program = eqx.filter_make_jaxpr(function)(*arguments)[0]
    text = _without_addresses(str(program.jaxpr))
    constants = b"".join(np.ascontiguousarray(x).tobytes() for x in program.consts if eqx.is_array(x))
    name = getattr(function, "__qualname__", None) or repr(function)
    return {"name": name, "operations": digest(text.encode()), "constants": digest(constants)}


def describe_model(mechanism: Model, n: int) -> dict[str, JsonValue]:
    """Return a description of a model with n coordinates: its text and its numbers."""
    if not mechanism.has_bodies:
        traced = mechanism.traced(n)
        text = traced.functions.text if traced.has_programs else repr(mechanism)
        numbers = [describe_value(x) for x in getattr(traced, "numbers", jax.tree.leaves(eqx.filter(mechanism, eqx.is_array)))]
        return {
            "functions": digest(text.encode()),
            "numbers": numbers,
            "guess": [describe_value(mechanism.q0), describe_value(mechanism.v0)],
        }
    numbers = {name: describe_value(x) for name, x in mechanism.parameters().items()}
    return {"scene": scene_text(mechanism), "parameters": numbers}


def describe_value(value: PyTree) -> JsonValue:
    """Return a description of a number, an array or a choice; large arrays are described by a digest."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.ndarray | np.number | jax.Array):
        array = np.asarray(value)
        if array.size <= MOST_NUMBERS:
            return array.tolist()
        first, last = float(array.flat[0]), float(array.flat[-1])
        return {
            "shape": list(array.shape),
            "first": first,
            "last": last,
            "digest": digest(np.ascontiguousarray(array).tobytes()),
        }
    leaves = jax.tree_util.tree_leaves_with_path(value)
    return {
        "type": type(value).__name__,
        "digest": digest(_without_addresses(str(jax.tree.structure(value))).encode()),
        **{
            jax.tree_util.keystr(path).lstrip("."): describe_value(x) if eqx.is_array(x) else _without_addresses(repr(x))
            for path, x in leaves
        },
    }


def _without_addresses(text: str) -> str:
    """Return a text without memory addresses, such as those of functions, which differ between processes."""
    return re.sub(r"0x[0-9a-f]+", "", text)


def digest(content: bytes) -> str:
    """Return the first 64 bits of the SHA-256 of some bytes, as hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()[:16]


# --- differences


def differences(before: JsonValue, now: JsonValue) -> list[str]:
    """Return a line for each difference between two JSON values: the path, the old value, and the new one.

    Strings of several lines, such as scenes, are compared line by line.
    """
    old, new, lines = dict(_leaves(before)), dict(_leaves(now)), []
    for path in {**old, **new}:
        a, b = old.get(path), new.get(path)
        if path not in new:
            lines.append(f"{path}: was {abbreviate(a)}, is now missing")
        elif path not in old:
            lines.append(f"{path}: was missing, is now {abbreviate(b)}")
        elif isinstance(a, str) and isinstance(b, str) and "\n" in a + b:
            compared = list(difflib.unified_diff(a.splitlines(), b.splitlines(), lineterm="", n=0))[
                2:
            ]  # without the two lines of file names
            lines += [f"{path}: {'was' if line[0] == '-' else 'is'} {line[1:]}" for line in compared if line[0] != "@"]
        elif json.dumps(a) != json.dumps(b):  # as text, nan equals nan, and true differs from 1
            lines.append(f"{path}: was {abbreviate(a)}, is now {abbreviate(b)}")
    return lines if len(lines) <= MOST_LINES else [*lines[:MOST_LINES], f"and {len(lines) - MOST_LINES} more"]


def _leaves(value: JsonValue, path: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Iterate over the paths and values of scalars, empty lists and empty mappings in a JSON value."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from _leaves(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value:
        for k, item in enumerate(value):
            yield from _leaves(item, f"{path}[{k}]")
    else:
        yield path, value
