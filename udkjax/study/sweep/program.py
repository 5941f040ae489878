"""The program of a group: from the places of members in the sweep to what is stored of them.

A `Recipe` is the part of a plan that one program is compiled from. Its numbers are arguments of the program: those that all
members share, and those of each member. A program computes pieces of a fixed size on each device: as many members as fill the
vector units, or one, where members had better be computed one after another. The last piece is filled up with copies. So results
do not depend on how many devices there are, nor on how a sweep is cut into chunks.
"""

import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from udkjax.equations.analysis import analyse
from udkjax.integrate.assembly import Closure, State, close
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solvers import is_explicit
from udkjax.pinv import Auto, Elimination
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.units import NUMBERS
from udkjax.study.machine import CHUNKED, MEMBERS
from udkjax.study.quantities import parameter_value
from udkjax.study.sweep.plan import Group, Plan, stack_choices

T = TypeVar("T")
Outputs = dict[str, Array]
RESULT, END, STEPS = "result", "end_time", "steps"  # stored of every member
WIDTH = 8  # members: a piece has a multiple, of what the widest vector units hold
WIDE = 4096  # members of a piece where a device takes them all at once
# Times `MEMBERS` in a piece, at most: to call a program takes what ten of its members take. And pieces that a group has at least,
# before its pieces get larger: for as many devices there is something to do.
TOGETHER, MANY = 8, 16
STRAIGHT = (type(None), Auto, Elimination)  # methods by straight-line code, which vector instructions suit


class Shared(NamedTuple):
    """What all members of a group have in common: the numbers of settings, and the closed initial state, where that is one."""

    settings: Mapping[str, PyTree]
    closure: Closure | None


class Own(NamedTuple):
    """The numbers that members have of their own: of their choices by setting, of axes by name, and who they are."""

    choices: Mapping[str, PyTree]
    axes: Mapping[str, np.ndarray | Array]
    members: np.ndarray | Array


class Choices(NamedTuple):
    """The choices of an axis that occur in a group: their numbers, one behind the other, what they share, and their places."""

    axis: str
    numbers: PyTree
    static: PyTree
    places: Int[np.ndarray, "n"]


