"""The plan of a sweep, made before anything is computed: members, their groups, and chunks."""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int, PyTree

from udkjax.annotations import Numbers
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import analysis_of
from udkjax.integrate.simulate import simulate
from udkjax.requirements import require_output_times
from udkjax.scene.arguments import argument_problems
from udkjax.scene.model import Model
from udkjax.study.members import structure_of
from udkjax.study.quantities import StudyModel
from udkjax.study.sweep.axes import AxisChoice, AxisColumn, AxisValues, Dimension, SweepDesign
from udkjax.study.sweep.dimensions import STEP_SETTINGS, Settings, SweepError, check_settings, check_tangents, lay_out
from udkjax.study.sweep.measures import Measure, MeasureChoice, Reference, measures_of

SWEEP_ARGUMENTS = ("throw", "progress", "adjoint")  # arguments of `simulate` that only a sweep sets


@dataclass(frozen=True, eq=False)
class StoredVariable:
    """A variable that is stored for each member."""

    dims: tuple[str, ...]  # dimensions in addition to those of the sweep
    shape: tuple[int, ...]
    dtype: np.dtype
    units: str
    long_name: str


@dataclass(frozen=True, eq=False)
class Group:
    """Members whose choices have the same structure; they have a compiled program, which other groups may share."""

    index: int
    choices: Mapping[str, tuple[int, ...]]  # for each axis of choices, the indices of the choices in this group
    labels: Mapping[str, str]  # labels of the choices
    members: Int[np.ndarray, "n"]  # indices in the flattened grid, row-major over the dimensions


@dataclass(frozen=True, eq=False)
class Chunk:
    """Members of one group that are computed together: the unit of progress, of storage and of a task."""

    index: int  # number among all chunks
    group: int  # `Group.index`
    members: Int[np.ndarray, "n"]  # indices in the flattened grid, in the order of computation
    work: float  # expected work, relative to other chunks of its group


@dataclass(frozen=True, eq=False)
class SweepPlan:
    """The plan of a sweep, made by `make_plan`. Immutable and picklable, so that other processes can compute parts of it."""

    mechanism: StudyModel
    dimensions: tuple[Dimension, ...]
    ts: np.ndarray  # (T,) s
    settings: Settings  # arguments of `simulate` that are not axes
    measures: tuple[Measure, ...]
    derivatives: tuple[str, ...] = ()
    design: SweepDesign | None = None
    units: Mapping[str, str] = field(default_factory=dict)  # of variables of user-defined measures
    token: str = field(default_factory=lambda: uuid.uuid4().hex)  # equal in all copies, which therefore share compiled code

    def __hash__(self) -> int:
        return hash(self.token)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SweepPlan) and self.token == other.token

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values along each dimension."""
        return tuple(dimension.size for dimension in self.dimensions)

    @property
    def size(self) -> int:
        """Number of members."""
        return int(np.prod(self.shape))

    @property
    def columns(self) -> tuple[AxisColumn, ...]:
        """All axes, in order."""
        return tuple(column for dimension in self.dimensions for column in dimension.columns)

    def places(self, members: Int[np.ndarray, "n"]) -> dict[str, np.ndarray]:
        """Return the index of each member's value on each axis, by the name of the axis."""
        indices = np.unravel_index(members, self.shape)
        return {column.name: k for d, k in zip(self.dimensions, indices, strict=True) for column in d.columns}

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The groups of members, whose chosen values have the same pytree structure, and which thus share a program."""
        chosen = [column for column in self.columns if column.is_choice]
        places = self.places(np.arange(self.size))
        kinds = np.stack(
            [_number_structures(column.choices)[places[column.name]] for column in chosen] or [np.zeros(self.size, int)], axis=1
        )
        _, number = np.unique(kinds, axis=0, return_inverse=True)
        number = number.ravel()
        groups = []
        for members in sorted((np.flatnonzero(number == k) for k in range(number.max() + 1)), key=lambda m: m[0]):
            choices = {column.name: tuple(np.unique(places[column.name][members]).tolist()) for column in chosen}
            labels = {column.name: " | ".join(column.labels[k] for k in choices[column.name]) for column in chosen}
            groups.append(Group(len(groups), choices, labels, members))
        return tuple(groups)

    @cached_property
    def first_alike(self) -> tuple[int, ...]:
        """For each group, the index of the first group with the same program.

        The methods of such groups differ only in the number of a `OneOf`.
        """
        numbers = {column.name: _number_structures(column.computed) for column in self.columns if column.is_choice}

        def key(group: Group) -> tuple:
            return tuple((numbers[name][places[0]], len(places) > 1) for name, places in group.choices.items())

        keys = [key(group) for group in self.groups]
        return tuple(keys.index(key_of_group) for key_of_group in keys)

    @cached_property
    def _numbers(self) -> np.ndarray:
        number = np.empty(self.size, np.int32)
        for group in self.groups:
            number[group.members] = group.index
        return number

    def group_of(self, member: int) -> int:
        """Return the index of a member's group."""
        return int(self._numbers[member])

    def choice(self, group: Group, setting: str) -> AxisChoice:
        """Return a group's value of a setting; the first one if values differ in numbers."""
        for column in self.columns:
            if column.of == (setting,) and column.is_choice:
                return column.choices[group.choices[column.name][0]]
        return self.mechanism if setting == "mechanism" else self.settings.get(setting)

    def mechanism_of(self, group: Group) -> StudyModel:
        """Return the mechanism of a group; the first one if mechanisms differ in numbers."""
        mechanism = self.choice(group, "mechanism")
        assert isinstance(mechanism, Model)
        return mechanism

    def state_shape_of(self, group: Group) -> tuple[int, ...]:
        """Return the shape of the coordinates of a group: (bodies, 3), or (n,) of a user-defined system."""
        return self.mechanism_of(group).state_shape(self.choice(group, "state"))

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """The bodies of all mechanisms, in order of appearance."""
        return tuple(dict.fromkeys(name for group in self.groups for name in self.mechanism_of(group).body_names))


