"""Properties of contacts: plates on a floor and on a beam that turns, wheels in a wedge; energy, impulses, depths.

Gaps, impulses and energies are written here anew, of the states before and after each event alone.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.run_properties import analysis_of, member
from experiments.parts.tally import Property, Tally

PROPERTIES = {
    "impact energy": Property(
        "Energy never grows, at an impact or later", 1e-7, "relative to the largest energy, in runs at a tolerance of 1e-8"
    ),
    "impact pull": Property("No contact pulls", 1e-7, "relative to the largest impulse, as above"),
    "impact depth": Property("No contact is penetrated", 1e-6, "relative to the scene's length, as above"),
}


Gap = Callable[[np.ndarray], Any]  # of q (..., bodies, 3): how far two things are from each other (m), independently written
Throw = tuple[udk.Mechanism, Any, Any, float, list[Gap]]  # a scene, its events, times, length, and what each event is about


def check_contacts(tally: Tally, seed: int, members: int) -> int:
    """Throw what is in `THROWN`, so many of each kind; return how many."""
    for kind, (name, throw) in enumerate(THROWN.items()):
        rng = np.random.default_rng([seed, kind])
        drawn = [throw(rng) for _ in range(members)]
        stack: Callable[[list[Any]], Any] = lambda x: jax.tree.map(lambda *leaves: jnp.stack(leaves), *x)  # noqa: E731
        mechanisms, events, ts = (stack([d[i] for d in drawn]) for i in range(3))
        first = udk.analyse(drawn[0][0])

        def run(m: Any, e: Any, t: Any, first: udk.Analysis = first) -> Any:
            chosen = analysis_of(first, m)
            return udk.simulate(m, t, events=e, throw=False, analysis=chosen, max_events=48, max_steps=5000)

        found = jax.jit(jax.vmap(run))(mechanisms, events, ts)
        for k, (mechanism, _, _, length, gaps) in enumerate(drawn):
            _check_impacts(tally, mechanism, gaps, length, member(found, k), f"{name} {k} of seed {seed}")
    return members * len(THROWN)


def _plates(rng: np.random.Generator, jointed: bool) -> Throw:
    """Plates with two feet each, loose or jointed, onto a floor."""
    length, mass, speed = _size(rng)
    bodies, feet, gaps = {}, [], []
    for k, name in enumerate("ab"[: 1 + jointed]):
        start = {"position": length * np.array([1.0 * k, rng.uniform(1.2, 2.0)]), "angle": rng.uniform(-0.5, 0.5)}
        bodies[name] = _body(rng, length, mass, speed, **start)
        for side in (-0.5, 0.5):
            point, restitution = length * np.array([side, -0.2]), rng.uniform(0.0, 0.8)
            feet.append(udk.Contact(name, point, restitution=restitution, name=f"{name}{side}"))
            gaps.append(lambda q, k=k, p=point: _point(q[..., k, :], p)[1])
    joints = {"hinge": udk.Revolute(["a", "b"], length * np.array([[0.5, 0.1], [-0.5, 0.1]]))} if jointed else {}
    return udk.Mechanism(bodies, joints), feet, _times(length), length, gaps


def _plate_on_beam(rng: np.random.Generator) -> Throw:
    """A plate onto a beam that turns about its middle."""
    length, mass, speed = _size(rng)
    bodies = {
        "beam": udk.Body(10 * mass, 5 * mass * length**2 * rng.uniform(0.5, 2.0), angle=rng.uniform(-0.1, 0.1)),
        "plate": _body(rng, length, mass, speed, [rng.uniform(-0.5, 0.5) * length, rng.uniform(1.2, 2.0) * length]),
    }
    joints = {"pivot": udk.Revolute(["ground", "beam"], [[0.0, 0.0], [0.0, 0.0]])}
    feet, gaps, top = [], [], length * np.array([0.0, 0.1])
    for side in (-0.5, 0.5):
        point, normal = length * np.array([side, -0.2]), np.array([rng.uniform(-0.1, 0.1), 1.0])
        feet.append(udk.Contact("plate", point, top, normal, rng.uniform(0.0, 0.8), "beam", name=f"foot {side}"))

        def gap(q: np.ndarray, point: np.ndarray = point, normal: np.ndarray = normal / np.hypot(*normal)) -> Any:
            (x, y), (x0, y0) = _point(q[..., 1, :], point), _point(q[..., 0, :], top)
            x1, y1 = _point(q[..., 0, :], top + normal)
            return (x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)

        gaps.append(gap)
    return udk.Mechanism(bodies, joints), feet, _times(length), length, gaps


class _RoundGap(eqx.Module):
    """Return the distance of a wheel from a wall, or from another wheel."""

    wheels: tuple[str, ...] = eqx.field(static=True)
    reach: Any  # of the wheels together
    normal: Any = None

    def __call__(self, t: Any, at: Any) -> Any:
        one = at[self.wheels[0]]
        if self.normal is not None:
            return self.normal[0] * one.x + self.normal[1] * one.y - self.reach
        two = at[self.wheels[1]]
        return jnp.sqrt((two.x - one.x) ** 2 + (two.y - one.y) ** 2) - self.reach


def _wheels(rng: np.random.Generator) -> Throw:
    """Two wheels into a wedge: user-defined conditions, four for the walls and one for the wheels."""
    length, mass, speed = _size(rng)
    radii = length * rng.uniform(0.2, 0.4, 2)
    places = length * np.array([[rng.uniform(-0.2, 0.2), 1.5], [rng.uniform(-0.2, 0.2), 3.0]])
    bodies = {name: _body(rng, length, mass, speed, place) for name, place in zip("ab", places, strict=True)}
    events, gaps = [], []
    for k, name in enumerate("ab"):
        for side in (-1.0, 1.0):
            tilt = rng.uniform(0.4, 1.0)
            normal = np.array([-side * np.sin(tilt), np.cos(tilt)])
            condition = _RoundGap((name,), jnp.asarray(radii[k]), jnp.asarray(normal))
            events.append(udk.Event(condition, udk.Impact(rng.uniform(0.0, 0.8)), -1, f"{name}{side}"))
            gaps.append(lambda q, k=k, n=normal: q[..., k, :2] @ n - radii[k])
    both = _RoundGap(("a", "b"), jnp.asarray(radii.sum()))
    events.append(udk.Event(both, udk.Impact(rng.uniform(0.0, 0.8)), -1, "wheels"))
    gaps.append(lambda q: np.hypot(*np.moveaxis(q[..., 1, :2] - q[..., 0, :2], -1, 0)) - radii.sum())
    return udk.Mechanism(bodies), events, _times(length), length, gaps


THROWN: dict[str, Callable[[np.random.Generator], Throw]] = {
    "plate": lambda rng: _plates(rng, False),
    "jointed plates": lambda rng: _plates(rng, True),
    "plate on a beam": _plate_on_beam,
    "wheels in a wedge": _wheels,
}


def _size(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw a length and a mass; return them and the speed that belongs to the length."""
    length = 10 ** rng.uniform(-4, 2)
    return length, 10 ** rng.uniform(-3, 3), np.sqrt(9.81 * length)


