"""Properties of runs: both engines, batches, jit, derivatives, impacts. Each structure is compiled once, for many mechanisms."""

import dataclasses
import re
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.random_scenes import RandomScene, build, random_scene, state_of
from experiments.parts.state_properties import names_of, solve
from experiments.parts.tally import Property, Tally
from udkjax.equations.scales import traced_scales

TOL = 1e-10  # of integration
SPAN = 0.5  # of the scene's own time
STEPS = 5e-4, 2.5e-4  # relative changes of the numbers, of differences
PROPERTIES = {
    "engines": Property(
        "Machine code and diffrax reach the same states at a tolerance of 1e-10", 1e-6, "what the motion makes of it"
    ),
    "batch": Property(
        "A member of a batch is what it is alone", 1e-9, "at a tolerance of 1e-10, in whose last digits steps may differ"
    ),
    "jit": Property("A run under jit is what it is outside", 1e-9, "as above"),
    "energy of a run": Property("Without drivers and friction, energy is kept", 1e-7, "at a tolerance of 1e-10"),
    "closure of a run": Property("All joints stay closed along a run", 1e-8, "two Newton steps after each step, to rounding"),
    "forward derivative": Property(
        "jvp is the limit of central differences", 1e-4, "differences of runs at a tolerance of 1e-10"
    ),
    "reverse derivative": Property("vjp is the transpose of jvp", 1e-6, "runs at a tolerance of 1e-10"),
    "impact energy": Property(
        "Energy never grows in an impact, or later", 1e-7, "runs at a tolerance of 1e-8, of the largest energy"
    ),
    "impact pull": Property("No impulse of a contact pulls", 1e-7, "of the largest impulse, as above"),
    "impact depth": Property("No contact is passed", 1e-6, "of the scene's length, as above"),
}
Batch = tuple[Any, Any, Any]  # mechanisms, initial states, output times


def batch_of(scenes: list[RandomScene], times: int = 3) -> Batch:
    """Stack mechanisms of one structure, their states and times."""
    mechanisms = [build(scene.table) for scene in scenes]
    states = [udk.State(*state_of(scene.table)) for scene in scenes]
    stack: Callable[[list[Any]], Any] = lambda x: jax.tree.map(lambda *leaves: jnp.stack(leaves), *x)  # noqa: E731
    return stack(mechanisms), stack(states), jnp.array([np.linspace(0.0, SPAN * scene.time, times) for scene in scenes])


def _analysis_of(first: udk.Analysis, mechanism: Any) -> udk.Analysis:
    return dataclasses.replace(first, scales=traced_scales(mechanism))


def _runner(first: udk.Analysis, engine: Any) -> Callable[..., Any]:
    def run(mechanism: Any, state: Any, ts: Any) -> Any:
        chosen = _analysis_of(first, mechanism)
        return udk.simulate(mechanism, ts, state, TOL, TOL, throw=False, analysis=chosen, engine=engine, max_steps=2000)

    return run


