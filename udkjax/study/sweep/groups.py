"""The computation of the members of a group: from their indices in the sweep to their stored variables.

Members of a group differ only in numbers, which are arguments of its program: numbers shared by all members, and numbers of each.
"""

import dataclasses
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from udkjax.arrays import number
from udkjax.devices import default_devices
from udkjax.equations.rows.analysis import Analysis, analysis_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.compiled_mechanism import reason_for_plain
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solvers import has_method
from udkjax.pinv import Auto, Elimination
from udkjax.positions.assembling.assembly import Closure, State, close
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.units import NUMBERS
from udkjax.study.members import CHUNKED_PLATFORMS, MOST_PROGRAMS, PIECE_MEMBERS, Outputs, Program
from udkjax.study.quantities import StudyModel, parameter_value
from udkjax.study.sweep.dimensions import NUMBERS_OF, refuse_untraceable, uses_number
from udkjax.study.sweep.measures import SECONDS
from udkjax.study.sweep.plan import SweepPlan, stack_choices
from udkjax.wording import quote

RESULT, END, STEPS = "result", "end_time", "steps"  # variables stored for every member
LANE_WIDTH = 8  # number of members in the widest vector unit; the size of a piece is a multiple of it
# Number of members of a piece on devices that compute a batch at once, and bytes of all their states and slopes: a graphics card
# computes over four times as many members a second in batches of 65,536 as in batches of 4,096.
DEVICE_PIECE, DEVICE_BYTES = 65_536, 2**30
LARGEST_PIECE = 8  # largest piece relative to `PIECE_MEMBERS`; since a call takes as long as ten members, larger ones save little
LEAST_PIECES = 16  # number of pieces of a group before pieces become larger, to keep all devices busy
STRAIGHT_METHODS = (type(None), Auto, Elimination)  # without branches: fast in vector lanes even without machine code


class Shared(NamedTuple):
    """Numbers that all members of a group share.

    These are the numbers of settings, and quantities that are computed from the mechanism if they are equal for all members.
    """

    settings: Mapping[str, PyTree]
    closure: Closure | None  # the closed initial state
    elements: PyTree  # numbers of the mechanism's elements, which may follow from a drawing


class Own(NamedTuple):
    """The numbers of single members: numbers of choices by setting, numbers of axes by name, and the members' indices."""

    choices: Mapping[str, PyTree]
    axes: Mapping[str, np.ndarray | Array]
    members: np.ndarray | Array


class GroupChoices(NamedTuple):
    """The choices of one setting in a group, which differ only in numbers.

    Attributes:
        axis: name of the axis of the choices.
        numbers: the numbers of the choices, stacked.
        static: the common rest of the choices.
        places: indices of the choices on the axis.
    """

    axis: str
    numbers: PyTree
    static: PyTree
    places: Int[np.ndarray, "n"]