def make_plan(
    mechanism: StudyModel,
    axes: Mapping[str, AxisValues],
    ts: Numbers,
    measure: MeasureChoice = "final",
    *,
    design: SweepDesign | None = None,
    reference: Reference = None,
    derivatives: Sequence[str] = (),
    units: Mapping[str, str] = MappingProxyType({}),
    **settings: Any,
) -> SweepPlan:
    """Make the plan of a sweep; arguments as for `udkjax.sweep`.

    Raises:
        SweepError: lists every mistake.
    """
    problems = [f"{name}: a sweep has no such setting" for name in settings if name in SWEEP_ARGUMENTS]
    wrong = argument_problems(make_plan, {"mechanism": mechanism})
    if wrong:
        raise SweepError(wrong)
    alone = {name: value for name, value in settings.items() if name not in STEP_SETTINGS}
    problems += argument_problems(simulate, {"mechanism": mechanism, **alone})
    try:
        require_output_times("ts", ts)
    except (TypeError, ValueError) as error:
        problems.append(str(error))
        ts = (0.0, 1.0)
    ts = np.asarray(ts, float)
    dimensions: tuple[Dimension, ...] = ()
    try:
        dimensions = lay_out(mechanism, axes, design)
    except SweepError as error:
        problems += error.problems
    targets = {target for d in dimensions for c in d.columns if not callable(c.of) for target in c.of}
    if targets & {"alpha", "beta"} and "stabilization" not in targets:
        settings.setdefault("stabilization", Baumgarte())  # an axis of gains needs a stabilization
    if dimensions or not axes.keys() & {*STEP_SETTINGS}:  # with mistakes in axes their values are unknown
        problems += check_settings(mechanism, dimensions, settings)
    if mechanism.q0 is None and not {"state"} & {*targets, *settings}:
        problems.append("state: a ConstrainedSystem without q0 has no initial guess: give state=State(q, v)")
    problems += check_tangents(mechanism, dimensions, derivatives)
    measures: tuple[Measure, ...] = ()
    try:
        measures = measures_of(measure, reference, ts, mechanism)
    except ValueError as error:
        problems.append(str(error))
    if problems:
        raise SweepError(problems)
    stored = ts if any(measure.along for measure in measures) else ts[[0, -1]]
    return SweepPlan(mechanism, dimensions, stored, settings, measures, tuple(derivatives), design, dict(units))


def _number_structures(values: Sequence[Any]) -> np.ndarray:
    """Return, for each choice of an axis, the index of the first choice with the same structure."""
    structures = [(structure_of(value), getattr(analysis_of(value), "redundant_rows", None)) for value in values]
    return np.array([structures.index(structure) for structure in structures])


def stack_choices(choices: Sequence[PyTree]) -> tuple[PyTree, PyTree]:
    """Return the stacked numbers of choices with the same structure, and their common static part."""
    partitions = [eqx.partition(choice, eqx.is_array) for choice in choices]
    return jax.tree.map(lambda *x: np.stack([np.asarray(leaf) for leaf in x]), *(arrays for arrays, _ in partitions)), partitions[
        0
    ][1]