def check_runs(tally: Tally, seed: int, structures: Iterable[int], members: int, by_diffrax: bool, derivatives: bool) -> int:
    """Check all properties of runs on some mechanisms of each structure; return how many there were."""
    count = 0
    for structure in structures:
        scenes = [random_scene(seed, structure, number, bodies=(1, 3)) for number in range(members)]
        scenes = [scene for scene in scenes if (s := solve(scene)).is_clear and s.condition < 1e3]
        if not scenes:
            continue
        first = udk.analyse(build(scenes[0].table))
        if first.redundant_rows is None:
            tally.leave_out("closed positions nearby are not found, or all are singular", len(scenes))
            continue
        count += len(scenes)
        batch = batch_of(scenes)
        native = jax.jit(jax.vmap(_runner(first, "native")))
        found = native(*batch)
        ended = np.asarray(found.code) == udk.Result.successful
        tally.leave_out("a run ends early, by its own word", int(np.sum(~ended)))
        unit = np.array([[scene.length, scene.length, 1.0] for scene in scenes])[:, None, None, :]
        q = np.asarray(found.q) / unit
        size = np.maximum(1.0, np.max(abs(q), axis=(1, 2, 3)))
        if by_diffrax:
            other = jax.jit(jax.vmap(_runner(first, "diffrax")))(*batch)
            both = ended & (np.asarray(other.code) == udk.Result.successful)
            tally.leave_out(
                "the engines end differently", int(np.sum(ended != (np.asarray(other.code) == udk.Result.successful)))
            )
            for k in np.flatnonzero(both):
                tally.add("engines", np.max(abs(np.asarray(other.q)[k] / unit[k] - q[k])) / size[k], scenes[k].label)
        _check_single(tally, scenes, batch, first, q, size, ended, unit)
        _check_energy(tally, scenes, batch, found, ended)
        if derivatives:
            _check_derivatives(
                tally, scenes, names_of(build(scenes[0].table)), batch, native, ended, np.random.default_rng([seed, structure, 3])
            )
    return count


def _member(batch: Any, k: int) -> Any:
    return jax.tree.map(lambda x: x[k], batch)


def _check_single(tally: Tally, scenes: Any, batch: Batch, first: udk.Analysis, q: Any, size: Any, ended: Any, unit: Any) -> None:
    jitted = eqx.filter_jit(_runner(first, "native"))
    for k in np.flatnonzero(ended)[:4]:
        mechanism, state, ts = _member(batch, k)
        alone = _runner(first, "native")(mechanism, state, np.asarray(ts))
        tally.add("batch", np.max(abs(np.asarray(alone.q) / unit[k] - q[k])) / size[k], scenes[k].label)
        if k == np.flatnonzero(ended)[0]:
            under = jitted(mechanism, state, ts)
            tally.add("jit", np.max(abs(np.asarray(under.q - alone.q) / unit[k])) / size[k], scenes[k].label)


def _check_energy(tally: Tally, scenes: Any, batch: Batch, found: Any, ended: Any) -> None:
    """Energy by the formulas of the reference."""
    from experiments.parts.reference_equations import evaluate

    table = scenes[0].table
    lossy = [f for f in table["force"] if f["type"] in ("friction", "torque", "force") or f.get("damping")]
    for k in np.flatnonzero(ended):
        scene, q, v = scenes[k], np.asarray(found.q)[k], np.asarray(found.v)[k]
        ends = [evaluate(scene.table, float(t), x, dx) for t, x, dx in zip(np.asarray(batch[2])[k], q, v, strict=True)]
        if len(ends[0].psi):
            weights = solve(scene).weights
            tally.add("closure of a run", max(np.max(abs(weights * e.psi)) for e in ends), scene.label)
        if not lossy and not table["driver"]:
            energy = np.array([0.5 * e.mass @ dx.ravel() ** 2 + e.potential for e, dx in zip(ends, v, strict=True)])
            kinetic = max(0.5 * e.mass @ dx.ravel() ** 2 for e, dx in zip(ends, v, strict=True))
            unit = max(kinetic, scene.mass * (scene.length / scene.time) ** 2)
            tally.add("energy of a run", np.max(abs(energy - energy[0])) / unit, scene.label)


