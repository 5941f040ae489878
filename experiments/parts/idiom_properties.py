"""Properties of runs in programs of users: training, conditions in forces, events at samples, rest, limits, no projection.

Each has its own judge: files that are read again, differences, counts, laws of impacts, and an integration by SciPy of the
equations of reference_equations.py.
"""

from collections.abc import Callable, Collection, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import udkjax as udk
from experiments.parts.random_scenes import RandomScene, build, random_scene, state_of
from experiments.parts.reference_equations import evaluate
from experiments.parts.run_properties import RUN_BODIES, SPAN
from experiments.parts.state_properties import Solved, solve
from experiments.parts.tally import Property, Tally

TIGHT: Any = {"rtol": 1e-11, "atol": 1e-11}
PROPERTIES = {
    "training": Property("A trained tree, saved and read again, has the same numbers and runs alike", 1e-9, "digits of a file"),
    "gradient of a condition": Property(
        "Where a force branches, jumps or has a kink, the gradient is the limit of differences", 1e-5, "differences of runs"
    ),
    "Hessian of a condition": Property("Likewise the Hessian, of the gradient", 1e-4, "differences of gradients"),
    "once at a sample": Property("An event at the time of a sample or a knot happens once", 0.5, "a count"),
    "rest": Property("What has come to rest has no velocity, and its times of events never go back", 1e-9, "relative"),
    "gradient at rest": Property("Velocities and heights at rest do not depend on how a plate was thrown", 1e-6, "relative"),
    "limits of all joints": Property("No joint exceeds its limits, however many there are", 1e-6, "in rad, at output times"),
    "energy between limits": Property("Limits never add energy", 1e-7, "relative to the largest energy"),
    "without projection": Property(
        "A successful run without projection is the run by SciPy of the independent equations", 1e-4, "drift over a short run"
    ),
}


def check_training(tally: Tally, seed: int, members: int) -> int:
    """Train drawn mechanisms towards random numbers by three steps of Adam, save and read them."""
    makers = udk.library.four_bar, udk.library.slider_crank, udk.library.double_pendulum  # none is redundant
    for k in range(members):
        rng, start = np.random.default_rng([seed, k, 10]), makers[k % len(makers)]()
        optimizer, trained = optax.adam(rng.uniform(1e-4, 1e-3)), start
        state = optimizer.init(eqx.filter(trained, eqx.is_inexact_array))
        for _ in range(3):
            slopes = jax.tree.map(lambda x: rng.standard_normal(np.shape(x)), eqx.filter(trained, eqx.is_inexact_array))  # noqa: B023
            updates, state = optimizer.update(slopes, state)
            trained = eqx.apply_updates(trained, updates)
        again, at = udk.loads(udk.dumps(trained)), f"{makers[k % len(makers)].__name__} {k} of seed {seed}"
        ours, theirs = trained.parameters(), again.parameters()
        numbers = [np.max(np.abs(np.asarray(ours[n]) - theirs[n]), initial=0.0) for n in ours]
        tally.add("training", max(numbers) if ours.keys() == theirs.keys() else np.inf, at)
        runs = [udk.simulate(m, [0.0, 0.2], throw=False, **TIGHT).q for m in (trained, again, trained.with_parameters({}))]
        tally.add("training", [np.max(np.abs(np.asarray(runs[0] - run))) for run in runs[1:]], at)
    return members


class Conditional(udk.ForceElement):
    """A force k f(x - x0) along x, with a function f that branches, jumps or has a kink."""

    function: Callable[[Array], Array] = eqx.field(static=True)
    k: Float[Array, ""]
    x0: Float[Array, ""]

    def loads(self, t, *frames):
        return [(-self.k * self.function(frames[0].x - self.x0), 0.0, 0.0)]


def _branch(x: Array) -> Array:
    return jnp.where(x > 0, jnp.sin(x) + 1.0, 0.3 * x)


