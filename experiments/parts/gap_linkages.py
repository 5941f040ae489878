"""Random linkages with widths, and gaps, contacts and layers of them by other ways: by shapely, differences and enumeration."""

from itertools import combinations, product
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import brentq

import udkjax as udk
from udkjax.positions.following.drive import drive


def random_linkage(seed: int) -> tuple[udk.Mechanism, tuple[float, float]]:
    """A four-bar with a plate as coupler, driven through its range, and a dyad on the plate; widths at random."""
    rng = np.random.default_rng(seed)
    while True:
        pins = dict(zip("OABCEFG", rng.uniform(-1, 1, (7, 2)), strict=True))
        pins["A"] = pins["O"] + rng.uniform(0.1, 0.3) * (pins["A"] - pins["O"])
        w = rng.uniform(0.02, 0.1, 4)
        links = {
            "crank": udk.Link(["O", "A"], mass=1, width=w[0]),
            "plate": udk.Link(["A", "B", "E"], mass=1),
            "rocker": udk.Link(["B", "C"], mass=1, width=w[1]),
            "rod": udk.Link(["E", "F"], mass=1, width=w[2]),
            "lever": udk.Link(["F", "G"], mass=1, width=w[3]),
        }
        drawing = udk.Drawing(pins=pins, links=links, ground=["O", "C", "G"], motors={"motor": {"pin": "O", "speed": 1.0}})
        mech = drawing.mechanism()
        start = float(
            udk.Coordinate.of(mech.drivers["motor"]).value(udk.Frame(0.0, 0.0, 0.0, 1.0, 0.0), mech.bodies["crank"].frame())
        )
        motion = udk.kinematics(mech, "motor", np.linspace(start - 0.4, start + 0.4, 60))
        if np.asarray(motion.reached).all():
            return mech, (start - 0.4, start + 0.4)


def placed(mech: udk.Mechanism, name: str, q: Any) -> tuple[np.ndarray, float]:
    """Corners of a link in the world (corners, 2, ...), and its radius, from the drawing."""
    drawing: Any = mech.drawing
    link, local = drawing.links[name], np.asarray(drawing.shapes()[name])
    x, y, angle = np.moveaxis(np.asarray(q)[..., mech.body_names.index(name), :], -1, 0)
    turned = [[x + np.cos(angle) * a - np.sin(angle) * b, y + np.sin(angle) * a + np.cos(angle) * b] for a, b in local]
    return np.array(turned), 0.0 if link.width is None else 0.5 * float(link.width)


