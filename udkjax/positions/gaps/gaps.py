"""`gaps`: the least gap between links over a motion, proven between samples, with derivatives, and where links touch."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.annotations import NumberLike, NumericArray
from udkjax.argument_types import BY_NAME, HISTORY, NUMBERS_BY_NAME, ArgumentRequirement, of_kind
from udkjax.arrays import is_traced, without_derivatives
from udkjax.positions.answers.counting import Count
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.following.drive import Drive, only_driver
from udkjax.positions.following.kinematics import Kinematics
from udkjax.positions.gaps.convex import signed_distance
from udkjax.positions.gaps.derivatives import differentiable_gaps
from udkjax.positions.gaps.motion import motion_of_drive, motion_of_run
from udkjax.positions.gaps.pairs import LinkPair, pairs_to_check
from udkjax.positions.gaps.search import search
from udkjax.positions.gaps.shapes import ConvexPart, parts_of
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_number, has_numbers, prints_table, units
from udkjax.requirements import ArgumentError, ArgumentTypeError, GivenArguments, array, describe, require_finite
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism

_require_layers = of_kind(
    'map links to numbers or names of layers, such as {"crank": 0}',
    lambda x: isinstance(x, Mapping) and all(isinstance(k, str) and isinstance(y, str | int | float) for k, y in x.items()),
)
_require_pairs = of_kind(
    'be pairs of names of links, such as [("crank", "rocker")]',
    lambda x: isinstance(x, Sequence) and not isinstance(x, str) and all(map(_is_pair, x)),
)


def _require_range(name: str, value: Any, given: GivenArguments) -> None:
    values = array(name, value)
    require_finite(name, value)
    if values.ndim != 1 or len(values) < 2 or (not is_traced(value) and np.ptp(np.asarray(values)) == 0):
        raise ArgumentError(f"{name} must contain at least two different values of the driver, {describe(value)}")


RANGE = ArgumentRequirement("at least two different values", _require_range)
LAYERS = ArgumentRequirement("by name", _require_layers)
PAIRS = ArgumentRequirement("pairs of names", _require_pairs)


def _is_pair(x: Any) -> bool:
    is_sequence = isinstance(x, tuple | list) or (isinstance(x, Sequence) and not isinstance(x, str))
    return is_sequence and len(x) == 2 and isinstance(x[0], str) and isinstance(x[1], str)


@prints_table
class LeastGap(NamedTuple):
    """The least gap between two links over a motion.

    Attributes:
        pair: the names of the links.
        value: the value of the driver (rad, m) or the time (s) at which the gap is least.
        distance: the gap (m); if the links overlap, minus the length of the shortest translation that separates them.
        bound: a proven lower bound of the gap (m) over the whole motion, including the intervals between samples.
        points: the closest points of the outlines in ground axes (m), the first on the first link.
        q: the pose of all bodies at which the gap is least (m, m, rad).
    """

    pair: LinkPair
    value: float
    distance: Any
    bound: float
    points: Float[NumericArray, "2 2"]
    q: Float[NumericArray, "bodies 3"]

    _units = units(distance="m", bound="m", points="m", q="m, m, rad")


@prints_table
class Touch(NamedTuple):
    """A stretch of a motion over which two links touch or overlap.

    Attributes:
        pair: the names of the links.
        begins: the value of the driver (rad, m) or the time (s) at which the links begin to touch; the first value of the motion
            if they touch from the start.
        ceases: the value at which they cease to touch; the last value of the motion if they touch to the end.
    """

    pair: LinkPair
    begins: float
    ceases: float


class LeastGaps(PrintsTable):
    """The least gaps of pairs of links over a motion.

    Attributes:
        pairs: the least gap of each pair, the smallest first.
        contacts: the stretches over which pairs touch, in the order of values.
        unit: the unit of the values: "rad", "m" or "s".
        missing: the fraction of the range that is not reached, or in which a run has failed: nothing is known there.
        count: the zero and the units in which values and lengths are shown; None: SI units.
        parts: the convex outlines between which gaps are measured, each with the name of its link, its corners in the frame of
            the link (m), and a radius around them (m).
    """

    pairs: tuple[LeastGap, ...]
    contacts: tuple[Touch, ...] = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="")
    missing: float = eqx.field(static=True, default=0.0)
    count: Count | None = eqx.field(static=True, default=None)
    parts: tuple[ConvexPart, ...] = ()

    @property
    def least(self) -> LeastGap:
        """The smallest gap of all pairs."""
        return self.pairs[0]

    def rows(self) -> list[tuple[str, str, str]]:
        """Return for each pair its links, their least gap and the value at which it is least, as texts in the drawing's units."""
        size = max(float(np.max(np.abs(np.asarray(gap.points)))) for gap in self.pairs)
        return [(" and ".join(x.pair), self._length(x.distance, size), self._value(x.value)) for x in self.pairs]

    def summary(self) -> str:
        """Return a phrase, in the drawing's units, with the smallest gap or the largest overlap and the names of its links."""
        (pair, gap, _), overlaps = self.rows()[0], float(self.least.distance) < 0
        return f"{pair} overlap by {gap.removeprefix('-')}" if overlaps else f"least gap of {pair}: {gap}"

    def remarks(self) -> list[str]:
        """Return a sentence for each stretch in which links touch, and one for a part of the range that is not reached."""
        says = [f"{' and '.join(x.pair)} touch from {self._value(x.begins)} to {self._value(x.ceases)}" for x in self.contacts]
        return says + ([f"{100 * self.missing:.3g} % of the range is not reached"] if self.missing else [])

    def touching(self, frames: Mapping[str, Float[np.ndarray, "3"]]) -> list[int]:
        """Return the indices of all `parts` of the pairs of links that touch or overlap in a pose.

        Args:
            frames: x, y (m) and angle (rad) of links by name; a link without a frame, such as the ground, is at the origin.
        """
        places = [corners[..., None] for corners in self.corners_in(frames)]

        def touch(i: int, j: int) -> bool:
            return signed_distance(places[i], places[j])[0] <= float(self.parts[i].radius) + float(self.parts[j].radius)

        pairs = self.parts_of_pairs
        return sorted({k for one, other in pairs if any(touch(i, j) for i in one for j in other) for k in (*one, *other)})

    def corners_in(self, frames: Mapping[str, Any]) -> list[Float[np.ndarray, "corners 2"]]:
        """Return the corners (m) of each of the `parts` in ground axes, in the pose given by `frames` as for `touching`."""
        moved = []
        for part in self.parts:
            x, y, angle = map(float, frames.get(part.body, (0.0, 0.0, 0.0)))
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            moved.append(np.asarray(part.corners, float) @ turn + [x, y])
        return moved

    @property
    def parts_of_pairs(self) -> list[tuple[list[int], list[int]]]:
        """The indices of the `parts` of the first and of the second link of each pair."""
        of = {name: [k for k, part in enumerate(self.parts) if part.body == name] for gap in self.pairs for name in gap.pair}
        return [(of[one], of[other]) for one, other in (gap.pair for gap in self.pairs)]

    def _length(self, length: Any, scale: float) -> str:
        size, unit = (1.0, "m") if self.count is None else (self.count.units.size("m"), self.count.units.shown("m"))
        return format_number(length / size, unit, scale / size)

    def _value(self, value: float) -> str:
        return format_number(value, self.unit) if self.count is None else self.count.text(value)

    def _table(self) -> PrintedTable:
        if not has_numbers(self) or np.ndim(self.least.distance):
            return fields_table(self, {}, "gaps between links")
        over = "" if self.count is None else f", by {self.count.words}"
        rows = [(pair, gap, "at", value) for pair, gap, value in self.rows()]
        return PrintedTable(f"least gaps between links{over}", rows, remarks=self.remarks())