class GroupRun:
    """The members of a group and their program, which is a function of one member.

    `redundant` are the rows of Psi to leave out, by default those of the group's mechanism.
    """

    def __init__(self, plan: SweepPlan, index: int, redundant: tuple[int, ...] | None = None):
        group = plan.groups[index]
        self.plan, self.members = plan, group.members
        self.names = tuple(plan.derivatives)
        self.seconds = tuple(name for measure in plan.measures if measure.name == SECONDS for name in measure.labels)
        self.numbers = tuple(column for column in plan.columns if not column.is_choice)
        fixed: dict[str, PyTree] = {"mechanism": plan.mechanism, **plan.settings}
        fixed |= {name: number(value) for name, value in plan.settings.items() if name in NUMBERS and value is not None}
        self._own: dict[str, GroupChoices] = {}
        for column in plan.columns:
            if column.is_choice:
                setting, places = column.setting, group.choices[column.name]
                fixed[setting] = column.computed[places[0]]
                if len(places) > 1 and jax.tree.leaves(eqx.filter(fixed[setting], eqx.is_array)):
                    arrays, static = stack_choices([column.computed[k] for k in places])
                    self._own[setting] = GroupChoices(column.name, arrays, static, np.array(places))
        analysis = analysis_of(fixed["mechanism"])
        self.redundant = redundant if redundant is not None or analysis is None else analysis.redundant_rows
        fixed["analysis"] = analysis and dataclasses.replace(analysis, redundant_rows=self.redundant)
        given = {setting for setting in fixed if setting not in self._own}
        arrays, self._static = eqx.partition({setting: fixed[setting] for setting in given}, eqx.is_array)
        targets = [target for column in self.numbers for target in (("",) if callable(column.of) else column.of)]
        self.varied = "mechanism" in self._own or any(target not in NUMBERS for target in targets)
        moving = any(name not in {column.name for column in plan.columns} for name in self.names)
        self.assembled = fixed.get("state") is None
        closure = close(fixed["mechanism"], plan.ts[0]) if self.assembled and not self.varied and not moving else None
        common = None if "mechanism" in self._own else fixed["mechanism"]
        plain = None if common is None else common.without_origin
        elements, self._elements = eqx.partition(None if plain is common else plain, eqx.is_array)
        self.shared = jax.tree.map(np.asarray, Shared(arrays, closure, elements))
        method, formulation = fixed.get("method"), fixed.get("formulation")
        is_straight = isinstance(method, STRAIGHT_METHODS) and formulation is None
        in_lanes = (
            has_method(fixed.get("solver"))
            and fixed.get("stepsize_controller") is None
            and (is_straight or not reason_for_plain(method or Auto(), formulation))
            and (self.redundant is not None or analysis is None)
        )
        self._placed: Shared | None = None
        devices = default_devices()
        states = 16 * len(plan.ts) * math.prod(plan.state_shape_of(group)) * (1 + len(self.names))  # bytes of a member
        first = plan.first_alike[index]
        self.program = (
            Program(self, len(self.names), _piece(len(self.members), in_lanes, devices[0].platform, states), devices)
            if first == index
            else _group_run(plan, first, redundant).program
        )

    def own(self, members: Int[np.ndarray, "n"]) -> Own:
        """Return the numbers of these members that are not shared with others, each (n, ...)."""
        places = self.plan.places(members)
        choices = {}
        for setting, choice in self._own.items():
            rows = np.searchsorted(choice.places, places[choice.axis])
            choices[setting] = jax.tree.map(lambda x, rows=rows: x[rows], choice.numbers)
        return Own(choices, {column.name: column.numbers[places[column.name]] for column in self.numbers}, members)

    def mechanism(self, shared: Shared, own: Own, shift: Mapping[str, Array]) -> StudyModel:
        """Return the mechanism of one member; `shift` is added to the numbers with respect to which derivatives are computed."""
        mechanism: Any = self._setting("mechanism", shared, own)
        if self._elements is not None:
            mechanism.know_elements(eqx.combine(shared.elements, self._elements))
        values: dict[str, np.ndarray | Array] = {}
        kind = Mechanism if mechanism.has_bodies else ConstrainedSystem
        for column in self.numbers:
            x = own.axes[column.name] + shift.get(column.name, 0.0)
            if callable(column.of):
                with refuse_untraceable(f"axis {quote(column.name)}"):
                    setter: Any = column.of
                    mechanism, values = setter(mechanism.with_parameters(values), x), {}
                if not isinstance(mechanism, kind):
                    found = type(mechanism).__name__
                    raise TypeError(f"axis {column.name!r}: its function must return a {kind.__name__}, not a {found}")
            else:
                values |= {target: x for target in column.of if target not in NUMBERS}
        mechanism = mechanism.with_parameters(values) if values else mechanism
        parameters = {name: parameter_value(mechanism, name) + by for name, by in shift.items() if name not in own.axes}
        return mechanism.with_parameters(parameters) if parameters else mechanism

    def settings(self, shared: Shared, own: Own, shift: Mapping[str, Array]) -> dict[str, PyTree]:
        """Return the settings of one member, including output times; for `shift` see `mechanism`."""
        names = {*self._static, *self._own} - {"mechanism"}
        values = {name: self._setting(name, shared, own) for name in names}
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
        for setting, names in NUMBERS_OF.items():
            for name in names:
                if name in numbers and uses_number(setting, choice := values.get(setting), name):
                    values[setting] = _with(Auto() if choice is None else choice, name, numbers[name])
                numbers.pop(name, None)
        return values | numbers | {"ts": ts}

    def __call__(self, shared: Shared, own: Own, shifts: Array) -> Outputs:
        """Return the stored variables of one member; for `shifts` (names,), in the order of `names`, see `mechanism`."""
        shift = dict(zip(self.names, shifts, strict=True))
        mechanism = self.mechanism(shared, own, shift)
        settings = self.settings(shared, own, shift)
        if self.varied and settings["analysis"] is not None:  # a member has scales of its own
            settings["analysis"] = settings["analysis"].with_numbers_of(mechanism)
        closure = self._closure(shared, mechanism, settings["analysis"])
        method, state = settings.get("method"), settings.pop("state", None)
        start: State | Closure | None = closure if state is None else state
        solution = simulate(mechanism, settings.pop("ts"), start, throw=False, **settings)
        stored = {RESULT: solution.code.astype(jnp.int8), END: solution.time, STEPS: solution.stats["steps"].astype(jnp.int32)}
        for measure in self.plan.measures:
            stored |= measure.of(mechanism, solution, method)
        return stored

    def compile(self) -> None:
        """Compile the program and transfer the shared numbers to the devices; done once."""
        if self._placed is None:
            self._placed = self.program.place(self.shared, self.own(self.members[:1]))

    def compute(self, members: Int[np.ndarray, "n"]) -> dict[str, np.ndarray]:
        """Return the stored variables of members, each (n, ...)."""
        self.compile()
        stored, slopes = self.program(self._placed, self.own(members))
        return stored | {name: slopes[of][..., k] for name, (of, k) in self._names_of_slopes(slopes).items()}

    @property
    def outputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes and types of the stored variables of a member."""
        stored, slopes = self.program.shapes(self.shared, self.own(self.members[:1]))
        return stored | {name: stored[of] for name, (of, _) in self._names_of_slopes(slopes).items()}

    def _names_of_slopes(self, slopes: Mapping[str, object]) -> dict[str, tuple[str, int]]:
        """Return, by the name of each derivative, its variable, and the index of the number with respect to which it is taken."""
        return {f"d_{of}_d_{by}": (of, k) for of in slopes if of not in (END, *self.seconds) for k, by in enumerate(self.names)}

    def _closure(self, shared: Shared, mechanism: StudyModel, analysis: Analysis | None) -> Closure | None:
        if shared.closure is not None or not self.assembled:
            return shared.closure
        return close(mechanism, self.plan.ts[0], analysis=analysis)

    def _setting(self, name: str, shared: Shared, own: Own) -> PyTree:
        if name in self._own:
            return eqx.combine(own.choices[name], self._own[name].static)
        return eqx.combine(shared.settings[name], self._static[name])


def _with(choice: PyTree, name: str, value: np.ndarray | Array) -> PyTree:
    return eqx.tree_at(lambda c: getattr(c, name), choice, value, is_leaf=lambda x: x is None)


def _piece(members: int, in_lanes: bool, platform: str, states: int) -> int:
    """Return the number of members in a piece on each device: several in vector lanes, or one.

    Args:
        members: number of members of the group.
        in_lanes: True if the program is fast in vector lanes.
        platform: platform of the devices.
        states: bytes of a member's states with their derivatives.
    """
    full = -(-members // LANE_WIDTH) * LANE_WIDTH
    if platform not in CHUNKED_PLATFORMS:
        return min(DEVICE_PIECE, max(LANE_WIDTH, DEVICE_BYTES // states), full)
    return min(PIECE_MEMBERS * max(1, min(LARGEST_PIECE, members // (PIECE_MEMBERS * LEAST_PIECES))), full) if in_lanes else 1


def group_run(plan: SweepPlan, group: int, redundant: tuple[int, ...] | None = None) -> GroupRun:
    """Return the `GroupRun` of a group, whose program is compiled once per process."""
    return _group_run(plan, group, redundant)


@lru_cache(maxsize=MOST_PROGRAMS)
def _group_run(plan: SweepPlan, group: int, redundant: tuple[int, ...] | None) -> GroupRun:
    return GroupRun(plan, group, redundant)  # positional arguments, since the cache distinguishes keyword arguments
