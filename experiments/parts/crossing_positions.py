"""Rows of the table of functions by models: positions, statics, and answers to the questions of a course."""

from itertools import combinations
from typing import Any

import numpy as np

import udkjax as udk
from experiments.parts.crossing_case import TS, Case, WrongError, agree, by_twin, claim
from udkjax.positions.answers.counting import Count


def bodies_of(m: Any) -> tuple[str, ...]:
    """Return the names of the bodies of a model; without bodies, a name that the functions refuse."""
    return getattr(m, "body_names", ()) or ("none",)


def first_body(m: Any) -> str:
    return bodies_of(m)[0]


def still(case: Case) -> Any:
    """The mechanism with drivers that hold and without friction: what `equilibrium` and `modes` take it for."""
    m = case.model
    drivers = {
        name: udk.Driver(x.bodies, x.coordinate, udk.Polynomial([float(x.motion(0.0))]), x.points, x.axis)
        for name, x in m.drivers.items()
    }
    forces = {name: x for name, x in m.forces.items() if not isinstance(x, udk.Friction)}
    return udk.Mechanism(m.bodies, m.joints, drivers, forces, m.gravity)


def equilibrium(case: Case) -> str:
    found = udk.equilibrium(case.model)
    if not found.balanced:
        found = udk.equilibrium(case.model, stable=True)
    if not found.balanced:
        return _endless(case)
    m = still(case)
    a = [np.abs(np.asarray(udk.accelerations(m, 0.0, q, 0.0 * case.state.v))).max() for q in (found.q, case.state.q)]
    claim(a[0] <= 1e-5 * (9.81 + a[1]), f"accelerates by {a[0]:.2g}")
    return "a = 0"


def _endless(case: Case) -> str:
    """Where nothing is found, from other positions neither, nothing may oppose the loads: a rack without an end, say."""
    claim(not udk.equilibria(case.model, starts=8), "equilibria finds what equilibrium does not")
    return "no equilibrium, equilibria neither"


def equilibria(case: Case) -> str:
    found = udk.equilibria(case.model, starts=4)
    m = still(case)
    for x in found:
        a = np.abs(np.asarray(udk.accelerations(m, 0.0, x.q, 0.0 * case.state.v))).max()
        claim(a <= 1e-5 * (9.81 + np.abs(np.asarray(m.gravity)).max()), f"accelerates by {a:.2g}")
    agree(len(udk.equilibria(case.twin[0], starts=4)), len(found), case.twin[1])
    return f"a = 0, {case.twin[1]}"


def modes(case: Case) -> str:
    """M a = -K x: next to rest, a displacement by a mode accelerates by -omega^2 of it."""
    rest = udk.equilibrium(case.model, stable=True)
    state = rest.state if rest.balanced else case.state
    found, other = udk.modes(case.model, state), udk.modes(case.twin[0], state)
    by = agree([other.omega2, other.damping], [found.omega2, found.damping], case.twin[1])
    if not rest.balanced:
        return by
    m, h = still(case), 1e-5
    for omega2, shape in zip(np.asarray(found.omega2), np.asarray(found.shapes), strict=True):
        size = h / np.abs(shape).max()
        moved = [udk.assemble(m, state=udk.State(state.q + s * size * shape, 0.0 * state.v)).q for s in (-1, 1)]
        a = [np.asarray(udk.accelerations(m, 0.0, q, 0.0 * state.v)).reshape(shape.shape) for q in moved]
        slope, scale = (a[1] - a[0]) / (2 * size), (abs(omega2) + float(np.abs(found.omega2).max())) * np.abs(shape).max()
        error = np.abs(slope + omega2 * shape).max()
        claim(error <= 1e-3 * scale + 1e-3, f"omega^2 {omega2:.6g}: the acceleration differs by {error:.2g} of {scale:.2g}")
    return f"accelerations near rest, {by}"


def holding(case: Case) -> str:
    found = udk.holding_efforts(case.model, case.driver, case.values(), held=case.held)
    by = by_twin(lambda case, m: udk.holding_efforts(m, case.driver, case.values(), held=case.held))(case)
    low, mid, high = (np.asarray(x) for x in (found.lower, found.without_friction, found.upper))
    slack = 1e-9 * (1e-3 + np.abs(mid).max(initial=0.0))
    claim(((low <= mid + slack) & (mid <= high + slack)).all(), "the effort without friction is not between the bounds")
    at_rest = udk.kinematics(case.model, case.driver, case.values(), held=case.held, rate=0.0)
    drivers = [case.driver, *(case.held or {}), *(x for x in case.model.driver_names if x != case.driver)]
    at_start = np.linspace(0.0, 1e-3, len(case.values()))  # before the second sample of a force
    rest = udk.inverse_dynamics(still(case), at_start, at_rest, drivers)
    return agree(mid, rest.efforts[case.driver], f"inverse_dynamics at rest, {by}", 1e-6)