class Recipe:
    """How the members of a group are computed; `redundant`: the rows of Psi to leave out, where not those of the mechanism."""

    def __init__(self, plan: Plan, group: Group, redundant: tuple[int, ...] | None = None):
        self.plan, self.group = plan, group
        self.names = tuple(plan.derivatives)
        self.numbers = tuple(column for column in plan.columns if not column.is_choice)
        fixed: dict[str, PyTree] = {"mechanism": plan.mechanism, **plan.settings}
        fixed |= {name: number(value) for name, value in plan.settings.items() if name in NUMBERS and value is not None}
        self._own: dict[str, Choices] = {}
        for column in plan.columns:
            if column.is_choice:
                setting, places = column.setting, group.choices[column.name]
                fixed[setting] = column.choices[places[0]]
                if len(places) > 1 and jax.tree.leaves(eqx.filter(fixed[setting], eqx.is_array)):
                    arrays, static = stack_choices([column.choices[k] for k in places])
                    self._own[setting] = Choices(column.name, arrays, static, np.array(places))
        analysis = analyse(fixed["mechanism"])
        self.redundant = analysis.redundant_rows if redundant is None else redundant
        fixed["analysis"] = dataclasses.replace(analysis, redundant_rows=self.redundant)
        if "mechanism" in self._own:  # each has scales of its own
            own = self._own["mechanism"]
            column = next(column for column in plan.columns if column.name == own.axis)
            analyses = [analyse(cast(Mechanism, column.choices[k])) for k in own.places]
            found = [dataclasses.replace(one, redundant_rows=self.redundant) for one in analyses]
            self._own["analysis"] = Choices(own.axis, *stack_choices(found), own.places)
        given = {setting for setting in fixed if setting not in self._own}
        arrays, self._static = eqx.partition({setting: fixed[setting] for setting in given}, eqx.is_array)
        targets = [target for column in self.numbers for target in (("",) if callable(column.of) else column.of)]
        self.varied = "mechanism" in self._own or any(target not in NUMBERS for target in targets)
        moving = any(name not in {column.name for column in plan.columns} for name in self.names)
        self.assembled = fixed.get("state") is None
        closure = close(fixed["mechanism"], plan.ts[0]) if self.assembled and not self.varied and not moving else None
        self.shared = jax.tree.map(np.asarray, Shared(arrays, closure))
        self.in_lanes = (
            is_explicit(fixed.get("solver"))
            and isinstance(fixed.get("method"), STRAIGHT)
            and self.redundant is not None
            and fixed.get("formulation") is None
        )

    def own(self, members: Int[np.ndarray, "n"]) -> Own:
        """Return the numbers of members, (n, ...) each."""
        places = self.plan.places(members)
        choices = {}
        for setting, given in self._own.items():
            rows = np.searchsorted(given.places, places[given.axis])
            choices[setting] = jax.tree.map(lambda x, rows=rows: x[rows], given.numbers)
        return Own(choices, {column.name: column.numbers[places[column.name]] for column in self.numbers}, members)

    def mechanism(self, shared: Shared, own: Own, shift: Mapping[str, Array]) -> Mechanism:
        """Return the mechanism of one member. `shift` is added to what derivatives are taken by."""
        mechanism = self._setting("mechanism", shared, own)
        values: dict[str, np.ndarray | Array] = {}
        for column in self.numbers:
            x = own.axes[column.name] + shift.get(column.name, 0.0)
            if callable(column.of):
                mechanism, values = column.of(mechanism.with_parameters(values), x), {}
                if not isinstance(mechanism, Mechanism):
                    raise TypeError(
                        f"axis {column.name!r}: its function must return a Mechanism, not a {type(mechanism).__name__}"
                    )
            else:
                values |= {target: x for target in column.of if target not in NUMBERS}
        mechanism = mechanism.with_parameters(values) if values else mechanism
        parameters = {name: parameter_value(mechanism, name) + by for name, by in shift.items() if name not in own.axes}
        return mechanism.with_parameters(parameters) if parameters else mechanism

    def settings(self, shared: Shared, own: Own, shift: Mapping[str, Array]) -> dict[str, PyTree]:
        """Return the settings of one member, output times among them."""
        names = {*self._static, *self._own} - {"mechanism"}
        found = {name: self._setting(name, shared, own) for name in names}
        numbers = {
            target: own.axes[column.name] + shift.get(column.name, 0.0)
            for column in self.numbers
            for target in (() if callable(column.of) else column.of)
            if target in NUMBERS
        }
        ts = self.plan.ts
        if "t1" in numbers:
            fractions = (ts - ts[0]) / (ts[-1] - ts[0])
            ts = ts[0] + (numbers.pop("t1") - ts[0]) * fractions
        for gain in ("alpha", "beta"):
            if gain in numbers:
                found["stabilization"] = _with(found["stabilization"], gain, numbers.pop(gain))
        for tol in ("rank_tol", "branch_tol"):
            if tol in numbers:
                found["method"] = _with(found.get("method") or Auto(), tol, numbers.pop(tol))
        return found | numbers | {"ts": ts}

    def __call__(self, shared: Shared, own: Own, shift: Mapping[str, Array]) -> Outputs:
        """Return what is stored of one member."""
        mechanism = self.mechanism(shared, own, shift)
        closure, settings = self._closure(shared, own, mechanism), self.settings(shared, own, shift)
        method, state = settings.get("method"), settings.pop("state", None)
        start: State | Closure | None = closure if state is None else state
        solution = simulate(mechanism, settings.pop("ts"), start, throw=False, **settings)
        stored = {RESULT: solution.code.astype(jnp.int8), END: solution.time, STEPS: solution.stats["steps"].astype(jnp.int32)}
        for measure in self.plan.measures:
            stored |= measure.of(mechanism, solution, method)
        return stored

    def _closure(self, shared: Shared, own: Own, mechanism: Mechanism) -> Closure | None:
        if shared.closure is not None or not self.assembled:
            return shared.closure
        return close(mechanism, self.plan.ts[0], analysis=self._setting("analysis", shared, own))

    def _setting(self, name: str, shared: Shared, own: Own) -> PyTree:
        if name in self._own:
            return eqx.combine(own.choices[name], self._own[name].static)
        return eqx.combine(shared.settings[name], self._static[name])


def _with(choice: PyTree, name: str, value: np.ndarray | Array) -> PyTree:
    return eqx.tree_at(lambda c: getattr(c, name), choice, value, is_leaf=lambda x: x is None)


# --- compiled