def _periodic(x: Array) -> Array:
    return jnp.mod(4 * x, 1.0)


CONDITIONS: dict[str, Callable[[Array], Array]] = {
    "where": _branch,
    "abs": jnp.abs,
    "sign": jnp.sign,
    "floor": lambda x: jnp.floor(3 * x),
    "mod": _periodic,
    "maximum": lambda x: jnp.maximum(x, 0.0),
}
PERIODS = {"floor": 1 / 3, "mod": 1 / 4}  # distances between the places of conditions (m)
ALONE = 100.0  # the same of conditions that have a single place
NEAR = 1e-3  # distance from such a place at the start or the end, within which differences of 1e-4 would see both sides


def check_conditions(tally: Tally, seed: int, members: int, kinds: Collection[str] = tuple(CONDITIONS)) -> int:
    """Differentiate where a body ends that passes the places of a condition, by its velocity, the force and the place."""
    for kind in kinds:
        rng = np.random.default_rng([seed, len(kind), 11])
        numbers = np.stack([rng.uniform(1.5, 2.0, members), rng.uniform(0.1, 0.5, members), rng.uniform(0.21, 0.29, members)], 1)

        def end(p: Any, function: Callable[[Array], Array] = CONDITIONS[kind]) -> Any:
            body = udk.Body(1.0, 0.1, velocity=jnp.stack([p[0], 0.0 * p[0]]))
            force = Conditional(["b"], function=function, k=p[1], x0=p[2])
            return udk.simulate(udk.Mechanism({"b": body}, forces={"f": force}, gravity=[0, 0]), [0.0, 0.5], **TIGHT).q[-1, 0, 0]

        value, slope = (jax.jit(jax.vmap(f)) for f in (end, jax.grad(end)))
        found, twice = slope(numbers), jax.jit(jax.vmap(jax.hessian(end)))(numbers)
        ends, period = np.stack([0.0 * numbers[:, 2], np.asarray(value(numbers))]) - numbers[:, 2], PERIODS.get(kind, ALONE)
        is_near = np.any(np.abs(ends - period * np.round(ends / period)) < NEAR, axis=0)
        h = 1e-4
        for name, function, derivative in (
            ("gradient of a condition", value, found),
            ("Hessian of a condition", slope, twice),
        ):
            # Differences of fourth order.
            moved = [[function(numbers + s * h * e) for s in (1, -1, 2, -2)] for e in np.eye(3)]
            right = np.stack([(8 * (a - b) - (c - d)) / (12 * h) for a, b, c, d in moved], -1)
            size = np.maximum(np.max(np.abs(right.reshape(members, -1)), 1), 1.0)
            errors = np.max(np.abs(np.asarray(derivative) - right).reshape(members, -1), 1) / size
            for k in range(members):
                if is_near[k]:
                    tally.leave_out("a body that starts or ends where its force jumps")
                else:
                    tally.add(name, errors[k], f"{kind} {k} of seed {seed}")
    return members * len(kinds)


class _Clock(eqx.Module):
    """Event condition: the time passes `time`."""

    time: Any

    def __call__(self, t: Any, at: Any) -> Any:
        return t - self.time