def kinematics(case: Case) -> str:
    """Psi = 0 in all positions; v and a are differences of q."""
    found = case.kinematics(case.model, 5, rate=case.rate)
    h = 1e-4 * (case.values(2)[1] - case.values(2)[0])
    near = udk.kinematics(case.model, case.driver, case.values(1)[0] + h * np.arange(-2, 3), held=case.held, rate=1.0)
    q = np.asarray(near.q)
    agree((q[3] - q[1]) / (2 * h), near.v[2], "differences of q", 1e-4)
    agree((np.asarray(near.v)[3] - np.asarray(near.v)[1]) / (2 * h), near.a[2], "differences of v", 1e-3)
    twin, by = case.twin
    return agree(case.kinematics(twin, 5, rate=case.rate), found, f"differences, {by}")


def branches(case: Case) -> str:
    """Each branch is closed; one of them is the position of the start."""
    found = udk.branches(case.model, case.driver, case.values(1)[0], starts=40, held=case.held)
    claim(len(found) > 0, "finds no branch")
    start = np.asarray(case.kinematics(case.model, 1).q)[0]
    apart = np.asarray(found) - start
    apart[..., 2] = (apart[..., 2] + np.pi) % (2 * np.pi) - np.pi
    claim(np.abs(apart).max((1, 2)).min() < 1e-6, "the position of the start is not among the branches")
    others = udk.branches(case.twin[0], case.driver, case.values(1)[0], starts=40, held=case.held)
    return agree(found, others, f"the start, {case.twin[1]}")


def travel(case: Case) -> str:
    found = udk.travel(case.model, case.driver, held=case.held)
    for end, inwards in ((float(found.lower), 1e-4), (float(found.upper), -1e-4)):
        if np.isfinite(end):
            values = np.linspace(case.values(1)[0], end + inwards, 200)
            reached = udk.kinematics(case.model, case.driver, [*values, end - inwards], held=case.held).reached
            claim(np.asarray(reached)[:-1].all() and not np.asarray(reached)[-1], f"the toggle at {end:.6g}")
    return agree(udk.travel(case.twin[0], case.driver, held=case.held), found, f"kinematics, {case.twin[1]}", 1e-5)


def characteristics(case: Case) -> str:
    m, found = case.model, udk.characteristics(case.model, case.driver)
    claim(found.mobility.true == udk.check(m).degrees_of_freedom + len(m.driver_names), "mobility")
    free = udk.travel(m, case.driver)
    ends = [float(x) for x in (free.lower, free.upper) if np.isfinite(float(x))]
    if not found.turns:
        agree(sorted(found.limits), sorted(ends), "travel", 1e-6)
    other = udk.characteristics(case.twin[0], case.driver)
    numbers, wanted = ([x.extent for x in y.outputs.values()] + [y.turns, *y.ratios.values()] for y in (found, other))
    return agree(numbers, wanted, f"travel, {case.twin[1]}", 1e-6)


def instant_centres(case: Case) -> str:
    """The velocity of a link is omega x r about its centre on the ground."""
    m, q, v = case.model, case.state.q, case.accelerated.v[2]
    q = case.alone.q[2]
    found, count = udk.instant_centres(m, q, v), 0
    for pair, (place, at_infinity) in found.items():
        if "ground" not in pair or at_infinity:
            continue
        k = m.body_names.index(next(x for x in pair if x != "ground"))
        arm = np.asarray(q)[k, :2] - np.asarray(place)
        agree(np.asarray(v)[k, 2] * np.array([-arm[1], arm[0]]), np.asarray(v)[k, :2], "omega x r", 1e-6)
        count += 1
    by = by_twin(lambda case, m: dict(udk.instant_centres(m, q, v)))(case)
    return f"omega x r, {by}"


