"""Limits of a design: bounds of free numbers, lengths between pins, areas of pins, and the least transmission."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.spatial import ConvexHull, QhullError

from udkjax.expressions import Differential, Graph, ScalarProgram, trace
from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion

Range = tuple[float, float]
# Smallest transmission over a required turn, even if none is requested; for a four-bar, the sine of the transmission angle.
# Closer to a meeting of branches, real parts with clearances may change their branch.
LEAST_TRANSMISSION = 3e-3
DEFAULT_REACH = 2.0  # range of the search for unbounded pins, relative to the extent of targets and drawing
DEFAULT_FACTOR = 4.0  # range of other numbers: from value / factor to value * factor


@dataclass(frozen=True, eq=False)
class Bounds:
    """The ranges of free numbers (P,): `low` and `high` are limits; searches start between `first` and `last`."""

    low: np.ndarray
    high: np.ndarray
    first: np.ndarray
    last: np.ndarray


def read_bounds(
    free: FreeNumbers, given: Mapping[str, object], places: np.ndarray, name: str, reach: float = DEFAULT_REACH
) -> Bounds:
    """Return the bounds of all free numbers; raise `SceneError` if a range is invalid.

    Args:
        free: the numbers.
        given: (low, high) by the name of a free number; each end is a number, or has its shape.
        places: places (k, 2) around which to search (m).
        name: name of the mechanism, for errors.
        reach: range of the search for unbounded pins, in extents of the places.
    """
    low, high = np.full(free.count, -np.inf), np.full(free.count, np.inf)
    centre, extent = 0.5 * (places.min(0) + places.max(0)), max(float(np.max(np.ptp(places, axis=0))), 1e-12)
    known = free.mechanism.number_fields()
    problems = [f"bounds: {quote(key)} is not free{suggestion(key, free.names)}" for key in given if key not in free.names]
    first, last = np.empty(free.count), np.empty(free.count)
    for key, value, a, b in zip(free.names, free.values, free.starts, free.starts[1:], strict=False):
        shape = np.shape(value)
        field = known[split_index(key, known)[0]]
        if field.section == "pin" and field.path == ("position",):
            middle = centre if shape else centre[int(key[-2])]
            first[a:b], last[a:b] = middle - reach * extent, middle + reach * extent
        elif field.section == "pin" and field.path == ("angle",):
            first[a:b], last[a:b] = value - np.pi, value + np.pi
        else:
            ends = np.stack([np.ravel(value) / DEFAULT_FACTOR, np.ravel(value) * DEFAULT_FACTOR])
            first[a:b], last[a:b] = ends.min(0), ends.max(0)
        if free.mechanism.must_be_positive(key):
            low[a:b] = np.finfo(float).tiny
        if key in given:
            try:
                lower, upper = (np.broadcast_to(np.asarray(end, float), shape).ravel() for end in given[key])  # pyright: ignore
            except (TypeError, ValueError):
                problems.append(f"bounds.{key}: must be a pair (low, high), each a number or of the shape {shape}")
                continue
            if not np.all(lower <= upper):  # also for NaN
                problems.append(f"bounds.{key}: low must not exceed high")
            low[a:b], high[a:b] = lower, upper
            apart = (lower > last[a:b]) | (upper < first[a:b])  # outside the default range
            first[a:b], last[a:b] = (
                np.where(apart, np.maximum(lower, upper - extent), np.maximum(lower, first[a:b])),
                np.where(apart, np.minimum(upper, lower + extent), np.minimum(upper, last[a:b])),
            )
    if problems:
        raise SceneError(problems, name)
    return Bounds(low, high, first, last)


class LengthLimits:
    """Limits on distances between pins and on areas of pins: rows c(x) <= 0 (K,) in m, with derivatives.

    Args:
        free: the free numbers x.
        lengths: (least, most) in m by pairs of pins.
        areas: areas by pin: a circle (x, y, radius) or the corners (k, 2) of a convex polygon, in m.

    Raises:
        SceneError: there is no drawing or pin, or a range or an area is invalid.
    """

    def __init__(self, free: FreeNumbers, lengths: Mapping[tuple[str, str], Range], areas: Mapping[str, object] | None = None):
        mechanism = free.mechanism
        ranges = [_read_range(mechanism, pins, ends) for pins, ends in lengths.items()]
        problems = [p for areas_by_pin in ranges for p in areas_by_pin[3]]
        areas_by_pin = {pin: read_area(mechanism, pin, area, problems) for pin, area in (areas or {}).items()}
        if problems:
            raise SceneError(problems, mechanism.name)
        rows = [
            (pins, sign, end) for pins, low, high, _ in ranges for sign, end in ((-1.0, low), (1.0, high)) if 0 < end < np.inf
        ]
        rows += [((None, pin), 1.0, area[2]) for pin, area in areas_by_pin.items() if area.ndim == 1]
        centres = np.array([area[:2] for area in areas_by_pin.values() if area.ndim == 1]).reshape(-1, 2)
        # Outward normals of the sides, and distances of the sides from the origin.
        polygons = {pin: ConvexHull(area).equations for pin, area in areas_by_pin.items() if area.ndim == 2}
        sides = [(pin, side[:2], -side[2]) for pin, equations in polygons.items() for side in equations]
        self.count, self._free = len(rows) + len(sides), free.count
        ends = [f"the area of {pin}" if a is None else f"the length {a}-{pin}" for (a, pin), *_ in rows]
        self.names = [*ends, *(f"the area of {pin}" for pin, *_ in sides)]
        self._way, self._end = np.array([sign for _, sign, _ in rows]), np.array([end for *_, end in rows])

        self._centres = np.zeros((len(rows), 2))
        self._centres[len(rows) - len(centres) :] = centres
        self._normals, self._distances = np.array([n for _, n, _ in sides]).reshape(-1, 2), np.array([d for *_, d in sides])
        if self.count:
            self._between = _with_slopes(free, [(start, end) for (start, end), *_ in rows] + [(None, pin) for pin, *_ in sides])

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows c (M, K), in m, and dc/dx (M, K, P), for vectors (M, P) that begin with the free numbers."""
        slopes, first = np.zeros((len(x), self.count, x.shape[1])), len(self._way)
        if not self.count:
            return np.zeros((len(x), 0)), slopes
        between, moves = self._between(x[:, : self._free])  # (M, K, 2), (M, K, 2, F)
        arms = between[:, :first] - self._centres
        length = np.sqrt(np.sum(arms**2, axis=2))
        unit = self._way[:, None] * arms / np.maximum(length, np.finfo(float).tiny)[..., None]
        slopes[:, :first, : self._free] = np.sum(unit[..., None] * moves[:, :first], axis=2)
        slopes[:, first:, : self._free] = np.einsum("kc,mkcp->mkp", self._normals, moves[:, first:])
        sides = np.einsum("kc,mkc->mk", self._normals, between[:, first:]) - self._distances
        return np.concatenate([self._way * (length - self._end), sides], 1), slopes