def check_samples(tally: Tally, seed: int, members: int) -> int:
    """Let an event happen at the time of a sample of `Held`, and at a knot of a spline."""
    rng, samples = np.random.default_rng([seed, 12]), 24
    values = rng.standard_normal((samples, 2))
    for kind in ("held", "spline"):
        dt = float(np.round(rng.uniform(0.02, 0.05), 3))
        knots = dt * np.arange(samples)
        angle = udk.Polynomial([0.0]) if kind == "held" else udk.Spline(knots, values[:, 0])
        bodies, joints = {"b": udk.Body(1.0, 0.1)}, {"pin": udk.Revolute(["ground", "b"], [[0, 0], [0, 0]])}
        turn = udk.Driver(["ground", "b"], "angle", angle)
        if kind == "held":
            scene = udk.Mechanism(bodies, joints, forces={"u": udk.Torque(["ground", "b"], udk.Held(values[:, 0], dt))})
        else:
            scene = udk.Mechanism(bodies, joints, {"turn": turn})

        def count(time: Any, end: Any, scene: Any = scene) -> Any:
            events = [udk.Event(_Clock(time), udk.Log(), 0, name="clock")]
            log: Any = udk.simulate(scene, jnp.stack([0.0 * end, end]), events=events, throw=False).events
            return log.count

        times = knots[rng.integers(1, samples - 2, members)]
        found = jax.jit(jax.vmap(count))(jnp.asarray(times), jnp.full(members, knots[-1]))
        for k in range(members):
            tally.add("once at a sample", abs(float(found[k]) - 1), f"{kind} {k} of seed {seed}")
    return 2 * members


def check_rest(tally: Tally, seed: int, members: int) -> int:
    """Throw plates onto two feet that do not bounce; once they lie, nothing changes."""
    rng = np.random.default_rng([seed, 13])
    feet = [udk.Contact("box", point=[x, -0.2], name=name) for name, x in (("L", -0.5), ("R", 0.5))]
    thrown = np.stack([rng.uniform(0.5, 1.2, members), rng.uniform(-0.3, 0.3, members), rng.uniform(-1, 1, members)], 1)

    def run(p: Any) -> Any:
        box = udk.Body(1.0, 0.3, position=jnp.stack([0.0 * p[0], p[0]]), angle=p[1], angular_velocity=p[2])
        return udk.simulate(udk.Mechanism({"box": box}), [0.0, 1.5], events=feet, throw=False, rtol=1e-10, atol=1e-10)

    def end(p: Any) -> Any:
        s = run(p)
        return jnp.concatenate([s.v[-1, 0], s.q[-1, 0, 1:]]), (s.v[-1, 0], s.code, s.events.time)

    slopes, (v, code, times) = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(jnp.asarray(thrown))
    for k in range(members):
        rests = int(code[k]) == udk.Result.successful and float(np.max(np.abs(v[k]))) < 1e-6
        if not rests:
            tally.leave_out("a plate that does not rest at the end")
            continue
        at, happened = f"plate at rest {k} of seed {seed}", np.asarray(times[k])[np.isfinite(times[k])]
        tally.add("rest", max(float(np.max(np.abs(v[k]))), -float(np.min(np.diff(happened), initial=0.0))), at)
        tally.add("gradient at rest", np.max(np.abs(np.asarray(slopes[k])[1:])), at)
    return members


def check_limits(tally: Tally, seed: int, members: int, joints: int = 4) -> int:
    """Let chains fall whose every joint has limits."""
    rng = np.random.default_rng([seed, 14])
    names = [f"b{k}" for k in range(joints)]
    lower, upper = -rng.uniform(0.3, 0.8, (members, joints)), rng.uniform(0.3, 0.8, (members, joints))
    restitution, speed = rng.uniform(0.1, 0.6, (members, joints)), rng.uniform(-2, 2, members)

    def run(lower: Any, upper: Any, restitution: Any, speed: Any) -> Any:
        bodies = {n: udk.Body(1.0, 0.1, [k + 0.5, 0.0], velocity=[0.0, 0.0]) for k, n in enumerate(names)}
        bodies[names[0]] = udk.Body(1.0, 0.1, [0.5, 0.0], angular_velocity=speed, velocity=jnp.stack([0 * speed, 0.5 * speed]))
        pairs = zip(["ground", *names], names, strict=False)
        pins = {f"j{k}": udk.Revolute(p, [[0.5 * (k > 0), 0.0], [-0.5, 0.0]]) for k, p in enumerate(pairs)}
        limits = [udk.JointLimit(f"j{k}", lower[k], upper[k], restitution=restitution[k]) for k in range(joints)]
        return udk.simulate(udk.Mechanism(bodies, pins), np.linspace(0, 1, 9), events=limits, throw=False, max_events=400)

    found = jax.jit(jax.vmap(run))(lower, upper, restitution, speed)
    for k in range(members):
        at, reached = f"limits {k} of seed {seed}", np.isfinite(np.asarray(found.q)[k]).all((1, 2))
        if int(found.code[k]) not in (udk.Result.successful, udk.Result.event_limit):
            tally.leave_out(f"limits: {udk.Result(int(found.code[k])).name}")
        q, v = np.asarray(found.q)[k, reached], np.asarray(found.v)[k, reached]
        turned = np.diff(q[:, :, 2], axis=1, prepend=0.0)
        excess = max(0.0, float(np.max(turned - upper[k])), float(np.max(lower[k] - turned)))
        tally.add("limits of all joints", excess, at)
        energy = np.sum(0.5 * np.array([1.0, 1.0, 0.1]) * v**2, (1, 2)) + 9.81 * np.sum(q[:, :, 1], 1)
        tally.add("energy between limits", max(0.0, np.max(np.diff(energy), initial=0.0)) / (9.81 * joints), at)
    return members