def _times(length: float) -> np.ndarray:
    return np.linspace(0.0, 3.0, 7) * np.sqrt(length / 9.81)


def _body(rng: np.random.Generator, length: float, mass: float, speed: float, position: Any, angle: float = 0.0) -> udk.Body:
    moving = {"velocity": speed * rng.uniform(-0.5, 0.5, 2), "angular_velocity": speed / length * rng.uniform(-1, 1)}
    return udk.Body(mass * rng.uniform(0.5, 2.0), mass * length**2 * rng.uniform(0.05, 0.2), position, angle, **moving)


def _point(q: np.ndarray, p: Any) -> tuple[Any, Any]:
    """Return the position of a point of a body from its x, y and angle."""
    c, s = np.cos(q[..., 2]), np.sin(q[..., 2])
    return q[..., 0] + c * p[0] - s * p[1], q[..., 1] + s * p[0] + c * p[1]


def _check_impacts(tally: Tally, mechanism: udk.Mechanism, gaps: list[Gap], length: float, found: Any, at: str) -> None:
    mass = np.array([[float(b.mass), float(b.mass), float(b.inertia)] for b in mechanism.bodies.values()])
    energy: Callable[[Any, Any], Any] = lambda q, v: np.sum(0.5 * mass * v**2 + [0.0, 9.81, 0.0] * mass * q, axis=(-2, -1))  # noqa: E731
    q, v, reached = np.asarray(found.q), np.asarray(found.v), np.isfinite(np.asarray(found.q)).all((1, 2))
    result = udk.Result(int(found.code))
    if result not in (udk.Result.successful, udk.Result.event_limit):
        tally.leave_out(f"contacts: {result.name}")
    q, v = q[reached], v[reached]
    along, unit = energy(q, v), mass[:, 0].sum() * 9.81 * length
    tally.add("impact energy", max(0.0, np.max(np.diff(along), initial=0.0)) / unit, at)
    tally.add("impact depth", max(0.0, -min(np.min(gap(q)) for gap in gaps)) / length, at)
    events = found.events
    for e in range(min(int(events.count), len(events.time))):
        before, after = (
            energy(*(np.asarray(x)[e] for x in pair))
            for pair in ((events.q_before, events.v_before), (events.q_after, events.v_after))
        )
        tally.add("impact energy", max(0.0, float(after - before)) / unit, at)
        jump = (mass * (np.asarray(events.v_after)[e] - np.asarray(events.v_before)[e])).ravel()
        _check_pull(tally, mechanism, gaps, np.asarray(events.q_before)[e], jump, mass, length, at)


def _check_pull(tally: Tally, mechanism: Any, gaps: list[Gap], q: Any, jump: Any, mass: Any, length: float, at: str) -> None:
    """Split a jump into impulses of the joints and of contacts; by least squares, not negative."""
    from scipy.optimize import nnls

    unit = np.tile([length, length, 1.0], len(q))
    place = {name: k for k, name in enumerate(mechanism.body_names)}

    def row(gap: Gap) -> np.ndarray:
        """By differences, of whose terms the third order is 1e-10 of the first."""
        moves = 1e-5 * np.diag(unit).reshape(-1, *q.shape)
        return (gap(q + moves) - gap(q - moves)) / 2e-5

    ties = []
    for joint in mechanism.joints.values():
        for axis in (0, 1):
            ends = [(place.get(name), np.asarray(p)) for name, p in zip(joint.bodies, joint.points, strict=True)]

            def open_by(q: np.ndarray, ends: Any = ends, axis: int = axis) -> Any:
                one, two = (p[axis] if k is None else _point(q[..., k, :], p)[axis] for k, p in ends)
                return two - one

            ties.append(row(open_by))
    rows = [row(gap) for gap in gaps if abs(gap(q)) < 1e-5 * length]
    columns = np.array([*rows, *ties, *(-tie for tie in ties)]).T / length if rows or ties else np.zeros((q.size, 1))
    impulse = jump * unit / length
    size = np.max(abs(impulse))
    if size:
        tally.add("impact pull", nnls(columns, impulse)[1] / max(size, 1e-6 * mass[:, 0].sum() * np.sqrt(9.81 * length)), at)