@checked
def gaps(
    mechanism: Mechanism,
    drive: Drive = None,
    layers: Annotated[Mapping[str, Any], LAYERS] | None = None,
    pairs: Annotated[Sequence[Sequence[str]], PAIRS] | None = None,
    values: Annotated[Float[ArrayLike, "T"] | Sequence[float], RANGE] | None = None,
    run: Annotated[StateHistory, HISTORY] | None = None,
    shapes: Annotated[Mapping[str, Any], BY_NAME] | None = None,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> LeastGaps:
    """Return the least gap of each pair of links over a motion, proven between samples.

    The signed distance of two convex outlines is the maximum over unit vectors n of min n . (b - a), with a and b points of the
    first and of the second outline. Speeds and accelerations of the outlines limit how far it can fall between two samples; where
    it could fall below the least gap found, more positions are computed. `bound` is the proven lower bound of the gap, as a rule
    within 1e-9 of the mechanism's size. Between samples of a drive, positions are polynomials of degree five, compared with
    computed ones halfway; between output times of a run, they are the cubics through its positions and velocities.

    Links are drawn bars with round ends (`width`), discs, plates and outlines, and cams (for a roller, the path of its centre).
    Outlines that are not convex are cut into convex parts; an overlap of links is the largest one of their parts.

    Distances have exact first and second derivatives with respect to every number of the mechanism, of `shapes` and of a run, by
    `jax.grad`, `jax.hessian` and the like; values and contacts are constants there.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold, or any mechanism with a `run`.
        drive: a driver or coordinate, as for `kinematics`; by default the only driver.
        layers: the layer of each link; all pairs of a layer are measured. By default all pairs that share no joint or pin.
        pairs: pairs of names of links, instead of layers.
        values: values of the driver (rad, m), which moves from the least to the largest of them; by default one turn, or from
            toggle to toggle.
        run: a `Solution` or `Kinematics`, instead of a driver.
        shapes: outlines by link or "ground", instead of the drawn ones: a width (m) around the pins, corners (n, 2) in the frame
            of the link (m), or a tuple of corners and a width around them.
        held: values that other drivers or coordinates hold, by name, as for `kinematics`.

    Returns:
        A `LeastGaps`, which prints as a table.

    Raises:
        SceneError: a link has no outline, a name is unknown, links of one layer share a joint, or positions do not follow from
            the driver.
        ArgumentError: both a run and a driver, values or held are given.
        ArgumentTypeError: numbers are traced by `jax.jit` or `jax.vmap`.
    """
    if run is not None and not (drive is None and values is None and held is None):
        raise ArgumentError("run is given with drive, values or held: leave out either")
    driver = None if run is not None else only_driver(mechanism) if drive is None else drive
    if isinstance(run, Kinematics) and not is_traced(without_derivatives(run)):
        run = run.in_order()
    given = (mechanism, driver, values, run, shapes, held)
    now = without_derivatives(given)
    if is_traced(now):
        cure = "call it outside of jax.jit and jax.vmap; jax.grad and jax.hessian can trace it"
        raise ArgumentTypeError(f"gaps needs concrete numbers, since it decides which positions to compute: {cure}")
    concrete, driver_now, values_now, run_now, shapes_now, held_now = now
    checked_pairs = pairs_to_check(concrete, layers, pairs, shapes_now)
    names = list(dict.fromkeys(name for pair in checked_pairs for name in pair))
    parts = parts_of(concrete, shapes_now, names)
    motion = motion_of_run(run_now) if run is not None else motion_of_drive(concrete, driver_now, values_now, held_now)
    least, touches = search(parts, [*mechanism.body_names, GROUND], checked_pairs, motion)
    distances: Sequence[Any] = [x.distance for x in least]
    if is_traced(given):
        order = [*mechanism.body_names, GROUND]
        moving = parts_of(mechanism, shapes, names)
        distances = differentiable_gaps(mechanism, driver, run, held, moving, order, least, motion)
    contacts = [
        Touch(pair, *motion.value(np.array(ends)).tolist()) for pair, x in zip(checked_pairs, touches, strict=True) for ends in x
    ]
    u, pieces = (np.array(x) for x in zip(*((x.u, x.piece) for x in least), strict=True))
    values_found, poses = motion.value(u).tolist(), motion.at(u, pieces)[0][:, :-1]
    found = [
        LeastGap(pair, value, d, x.bound, x.places, q)
        for pair, value, x, d, q in zip(checked_pairs, values_found, least, distances, poses, strict=True)
    ]
    order = np.argsort([x.distance for x in least], kind="stable")
    contacts.sort(key=lambda x: (x.begins, x.ceases))
    count = Count.of_run(concrete, motion.unit) if run is not None else Count.of(concrete, driver_now)
    return LeastGaps(tuple(found[k] for k in order), tuple(contacts), motion.unit, motion.missing, count, tuple(parts))