def motion_ranges(case: Case) -> str:
    motion = case.kinematics(case.model, 9)
    found, q = udk.motion_ranges(case.model, motion, case.driver), np.asarray(motion.q)
    names = case.model.body_names
    for name, swing in found.swings.items():
        agree(swing, np.ptp(q[:, names.index(name), 2]), f"the angles of {name}")
    for name, stroke in found.strokes.items():
        way = q[:, names.index(name), :2] - q[0, names.index(name), :2]
        agree(stroke, np.hypot(*np.ptp(way, axis=0)), f"the places of {name}", 1e-5)
    others = udk.motion_ranges(case.twin[0], motion, case.driver)
    return agree(found, others, f"the positions, {case.twin[1]}")


SQUARE = 0.01 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def gaps(case: Case) -> str:
    """Squares on the centres of bodies: no gap of a pose is below the bound, and the least one is that of the distance."""
    m, run = case.model, case.alone
    pairs = list(combinations(bodies_of(m), 2))[:6]
    shapes = dict.fromkeys(bodies_of(m), SQUARE)
    found = udk.gaps(m, pairs=pairs, run=run, shapes=shapes)
    q = np.asarray(run.q)
    for gap in found.pairs:
        i, j = (m.body_names.index(name) for name in gap.pair)
        apart = np.hypot(*(q[:, i, :2] - q[:, j, :2]).T)
        claim(gap.bound <= gap.distance <= apart.min() + 1e-12, "a pose has a smaller gap")
        claim(apart.min() - 2 * np.sqrt(2) * 0.01 <= gap.distance + 1e-3 + 0.2 * apart.max(), "the gap is too small")
    return by_twin(lambda case, m: [x.distance for x in udk.gaps(m, pairs=pairs, run=run, shapes=shapes).pairs])(case)


def layers(case: Case) -> str:
    m, run = case.model, case.alone
    shapes = dict.fromkeys(bodies_of(m), SQUARE)
    found = udk.layers(m, run=run, shapes=shapes)
    claim(all(found.of[one] != found.of[other] for one, other in found.conflicts), "links of one layer hit each other")
    return by_twin(lambda case, m: list(udk.layers(m, run=run, shapes=shapes).of.values()))(case)


def pin_motion(case: Case) -> str:
    """Velocities and accelerations of pins are differences of their places."""
    m, h = case.model, 1e-4
    values = case.values(1)[0] + h * np.arange(-1, 2)
    found = udk.pin_motion(m, udk.kinematics(m, case.driver, values, held=case.held, rate=1.0))
    for kind in (found.pins, found.links):
        for name, x in kind.items():
            x = np.asarray(x)
            agree((x[2, 0] - x[0, 0]) / (2 * h), x[1, 1], f"differences of {name}", 1e-4)
            agree((x[2, 1] - x[0, 1]) / (2 * h), x[1, 2], f"differences of rates of {name}", 1e-3)
    claim(found.links, "no link")
    return "differences"


def motion_at(case: Case) -> str:
    m = case.model
    value = case.values(1)[0]
    at = value if case.is_system else Count.of(m, case.driver).text(value)
    found = udk.motion_at(m, at, case.driver, held=case.held)
    agree(np.ravel(found.values), np.array([value]), "the value asked for", 1e-4)
    motion = udk.kinematics(m, case.driver, found.values, held=case.held, rate=found.rate)
    wanted = udk.pin_motion(m, motion)
    claim(len(str(found)) > 100, f"says {found}")
    return agree([found.pins, found.links], [wanted.pins, wanted.links], "pin_motion", 1e-9)


def worked_solution(case: Case) -> str:
    m, value = case.model, case.values(1)[0]
    at = value if case.is_system else Count.of(m, case.driver).text(value)
    found = udk.worked_solution(m, at)
    claim(found.residual < 1e-9, f"a line is off by {found.residual}")
    wanted = udk.motion_at(m, at)
    return agree([found.motion.pins, found.motion.links], [wanted.pins, wanted.links], "motion_at", 1e-9)


def pressure_angle(case: Case) -> str:
    """With the cam taken away, the follower can move in one way; a finite difference of the driven motion has its tangent."""
    m = case.model
    cams = [n for n, j in getattr(m, "joints", {}).items() if type(j) is udk.Cam]
    motion = case.kinematics(m, rate=case.rate)
    name = cams[0] if cams else next(iter(getattr(m, "joints", {"none": 0})))
    found = udk.pressure_angle(m, motion, name, case.driver)
    claim(((found >= 0) & (found <= np.pi / 2)).all(), "an angle beyond a right one")
    return agree(udk.pressure_angle(case.twin[0], motion, name, case.driver), found, case.twin[1])