def _check_derivatives(tally: Tally, scenes: Any, names: Any, batch: Batch, native: Any, ended: Any, rng: Any) -> None:
    """Change masses, inertias, gravity and forces, which open no loop, each relative to itself."""
    mechanisms, states, ts = batch

    leaves, tree = jax.tree.flatten(mechanisms)
    loads = re.compile(r"gravity|force\..*|body\..*\.(mass|inertia)")
    changes = [x * rng.standard_normal(x.shape) * bool(loads.fullmatch(name)) for name, x in zip(names, leaves, strict=True)]
    along = jax.tree.unflatten(tree, changes)
    unit = np.array([[s.length, s.length, 1.0] for s in scenes])[:, None, :]
    end: Callable[[Any], Any] = lambda m: native(m, states, ts).q[:, -1] / unit  # noqa: E731
    move: Callable[[float], Any] = lambda h: jax.tree.map(lambda x, d: x + h * d, mechanisms, along)  # noqa: E731
    coarse, fine = (np.asarray(end(move(h)) - end(move(-h))) / (2 * h) for h in STEPS)
    difference = (4 * fine - coarse) / 3
    _, forward = jax.jit(lambda m, d: jax.jvp(end, (m,), (d,)))(mechanisms, along)
    weights = jnp.asarray(rng.standard_normal(forward.shape))
    back = jax.jit(lambda m, w: jax.vjp(end, m)[1](w)[0])(mechanisms, weights)
    paired = jax.tree.map(lambda g, d: np.sum(np.asarray(g * d).reshape(len(scenes), -1), 1), back, along)
    reverse = np.sum(jax.tree.leaves(paired), axis=0)
    forward = np.asarray(forward)
    for k in np.flatnonzero(ended):
        size = max(np.max(abs(difference[k])), 1e-3)
        settled = np.max(abs(fine[k] - coarse[k])) < 1e-2 * size  # else the motion bends within a step
        if settled:
            tally.add("forward derivative", np.max(abs(forward[k] - difference[k])) / size, scenes[k].label)
        else:
            tally.leave_out("differences do not settle")
        terms = abs(np.asarray(weights)[k] * forward[k]).sum()
        tally.add(
            "reverse derivative",
            abs(reverse[k] - np.sum(np.asarray(weights)[k] * forward[k])) / max(terms, 1e-3),
            scenes[k].label,
        )


# --- contacts


def check_contacts(tally: Tally, seed: int, members: int) -> int:
    """Throw plates with feet, loose and jointed, onto a floor; return how many."""
    count = 0
    for jointed in (False, True):
        rng = np.random.default_rng([seed, jointed])
        drawn = [_plates(rng, jointed) for _ in range(members)]
        stack: Callable[[list[Any]], Any] = lambda x: jax.tree.map(lambda *leaves: jnp.stack(leaves), *x)  # noqa: E731
        mechanisms, events, ts = (stack([d[i] for d in drawn]) for i in range(3))
        first = udk.analyse(drawn[0][0])

        def run(m: Any, e: Any, t: Any, first: udk.Analysis = first) -> Any:
            chosen = _analysis_of(first, m)
            return udk.simulate(m, t, events=e, throw=False, analysis=chosen, max_events=48, max_steps=5000)

        found = jax.jit(jax.vmap(run))(mechanisms, events, ts)
        for k, (mechanism, feet, _, length) in enumerate(drawn):
            _check_impacts(tally, mechanism, feet, length, _member(found, k), f"plates({seed}, {jointed}), {k}")
        count += members
    return count


def _plates(rng: np.random.Generator, jointed: bool) -> tuple[udk.Mechanism, Any, Any, float]:
    length, mass = 10 ** rng.uniform(-4, 2), 10 ** rng.uniform(-3, 3)
    speed = np.sqrt(9.81 * length)
    bodies, feet = {}, []
    for k, name in enumerate("ab"[: 1 + jointed]):
        start = {"position": length * np.array([1.0 * k, rng.uniform(1.2, 2.0)]), "angle": rng.uniform(-0.5, 0.5)}
        start |= {"velocity": speed * rng.uniform(-0.5, 0.5, 2), "angular_velocity": speed / length * rng.uniform(-1, 1)}
        bodies[name] = udk.Body(mass * rng.uniform(0.5, 2.0), mass * length**2 * rng.uniform(0.05, 0.2), **start)
        for side in (-0.5, 0.5):
            restitution = rng.uniform(0.0, 0.8)
            feet.append(udk.Contact(name, [side * length, -0.2 * length], restitution=restitution, name=f"{name}{side}"))
    joints = {"hinge": udk.Revolute(["a", "b"], length * np.array([[0.5, 0.1], [-0.5, 0.1]]))} if jointed else {}
    return udk.Mechanism(bodies, joints), feet, np.linspace(0.0, 3.0, 7) * np.sqrt(length / 9.81), length


