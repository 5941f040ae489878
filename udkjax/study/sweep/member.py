"""One member: from its place in the sweep to its mechanism, its settings and what is kept of it.

A `Recipe` is the part of a plan that one program is compiled from. Its numbers are arguments of the program: those that all
members share, and those of each member.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from udkjax.equations.analysis import analyse
from udkjax.integrate.assembly import Closure, State, close
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solvers import forward_mode
from udkjax.integrate.tableau import is_explicit
from udkjax.pinv import Auto, Elimination
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.number_fields import parameters_of, split_index
from udkjax.study.sweep.plan import Group, Plan, stacked
from udkjax.study.units import NUMBERS

Kept = dict[str, Array]
RESULT, END, STEPS = "result", "end_time", "steps"  # kept of every member
STRAIGHT = (type(None), Auto, Elimination)  # methods by straight-line code, which vector instructions suit


class Recipe:
    """How the members of a group are computed; `redundant`: the rows of Psi to leave out, where not those of the mechanism."""

    def __init__(self, plan: Plan, group: Group, redundant: tuple[int, ...] | None = None):
        self.plan, self.group = plan, group
        self.names = tuple(plan.derivatives)
        self.numbers = tuple(column for column in plan.columns if not column.chosen)
        fixed: dict[str, Any] = {"mechanism": plan.mechanism, **plan.settings}
        fixed |= {name: number(value) for name, value in plan.settings.items() if name in NUMBERS and value is not None}
        self._own: dict[str, tuple[str, Any, Any, np.ndarray]] = {}
        for column in plan.columns:
            if column.chosen:
                setting, places = column.setting, group.choices[column.name]
                fixed[setting] = column.values[places[0]]
                if len(places) > 1 and jax.tree.leaves(eqx.filter(fixed[setting], eqx.is_array)):
                    arrays, static = stacked([column.values[k] for k in places])
                    self._own[setting] = column.name, arrays, static, np.array(places)
        analysis = analyse(fixed["mechanism"])
        self.redundant = analysis.redundant_rows if redundant is None else redundant
        fixed["analysis"] = dataclasses.replace(analysis, redundant_rows=self.redundant)
        if "mechanism" in self._own:  # each has scales of its own
            name, _, _, places = self._own["mechanism"]
            column = next(column for column in plan.columns if column.name == name)
            found = [dataclasses.replace(analyse(column.values[k]), redundant_rows=self.redundant) for k in places]
            self._own["analysis"] = name, *stacked(found), places
        given = {setting for setting in fixed if setting not in self._own}
        arrays, self._static = eqx.partition({setting: fixed[setting] for setting in given}, eqx.is_array)
        targets = [target for column in self.numbers for target in (("",) if callable(column.of) else column.of)]
        self.varied = "mechanism" in self._own or any(target not in NUMBERS for target in targets)
        moving = any(name not in {column.name for column in plan.columns} for name in self.names)
        self.assembled = fixed.get("state") is None
        closure = close(fixed["mechanism"], plan.ts[0]) if self.assembled and not self.varied and not moving else None
        self.shared = jax.tree.map(np.asarray, (arrays, closure))
        self.in_lanes = (
            is_explicit(fixed.get("solver"))
            and isinstance(fixed.get("method"), STRAIGHT)
            and self.redundant is not None
            and fixed.get("formulation") is None
        )

    def own(self, members: Int[np.ndarray, "n"]) -> tuple[dict[str, Any], dict[str, Any], np.ndarray]:
        """The numbers of members: those of their choices, those of their axes, and who they are; (n, ...) each."""
        places = self.plan.places(members)
        choices = {}
        for setting, (name, arrays, _, occurring) in self._own.items():
            rows = np.searchsorted(occurring, places[name])
            choices[setting] = jax.tree.map(lambda x, rows=rows: x[rows], arrays)
        return choices, {column.name: column.values[places[column.name]] for column in self.numbers}, members

    def mechanism(self, shared: Any, own: Any, shift: Mapping[str, Array]) -> Mechanism:
        """The mechanism of one member. `shift` is added to what derivatives are taken by."""
        mechanism = self._setting("mechanism", shared, own)
        values: dict[str, Any] = {}
        for column in self.numbers:
            x = own[1][column.name] + shift.get(column.name, 0.0)
            if callable(column.of):
                mechanism, values = column.of(mechanism.with_parameters(values), x), {}
                if not isinstance(mechanism, Mechanism):
                    raise TypeError(
                        f"axis {column.name!r}: its function must return a Mechanism, not a {type(mechanism).__name__}"
                    )
            else:
                values |= {target: x for target in column.of if target not in NUMBERS}
        mechanism = mechanism.with_parameters(values) if values else mechanism
        parameters = {name: at(mechanism, name) + by for name, by in shift.items() if name not in own[1]}
        mechanism = mechanism.with_parameters(parameters) if parameters else mechanism
        return mechanism

    def settings(self, shared: Any, own: Any, shift: Mapping[str, Array]) -> dict[str, Any]:
        """The settings of one member, output times among them."""
        names = {*self._static, *self._own} - {"mechanism"}
        found = {name: self._setting(name, shared, own) for name in names}
        numbers = {
            target: own[1][column.name] + shift.get(column.name, 0.0)
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

    def __call__(self, shared: Any, own: Any, shift: Mapping[str, Array]) -> Kept:
        """What is kept of one member, and of no more."""
        mechanism = self.mechanism(shared, own, shift)
        return self._run(shared, shift, own, mechanism, self._closure(shared, own, mechanism))

    def _closure(self, shared: Any, own: Any, mechanism: Mechanism) -> Closure | None:
        if shared[1] is not None or not self.assembled:
            return shared[1]
        return close(mechanism, self.plan.ts[0], analysis=self._setting("analysis", shared, own))

    def _run(self, shared: Any, shift: Any, own: Any, mechanism: Mechanism, closure: Closure | None) -> Kept:
        settings = self.settings(shared, own, shift)
        method, state = settings.get("method"), settings.pop("state", None)
        start: State | Closure | None = closure if state is None else state
        adjoint = forward_mode() if self.names else None
        solution = simulate(mechanism, settings.pop("ts"), start, adjoint=adjoint, throw=False, **settings)
        kept = {RESULT: solution.code.astype(jnp.int8), END: solution.time, STEPS: solution.stats["steps"].astype(jnp.int32)}
        for measure in self.plan.measures:
            kept |= measure.of(mechanism, solution, method)
        return kept

    def _setting(self, name: str, shared: Any, own: Any) -> Any:
        if name in self._own:
            return eqx.combine(own[0][name], self._own[name][2])
        return eqx.combine(shared[0][name], self._static[name])


def _with(choice: Any, name: str, value: Array) -> Any:
    return eqx.tree_at(lambda c: getattr(c, name), choice, value, is_leaf=lambda x: x is None)


def at(mechanism: Mechanism, name: str) -> Array:
    """A parameter, or one entry of one, by its name."""
    known = parameters_of(mechanism)
    owner, index = split_index(name, known)
    value = known[owner].value
    assert value is not None
    return value[index]