def coupler_curve(case: Case) -> str:
    point, body = np.array([0.01, 0.02]), first_body(case.model)
    found = udk.coupler_curve(case.model, case.driver, case.values(), body, point, held=case.held)
    q = np.asarray(case.kinematics(case.model).q)[:, case.model.body_names.index(body)]
    c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
    return agree(found, q[:, :2] + np.stack([c * point[0] - s * point[1], s * point[0] + c * point[1]], 1), "kinematics", 1e-9)


def mechanical_advantage(case: Case) -> str:
    """Power in is power out: the ratio of the rates."""
    motion = case.kinematics(case.model, rate=1.0)
    found = np.asarray(udk.mechanical_advantage(case.model, motion, case.output))
    turning = case.model.body_names.index(case.output.split(".")[1])
    return agree(1.0 / found, np.asarray(motion.v)[:, turning, 2], "the ratio of rates")


def transmission_angle(case: Case) -> str:
    """The angle at the first pin that has one lies within half a turn, and is that of the twin."""
    m = case.model
    motion = case.kinematics(m)
    joints = {n: j for n, j in getattr(m, "joints", {}).items() if isinstance(j, udk.Revolute) and "ground" not in j.bodies}
    refusal: Exception | None = None
    for name in joints or ["none"]:
        try:
            found = udk.transmission_angle(m, motion, name)
        except udk.SceneError as error:
            refusal = error
            continue
        claim(((np.asarray(found) >= 0) & (np.asarray(found) <= np.pi)).all(), "an angle beyond half a turn")
        return agree(udk.transmission_angle(case.twin[0], motion, name), found, case.twin[1])
    assert refusal is not None
    raise refusal


def workspace(case: Case) -> str:
    """Places over two coordinates; those at the second one's first value are the coupler curve."""
    m, held = case.model, dict(case.held or {})
    second = next(iter(held), None)
    if second is None:  # one degree of freedom: refused
        second = f"body.{bodies_of(m)[-1]}.angle"
        held = {second: 0.0}
    first = held.pop(second)
    body = bodies_of(m)[-1]
    found = udk.workspace(m, {case.driver: case.values(), second: first + np.linspace(0.0, 0.05, 3)}, body, [0.01, 0.0])
    q = np.asarray(case.kinematics(m).q)[:, m.body_names.index(body)]
    wanted = q[:, :2] + 0.01 * np.stack([np.cos(q[:, 2]), np.sin(q[:, 2])], 1)
    return agree(found.points[:, 0], wanted, "kinematics", 1e-6)


def check(case: Case) -> str:
    """Rank and freedoms are those of the singular values of Psi_q, in a position nearby that is not singular."""
    found = udk.check(case.model)
    claim(len(str(found)) > 100, f"says {found}")
    n, twin = 3 * len(case.model.body_names), udk.check(case.twin[0])
    agree([*found[:5]], [*twin[:5]], case.twin[1])
    claim(found.degrees_of_freedom == n - found.rank and found.rows - found.rank == len(found.redundant), "counts")
    sigma = np.asarray(udk.singular_values(case.model, TS[2], case.alone.q[2]))
    rank = int((sigma > 1e-7 * sigma.max(initial=0.0)).sum())
    claim(rank == found.rank, f"rank {found.rank}, by singular values {rank}")
    return f"singular values, {case.twin[1]}"


def with_length(case: Case) -> str:
    """All attachment points of the body are as far apart as asked for."""
    m = case.model
    for name in bodies_of(m):
        try:
            found = udk.with_length(m, name, 0.3)
        except udk.SceneError as error:
            if name == m.body_names[-1]:
                raise
            if "fewer than two" not in str(error) and "two points" not in str(error):
                raise
            continue
        points = np.array([p for j in [*found.joints.values(), *found.forces.values(), *found.drivers.values()]
                           for b, p in zip(getattr(j, "bodies", ()), _points(j), strict=False) if b == name])  # fmt: skip
        longest = max(np.hypot(*(a - b)) for a in points for b in points)
        return agree(longest, 0.3, "the distance of its points", 1e-9)
    raise WrongError("no body")


def _points(element: Any) -> list[np.ndarray]:
    points = getattr(element, "points", None)
    return [] if points is None else list(np.asarray(points).reshape(-1, 2))


def with_angle(case: Case) -> str:
    found = udk.with_angle(case.model, first_body(case.model), 0.2, 0.7)
    return agree([found.q0[0, 2], found.v0[0, 2]], [0.2, 0.7], "the angle", 1e-12)