def _check_impacts(tally: Tally, mechanism: udk.Mechanism, feet: Any, length: float, found: Any, at: str) -> None:
    mass = np.array([[float(b.mass), float(b.mass), float(b.inertia)] for b in mechanism.bodies.values()])
    energy: Callable[[Any, Any], Any] = lambda q, v: np.sum(0.5 * mass * v**2 + [0.0, 9.81, 0.0] * mass * q, axis=(-2, -1))  # noqa: E731
    q, v, reached = np.asarray(found.q), np.asarray(found.v), np.isfinite(np.asarray(found.q)).all((1, 2))
    result = udk.Result(int(found.code))
    if result not in (udk.Result.successful, udk.Result.event_limit):
        tally.leave_out(f"contacts: {result.name}")
    q, v = q[reached], v[reached]
    along, unit = energy(q, v), mass[:, 0].sum() * 9.81 * length
    tally.add("impact energy", max(0.0, np.max(np.diff(along), initial=0.0)) / unit, at)
    heights = [_heights(q, mechanism, foot) for foot in feet]
    tally.add("impact depth", max(0.0, -np.min(heights)) / length, at)
    events = found.events
    for e in range(min(int(events.count), len(events.time))):
        before, after = (
            energy(*(np.asarray(x)[e] for x in pair))
            for pair in ((events.q_before, events.v_before), (events.q_after, events.v_after))
        )
        tally.add("impact energy", max(0.0, float(after - before)) / unit, at)
        jump = (mass * (np.asarray(events.v_after)[e] - np.asarray(events.v_before)[e])).ravel()
        _check_pull(tally, mechanism, feet, np.asarray(events.q_before)[e], jump, mass, length, at)


def _heights(q: np.ndarray, mechanism: udk.Mechanism, foot: Any) -> np.ndarray:
    k, p = mechanism.body_names.index(foot.body), np.asarray(foot.point)
    return q[..., k, 1] + np.sin(q[..., k, 2]) * p[0] + np.cos(q[..., k, 2]) * p[1]


def _check_pull(tally: Tally, mechanism: Any, feet: Any, q: Any, jump: Any, mass: Any, length: float, at: str) -> None:
    """Split a jump into impulses of the hinge and of the feet that touch; by least squares, not negative."""
    from scipy.optimize import nnls

    rows = []
    for foot in feet:
        if abs(_heights(q, mechanism, foot)) < 1e-5 * length:
            k, p, angle = (
                mechanism.body_names.index(foot.body),
                np.asarray(foot.point),
                q[mechanism.body_names.index(foot.body), 2],
            )
            row = np.zeros(q.size)
            row[3 * k + 1], row[3 * k + 2] = 1.0, np.cos(angle) * p[0] - np.sin(angle) * p[1]
            rows.append(row)
    ties = np.zeros((0, q.size))
    for joint in mechanism.joints.values():
        ties = np.zeros((2, q.size))
        for k, sign in ((0, -1.0), (1, 1.0)):
            p, angle = np.asarray(joint.points[k]), q[k, 2]
            arm = np.array([np.cos(angle) * p[0] - np.sin(angle) * p[1], np.sin(angle) * p[0] + np.cos(angle) * p[1]])
            ties[:, 3 * k : 3 * k + 3] = sign * np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
    unit = np.tile([1.0, 1.0, 1.0 / length], len(q))
    columns = np.vstack([*rows, *ties, *-ties]).T * unit[:, None] if rows or len(ties) else np.zeros((q.size, 1))
    size = np.max(abs(jump * unit))
    if size:
        tally.add("impact pull", nnls(columns, jump * unit)[1] / max(size, 1e-6 * mass[:, 0].sum() * np.sqrt(9.81 * length)), at)
