"""Compute a chunk of a plan, by one compiled program for each group.

A program computes pieces of a fixed size on each device: as many members as fill the vector units, or one, where members had
better be computed one after another. The last piece is filled up with copies. So results do not depend on how many devices there
are, nor on how a sweep is cut into chunks.
"""

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from udkjax.equations.analysis import analyse
from udkjax.integrate.solution import Result
from udkjax.study.machine import CHUNKED, MEMBERS
from udkjax.study.sweep.layout import SweepError
from udkjax.study.sweep.measures import Label, guess_label
from udkjax.study.sweep.member import END, RESULT, STEPS, Outputs, Own, Recipe, Shared
from udkjax.study.sweep.plan import Chunk, Group, Plan, Variable
from udkjax.study.units import units_of

WIDTH = 8  # members: a piece has a multiple, of what the widest vector units hold
WIDE = 4096  # members of a piece where a device takes them all at once
# Times `MEMBERS` in a piece, at most: to call a program takes what ten of its members take. And pieces that a group has at least,
# before its pieces get larger: for as many devices there is something to do.
TOGETHER, MANY = 8, 16
PROGRAMS = 64  # that are kept: a program holds its plan
LABELS = {
    RESULT: Label((), "1", "how the run ended"),
    END: Label((), "s", "time that was reached"),
    STEPS: Label((), "1", "steps tried"),
}
_programs: OrderedDict[Any, "Program"] = OrderedDict()
_lock = threading.Lock()


class Program:
    """The compiled program of a group, on one or several devices of a kind."""

    def __init__(self, recipe: Recipe, devices: Sequence[Any]):
        self.recipe, self.devices = recipe, tuple(devices)
        self.piece = self._piece(len(recipe.group.members))
        self._lock = threading.Lock()
        self._lowered: Any = None
        self._compiled: Any = None

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
        """What is kept, and the derivatives of it by each name, last."""
        names = self.recipe.names

        def members(shift: Any) -> Outputs:
            return jax.vmap(lambda own: self.recipe(shared, own, shift))(own)

        if not names:
            return members({}), {}

        def shifted(shift: Any) -> tuple[Outputs, Outputs]:
            kept = members(dict(zip(names, shift, strict=True)))
            return {k: x for k, x in kept.items() if jnp.issubdtype(x.dtype, jnp.floating) and k != END}, kept

        slopes, kept = jax.jacfwd(shifted, has_aux=True)(jnp.zeros(len(names)))
        return kept, slopes

    def _lower(self) -> Any:
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
        """What is kept of one member: shapes and types."""
        with self._lock:
            kept, slopes = self._lower().out_info
        return {
            k: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for k, x in _outputs_by_name(self.recipe.names, kept, slopes).items()
        }

    @property
    def compiled(self) -> tuple[Any, Any]:
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
        joined = jax.tree.map(lambda *x: np.concatenate(x)[:n], *parts)
        return _outputs_by_name(self.recipe.names, *joined)


def _outputs_by_name(names: Sequence[str], kept: Any, slopes: Any) -> dict[str, Any]:
    """Derivatives under names of their own."""
    found = dict(kept)
    for name, slope in slopes.items():
        for k, by in enumerate(names):
            if isinstance(slope, np.ndarray):
                found[f"d_{name}_d_{by}"] = slope[..., k]
            else:
                found[f"d_{name}_d_{by}"] = jax.ShapeDtypeStruct(slope.shape[:-1], slope.dtype)
    return found


def program(plan: Plan, group: Group, redundant: tuple[int, ...] | None = None) -> Program:
    """The program of a group: made once for each process."""
    key = plan.token, group.index, redundant
    with _lock:
        if key not in _programs:
            _programs[key] = Program(Recipe(plan, group, redundant), jax.local_devices())
            while len(_programs) > PROGRAMS:
                _programs.popitem(last=False)
        _programs.move_to_end(key)
        return _programs[key]


def run(plan: Plan, chunk: Chunk) -> dict[str, np.ndarray]:
    """Compute the members of a chunk: each kept variable (members, ...), with "result". A failing member has a code, and NaN.

    Where a member's numbers made rows independent that the mechanism leaves out as redundant, it is run again without them.
    """
    group = plan.groups[chunk.group]
    mine = program(plan, group)
    found = mine(chunk.members)
    if mine.recipe.redundant and mine.recipe.varied:
        for rows, which in _other_redundant_rows(mine.recipe, chunk.members, found[RESULT]).items():
            again = program(plan, group, rows)(chunk.members[which])
            for name, values in again.items():
                found[name][which] = values
    return found


def _other_redundant_rows(recipe: Recipe, members: np.ndarray, result: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Which of those that drifted, although they were projected, have other redundant rows; by these."""
    drifted = np.flatnonzero(result == Result.drift)
    found: dict[tuple[int, ...], list[int]] = {}
    if len(drifted):
        mechanisms = _mechanisms(recipe, members[drifted])
        for k, mechanism in zip(drifted.tolist(), mechanisms, strict=True):
            rows = analyse(mechanism).redundant_rows
            if rows is not None and rows != recipe.redundant:
                found.setdefault(rows, []).append(k)
    return {rows: np.array(which) for rows, which in found.items()}


def _mechanisms(recipe: Recipe, members: np.ndarray) -> list[Any]:
    own = recipe.own(members)
    return [recipe.mechanism(recipe.shared, jax.tree.map(lambda x, k=k: x[k], own), {}) for k in range(len(members))]


def describe_group(plan: Plan, group: Group) -> dict[str, Variable]:
    """What is kept of each member of a group."""
    bodies, found = len(plan.choice(group, "mechanism").body_names), {}
    known = {name: label for measure in plan.measures for name, label in measure.variables.items()} | LABELS
    outputs = program(plan, group).outputs
    slopes = {f"d_{of}_d_{by}": (of, by) for of in outputs for by in plan.derivatives}
    for name, info in outputs.items():
        if name in slopes:
            of, by = slopes[name]
            label = Label(found[of].dims, _per(found[of].units, by, plan), f"derivative of {of} by {by}")
        else:
            label = known.get(name) or guess_label(name, info.shape, len(plan.ts), bodies)
        found[name] = Variable(label.dims, info.shape, np.dtype(info.dtype), label.units, label.long_name)
    return found


def _per(units: str, by: str, plan: Plan) -> str:
    """The unit of a derivative, where it is one."""
    below = next((column.units for column in plan.columns if column.name == by), None)
    below = units_of(plan.mechanism, by) if below is None else below
    return "" if not units or not below or "," in units else f"{units}/({below})"


@lru_cache(maxsize=8)
def variables_of(plan: Plan) -> Mapping[str, Variable]:
    """What is stored of each member: names, dimensions, units. `result`, `end_time` and `steps` are always among them.

    Where mechanisms have other bodies, the dimension "body" has all of them, and any other is as long as the longest.
    """
    found: dict[str, Variable] = {}
    for group in plan.groups:
        for name, variable in describe_group(plan, group).items():
            other = found.setdefault(name, variable)
            if len(other.shape) != len(variable.shape):
                raise SweepError([f"measure {name!r} has {other.shape} entries for some members and {variable.shape} for others"])
            longest = map(max, other.shape, variable.shape)
            shape = tuple(len(plan.bodies) if d == "body" else size for d, size in zip(variable.dims, longest, strict=True))
            found[name] = Variable(other.dims, shape, other.dtype, other.units, other.long_name)
    return found


def bytes_per_member(plan: Plan) -> int:
    """What the stored variables of one member take."""
    return sum(int(np.prod(v.shape)) * v.dtype.itemsize for v in variables_of(plan).values())