class Program:
    """The compiled program of a group, on one or several devices of a kind."""

    def __init__(self, recipe: Recipe, devices: Sequence[Any]):
        self.recipe, self.devices = recipe, tuple(devices)
        self.piece = self._piece(len(recipe.group.members))
        self._lock = threading.Lock()
        self._lowered: jax.stages.Lowered | None = None
        self._compiled: tuple[jax.stages.Compiled, Shared] | None = None

    def _piece(self, members: int) -> int:
        full = -(-members // WIDTH) * WIDTH
        if self.devices[0].platform not in CHUNKED:
            return min(WIDE, full)
        if not self.recipe.in_lanes:
            return 1
        return min(MEMBERS * max(1, min(TOGETHER, members // (MEMBERS * MANY))), full)

    @property
    def lanes(self) -> int | None:
        """How many members wait for each other; None: none does."""
        return None if self.devices[0].platform in CHUNKED else self.piece

    def _compute(self, shared: Shared, own: Own) -> tuple[Outputs, Outputs]:
        """Compute what is stored of members, and its derivatives by each name along the last axis."""
        names = self.recipe.names

        def members(shift: Mapping[str, Array]) -> Outputs:
            return jax.vmap(lambda own: self.recipe(shared, own, shift))(own)

        if not names:
            return members({}), {}

        def outputs_at(shift: Array) -> tuple[Outputs, Outputs]:
            stored = members(dict(zip(names, shift, strict=True)))
            return {k: x for k, x in stored.items() if jnp.issubdtype(x.dtype, jnp.floating) and k != END}, stored

        slopes, stored = jax.jacfwd(outputs_at, has_aux=True)(jnp.zeros(len(names)))
        return stored, slopes

    def _lower(self) -> jax.stages.Lowered:
        if self._lowered is None:
            function = self._compute
            if len(self.devices) > 1:
                from jax.sharding import AxisType, Mesh, PartitionSpec

                mesh = Mesh(np.array(self.devices), ("members",), axis_types=(AxisType.Auto,))
                same, spread = PartitionSpec(), PartitionSpec("members")
                function = jax.shard_map(function, mesh=mesh, in_specs=(same, spread), out_specs=spread, check_vma=False)
            first = np.repeat(self.recipe.group.members[:1], self.piece * len(self.devices))
            self._lowered = jax.jit(function).lower(self.recipe.shared, self.recipe.own(first))
        return self._lowered

    @property
    def outputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """What is stored of one member: shapes and types."""
        with self._lock:
            stored, slopes = self._lower().out_info
        found = _outputs_by_name(self.recipe.names, stored, slopes, lambda x, _: jax.ShapeDtypeStruct(x.shape[:-1], x.dtype))
        return {k: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for k, x in found.items()}

    @property
    def compiled(self) -> tuple[jax.stages.Compiled, Shared]:
        """The executable, and the numbers that all members share, on the devices."""
        with self._lock:
            if self._compiled is None:
                executable = self._lower().compile()
                self._compiled = executable, jax.device_put(self.recipe.shared, executable.input_shardings[0][0])
        return self._compiled

    def __call__(self, members: Int[np.ndarray, "n"]) -> dict[str, np.ndarray]:
        """Compute members, in this order."""
        size, n = self.piece * len(self.devices), len(members)
        full = members[np.minimum(np.arange(-(-n // size) * size), n - 1)]
        own = self.recipe.own(full)
        compiled, shared = self.compiled
        started = [compiled(shared, jax.tree.map(lambda x, k=k: x[k : k + size], own)) for k in range(0, len(full), size)]
        parts = [jax.tree.map(np.asarray, part) for part in started]
        stored, slopes = jax.tree.map(lambda *x: np.concatenate(x)[:n], *parts)
        return _outputs_by_name(self.recipe.names, stored, slopes, lambda x, k: x[..., k])


def _outputs_by_name(
    names: Sequence[str], stored: Mapping[str, T], slopes: Mapping[str, T], entry: Callable[[T, int], T]
) -> dict[str, T]:
    """Return what is stored, and derivatives under names of their own: an `entry` of a slope for each name."""
    by_name = {f"d_{name}_d_{by}": entry(slope, k) for name, slope in slopes.items() for k, by in enumerate(names)}
    return {**stored, **by_name}


def lane_steps(steps: Int[np.ndarray, "n"], lanes: int) -> tuple[int, int]:
    """Return how many steps a chunk took, and how many it had room for: each lane waits for the slowest beside it."""
    parts = [steps[k : k + lanes] for k in range(0, len(steps), lanes)]
    return int(steps.sum()), lanes * sum(int(part.max()) for part in parts)