def turning_bars(count: int = 15) -> tuple[udk.Mechanism, list[tuple[str, str]]]:
    """Return bars, each with a motor at its own speed, and all pairs of them."""
    rng, pins, links, motors = np.random.default_rng(0), {}, {}, {}
    for k in range(count):
        pins[f"O{k}"] = 0.25 * np.array([k % 4, k // 4])
        pins[f"A{k}"] = pins[f"O{k}"] + 0.08 * rng.normal(size=2)
        links[f"bar{k}"] = udk.Link([f"O{k}", f"A{k}"], mass=1, width=0.02)
        motors[f"motor{k}"] = {"pin": f"O{k}", "speed": float(rng.integers(1, 4))}
    ground = [name for name in pins if name.startswith("O")]
    return udk.Drawing(pins=pins, links=links, ground=ground, motors=motors).mechanism(), list(combinations(links, 2))


def shapely_gaps(mech: udk.Mechanism, pair: tuple[str, str], q: Any) -> np.ndarray:
    """Return the gaps of two links in poses (n, bodies, 3) by shapely; minus both radii where their corners' hulls overlap."""
    import shapely

    figures, radii = [], 0.0
    for name in pair:
        corners, radius = placed(mech, name, q)
        corners, radii = np.moveaxis(corners, -1, 0), radii + radius
        build = {1: lambda x: shapely.points(x[:, 0]), 2: shapely.linestrings}.get(corners.shape[1], shapely.polygons)
        figures.append(build(corners))
    return shapely.distance(*figures) - radii


class GapComparison(NamedTuple):
    """Gaps compared with those of shapely at many positions: their number, and differences relative to the size.

    `below` is how far the smallest gap of shapely is below the proven bound, negative if it is above. `above` is how far it is
    above the least gap, for pairs that do not overlap. `overlaps` is the number of pairs that do.
    """

    pairs: int
    below: float
    above: float
    overlaps: int


def compare_with_shapely(seed: int, positions: int) -> GapComparison:
    """Compare the gaps of a random linkage with those of shapely."""
    mech, values = random_linkage(seed)
    found = udk.gaps(mech, "motor", values=values)
    q = np.asarray(udk.kinematics(mech, "motor", np.linspace(values[0], values[1], positions)).q)
    size, below, above = float(np.ptp(q[..., :2], axis=(0, 1)).max()), [], [0.0]
    for gap in found.pairs:
        least = float(shapely_gaps(mech, gap.pair, q).min())
        below.append((gap.bound - least) / size)
        if gap.distance > 0:
            above.append((least - float(gap.distance)) / size)
    return GapComparison(len(found.pairs), max(below), max(above), sum(gap.distance <= 0 for gap in found.pairs))


def contact_errors(seed: int) -> list[float]:
    """Return the differences (rad) between contacts of a random linkage and roots of the gaps of shapely."""
    mech, values = random_linkage(seed)
    found = []

    def gap(value: float, pair: tuple[str, str]) -> float:
        return float(shapely_gaps(mech, pair, udk.kinematics(mech, "motor", [value]).q)[0])

    for touch in udk.gaps(mech, "motor", values=values).contacts:
        for place in (touch.begins, touch.ceases):
            near = place - 1e-5, place + 1e-5
            if values[0] < near[0] and near[1] < values[1] and np.prod([gap(x, touch.pair) for x in near]) < 0:
                found.append(abs(brentq(gap, *near, args=(touch.pair,), xtol=1e-14) - place))
    return found


def gradient_error(seed: int, step: float = 1e-4) -> float:
    """Return the relative error of the least gap's slope in a random direction, by differences of the fourth order."""
    mech, values = random_linkage(seed)
    way, pins = np.random.default_rng(seed).normal(size=(2, 2)), ("pin.B", "pin.E")
    start = np.array([mech.parameters()[name] for name in pins])
    pair = udk.gaps(mech, "motor", values=values).least.pair

    def least(t: Any) -> Any:
        changed = mech.with_parameters(dict(zip(pins, start + t * way, strict=True)))
        return udk.gaps(changed, "motor", values=values, pairs=[pair]).least.distance

    slope, at = float(jax.grad(least)(0.0)), {k: float(least(k * step)) for k in (-2, -1, 1, 2)}
    return abs(slope / ((8 * (at[1] - at[-1]) - at[2] + at[-2]) / (12 * step)) - 1)


def fewest_layers(mech: udk.Mechanism, positions: int) -> int:
    """Return the fewest layers by trying all layers of all links, with the contacts that shapely finds over a turn."""
    start = float(drive(mech, mech.driver_names[0]).value(mech.q0))
    q = np.asarray(udk.kinematics(mech, mech.driver_names[0], start + np.linspace(0, 2 * np.pi, positions)).q)
    q, names, hits = q[np.isfinite(q).all((1, 2))], mech.body_names, set()
    for pair in combinations(names, 2):
        joined = any(set(pair) <= set(joint.bodies) for joint in mech.joints.values())
        if joined or shapely_gaps(mech, pair, q).min() <= 0:
            hits.add((names.index(pair[0]), names.index(pair[1])))
    for count in range(1, len(names) + 1):
        if any(all(layers[i] != layers[j] for i, j in hits) for layers in product(range(count), repeat=len(names))):
            return count
    return len(names)