def _with_slopes(
    free: FreeNumbers, pairs: Sequence[tuple[str | None, str]]
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a function of free numbers (M, F) that returns vectors between pairs of pins and their derivatives.

    The vectors (M, K, 2) are from the first to the second pin of each pair, or from the origin if the first is None; the
    derivatives by the free numbers are (M, K, 2, F).
    """

    def between(x: Array) -> Array:
        pins = free.moved(x).drawing.pins  # pyright: ignore[reportOptionalMemberAccess]
        return jnp.stack([jnp.asarray(pins[b] if a is None else pins[b] - pins[a]) for a, b in pairs])

    graph = Graph()
    inputs = [graph.input(("x", k), "x") for k in range(free.count)]
    vectors = list(trace(between, jnp.asarray(free.vector))(graph, np.array(inputs, object))[0].flat)
    differential, zero = Differential(graph, vectors, inputs), graph.constant(0.0)
    slopes = [row.get(x.index, zero) for row in map(differential.row, vectors) for x in inputs]
    count, total = len(vectors), len(vectors) + len(slopes)
    columns = [k for k, y in enumerate([*vectors, *slopes]) if not y.is_zero]  # most slopes vanish
    program = ScalarProgram(graph, inputs, [[*vectors, *slopes][k] for k in columns])

    def values(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.zeros((total, len(x)))
        with np.errstate(all="ignore"):  # where circles do not meet, limits are NaN
            for column, y in zip(columns, program.by_numpy(list(x.T)), strict=True):
                found[column] = y
        found = found.T
        return found[:, :count].reshape(-1, len(pairs), 2), found[:, count:].reshape(-1, len(pairs), 2, free.count)

    return values


def read_area(mechanism: Mechanism, pin: str, area: object, problems: list[str]) -> np.ndarray:
    """Return the area of a pin as an array: a circle (3,) or the corners (k, 2) of a convex polygon.

    If it is neither, or there is no such pin, a message is appended to `problems`.
    """
    known = {} if mechanism.drawing is None else mechanism.drawing.groups["pin"]
    try:
        array = np.asarray(area, float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    is_circle = array.shape == (3,) and array[2] > 0
    is_polygon = array.ndim == 2 and array.shape[-1] == 2 and len(array) > 2 and _is_convex(array)
    if pin not in known:
        problems.append(f"areas: no pin named {quote(pin)}{suggestion(pin, known)}")
    if not np.all(np.isfinite(array)) or not (is_circle or is_polygon):
        problems.append(f"areas.{pin}: must be a circle (x, y, radius), or the corners of a convex polygon in order (m)")
        return np.zeros(3)
    return array


def box_of(area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest x, y and the largest x, y (2,) of an area as `read_area` returns it."""
    return (area[:2] - area[2], area[:2] + area[2]) if area.ndim == 1 else (area.min(0), area.max(0))


def _is_convex(corners: np.ndarray) -> bool:
    """Return True if points (k, 2) are the corners of a convex polygon in order."""
    try:
        around = ConvexHull(corners).vertices
    except (QhullError, ValueError):  # collinear, or NaN
        return False
    steps = {*(np.diff(around, append=around[:1]) % len(corners)).tolist()}
    return len(around) == len(corners) and steps in ({1}, {len(corners) - 1})


def _read_range(mechanism: Mechanism, pins: Sequence[str], ends: Range) -> tuple[tuple[str, ...], float, float, list[str]]:
    known = {} if mechanism.drawing is None else mechanism.drawing.groups["pin"]
    where, problems = f"lengths[{', '.join(map(str, pins))}]", []
    if isinstance(pins, str) or len(pins) != 2:
        problems.append(f'lengths: {quote(str(pins))} must be two pins, such as ("A", "B")')
    else:
        problems += [f"{where}: no pin named {quote(p)}{suggestion(p, known)}" for p in pins if p not in known]
    try:
        low, high = (float(x) for x in ends)
    except (TypeError, ValueError):
        return tuple(pins), 0.0, np.inf, [*problems, f"{where}: must be a pair (least, most) in m"]
    if not 0 <= low <= high:
        problems.append(f"{where}: must be (least, most) with 0 <= least <= most, not {low:g} and {high:g}")
    return tuple(pins), low, high, problems