def check_unprojected(tally: Tally, seed: int, structures: Iterable[int]) -> int:
    """Integrate random scenes without projection, by machine code and by SciPy."""
    count = 0
    for structure in structures:
        scene = random_scene(seed, structure, 0, bodies=RUN_BODIES)
        solved = solve(scene)
        if not solved.is_clear or solved.condition > 1e3 or not len(solved.terms.psi):
            continue
        count += 1
        end, unit = 0.3 * SPAN * scene.time, np.tile([scene.length, scene.length, 1.0], len(scene.table["body"]))
        expected = _by_scipy(scene, solved, end, unit)
        if expected is None:
            tally.leave_out("SciPy cannot integrate a scene")
            continue
        state = udk.State(*state_of(scene.table))
        mechanism = build(scene.table)
        for name, stabilization in (("none", None), ("Baumgarte", udk.Baumgarte(1 / scene.time, 1 / scene.time))):
            run = udk.simulate(mechanism, [0.0, end], state, 1e-9, 1e-9, throw=False, stabilization=stabilization)
            if not run.result.is_success:
                tally.leave_out("a run without projection that ends early and reports it")
                continue
            error = np.max(np.abs(np.ravel(run.q[-1]) / unit - expected)) / max(1.0, np.max(np.abs(expected)))
            tally.add("without projection", error, f"{scene.label}, {name}")
    return count


def _by_scipy(scene: RandomScene, solved: Solved, end: float, unit: np.ndarray) -> np.ndarray | None:
    """Return the last coordinates, in units, of a run by SciPy; None if it fails."""
    n, inverse, w = unit.size, 1 / np.sqrt(solved.terms.mass), solved.weights
    scaled = np.concatenate([unit, unit / scene.time])

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        q, v = np.split(y * scaled, 2)
        terms = evaluate(scene.table, t, q.reshape(-1, 3), v.reshape(-1, 3))
        free = terms.force / terms.mass
        change = np.linalg.lstsq(w[:, None] * terms.psi_q * inverse, w * (terms.gamma - terms.psi_q @ free), 1e-7)[0]
        return np.concatenate([v, free + inverse * change]) / scaled

    start = np.concatenate([np.ravel(x) for x in state_of(scene.table)]) / scaled
    found = solve_ivp(rates, (0.0, end), start, "DOP853", rtol=1e-10, atol=1e-10)
    return found.y[:n, -1] if found.success else None


def check_idioms(tally: Tally, seed: int, members: int) -> int:
    """Check all of these properties; return how many mechanisms there were."""
    checks = check_training, check_conditions, check_samples, check_rest, check_limits
    return sum(check(tally, seed, members) for check in checks) + check_unprojected(tally, seed, range(members))
