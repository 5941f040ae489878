"""Properties of runs: both engines, partitioning, batches, jit, derivatives, powers. A structure is compiled once."""

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
from experiments.parts.state_properties import growth, names_of, solve
from experiments.parts.tally import Property, Tally
from udkjax.equations.programs.scales import traced_scales

TOL = 1e-10  # of integration
SPAN = 0.5  # of the scene's own time
RUN_BODIES = 1, 3  # least and largest number
STEPS = 5e-4, 2.5e-4  # relative changes of the numbers, of differences
PROPERTIES = {
    "engines": Property(
        "Machine code and diffrax reach the same states at a tolerance of 1e-10", 1e-6, "growth of errors along the motion"
    ),
    "batch": Property(
        "A run in a batch is the same as alone", 1e-9, "a tolerance of 1e-10, in whose last digits steps may differ"
    ),
    "jit": Property("A run under jit is the same as outside", 1e-9, "as above"),
    "energy of a run": Property("Without drivers and friction, energy is conserved", 1e-7, "a tolerance of 1e-10"),
    "CoordinatePartitioning": Property(
        "CoordinatePartitioning finds the accelerations of the reference",
        1e-10,
        "rounding, times the square of the condition number",
    ),
    "run by partitioning": Property(
        "A run by CoordinatePartitioning reaches the same states as machine code", 1e-6, "growth of errors along the motion"
    ),
    "power balance": Property(
        "Powers add up to the rates of the energies, at all times", 1e-11, "rounding, and the violation of the velocities"
    ),
    "work": Property(
        "The work of drivers and loads is the change of energy, by formulas written by hand", 1e-8, "integrals of 33 powers"
    ),
    "closure of a run": Property("All joints stay closed along a run", 1e-8, "two Newton iterations after each step"),
    "forward derivative": Property(
        "jvp is the limit of central differences", 1e-4, "differences of runs at a tolerance of 1e-10"
    ),
    "reverse derivative": Property("vjp is the transpose of jvp", 1e-6, "runs at a tolerance of 1e-10"),
}
Batch = tuple[Any, Any, Any]  # mechanisms, initial states, output times


def batch_of(scenes: list[RandomScene], times: int = 3) -> Batch:
    """Stack mechanisms of one structure, their states and times."""
    mechanisms = [build(scene.table) for scene in scenes]
    states = [udk.State(*state_of(scene.table)) for scene in scenes]
    stack: Callable[[list[Any]], Any] = lambda x: jax.tree.map(lambda *leaves: jnp.stack(leaves), *x)  # noqa: E731
    return stack(mechanisms), stack(states), jnp.array([np.linspace(0.0, SPAN * scene.time, times) for scene in scenes])


def analysis_of(first: udk.Analysis, mechanism: Any) -> udk.Analysis:
    return dataclasses.replace(first, scales=traced_scales(mechanism))


def _runner(first: udk.Analysis, engine: Any, formulation: Any = None) -> Callable[..., Any]:
    def run(mechanism: Any, state: Any, ts: Any) -> Any:
        chosen: Any = {"analysis": analysis_of(first, mechanism), "engine": engine, "formulation": formulation}
        return udk.simulate(mechanism, ts, state, TOL, TOL, throw=False, max_steps=2000, **chosen)

    return run


def check_runs(
    tally: Tally,
    seed: int,
    structures: Iterable[int],
    members: int,
    by_diffrax: bool,
    derivatives: bool,
    alter: Callable[[RandomScene], RandomScene] | None = None,
) -> int:
    """Check all properties of runs on some mechanisms of each structure; return how many there were.

    Args:
        tally: The results.
        seed: Seed of all random numbers.
        structures: Numbers of the structures.
        members: Number of mechanisms of each.
        by_diffrax: Whether runs are repeated by diffrax.
        derivatives: Whether runs are differentiated.
        alter: Adds friction to a scene; without it, the equations of the reference are those of the scene.
    """
    count = 0
    for structure in structures:
        scenes = [random_scene(seed, structure, number, bodies=RUN_BODIES) for number in range(members)]
        scenes = [scene for scene in scenes if (s := solve(scene)).is_clear and s.condition < 1e3]
        scenes = scenes if alter is None else [alter(scene) for scene in scenes]
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
        tally.leave_out("a run that ends early and reports it", int(np.sum(~ended)))
        unit = np.array([[scene.length, scene.length, 1.0] for scene in scenes])[:, None, None, :]
        q = np.asarray(found.q) / unit
        size = np.maximum(1.0, np.max(abs(q), axis=(1, 2, 3)))
        if by_diffrax:
            other = jax.jit(jax.vmap(_runner(first, "jax")))(*batch)
            both = ended & (np.asarray(other.code) == udk.Result.successful)
            tally.leave_out(
                "the engines end differently", int(np.sum(ended != (np.asarray(other.code) == udk.Result.successful)))
            )
            for k in np.flatnonzero(both):
                tally.add("engines", np.max(abs(np.asarray(other.q)[k] / unit[k] - q[k])) / size[k], scenes[k].label)
        _check_single(tally, scenes, batch, first, q, size, ended, unit)
        _check_energy(tally, scenes, batch, found, ended)
        if alter is None:
            _check_partitioning(tally, scenes, batch, first, q, size, ended, unit, by_diffrax)
        for k in np.flatnonzero(ended)[:2]:
            _check_power(tally, scenes[k])
        if derivatives:
            _check_derivatives(
                tally, scenes, names_of(build(scenes[0].table)), batch, native, ended, np.random.default_rng([seed, structure, 3])
            )
    return count


def member(batch: Any, k: int) -> Any:
    return jax.tree.map(lambda x: x[k], batch)


def _check_single(tally: Tally, scenes: Any, batch: Batch, first: udk.Analysis, q: Any, size: Any, ended: Any, unit: Any) -> None:
    jitted = eqx.filter_jit(_runner(first, "native"))
    for k in np.flatnonzero(ended)[:4]:
        mechanism, state, ts = member(batch, k)
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


def _check_partitioning(
    tally: Tally, scenes: Any, batch: Batch, first: udk.Analysis, q: Any, size: Any, ended: Any, unit: Any, integrates: bool
) -> None:
    """Accelerations at the initial states, and, if asked for, whole runs."""
    formulation = udk.CoordinatePartitioning()

    def accelerations(mechanism: Any, state: Any) -> Any:
        chosen = analysis_of(first, mechanism)
        return udk.accelerations(mechanism, 0.0, state.q, state.v, formulation=formulation, analysis=chosen)

    found = np.asarray(jax.jit(jax.vmap(accelerations))(*batch[:2])).reshape(len(scenes), -1)
    for k, scene in enumerate(scenes):
        s = solve(scene)
        size_of_a = max(np.max(abs(s.terms.force / s.terms.mass / s.unit)), np.max(abs(s.a / s.unit)), 1e-3)
        tally.add("CoordinatePartitioning", np.max(abs(found[k] - s.a) / s.unit) / size_of_a / growth(s), scene.label)
    if not integrates:
        return
    run = jax.jit(jax.vmap(_runner(first, "jax", formulation)))(*batch)
    both = ended & (np.asarray(run.code) == udk.Result.successful)
    tally.leave_out("a run by partitioning that ends early and reports it", int(np.sum(ended & ~both)))
    for k in np.flatnonzero(both):
        tally.add("run by partitioning", np.max(abs(np.asarray(run.q)[k] / unit[k] - q[k])) / size[k], scenes[k].label)


NODES = 33  # of Chebyshev's, in time; every other one is a set of 17


def _check_power(tally: Tally, scene: RandomScene) -> None:
    """Balance the powers along a run, and integrate them: the energies at its ends are those of the reference."""
    from experiments.parts.reference_equations import evaluate

    mechanism, span = build(scene.table), SPAN * scene.time
    x = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
    run = udk.simulate(mechanism, 0.5 * span * (x + 1), udk.State(*state_of(scene.table)), TOL, TOL, throw=False, max_steps=2000)
    if not run.result.is_success:
        tally.leave_out("a run that ends early and reports it")
        return
    found = udk.power_balance(mechanism, run)
    tally.add("power balance", float(found.relative), scene.label)
    rubs = [name for name, force in mechanism.forces.items() if isinstance(force, udk.Friction) and force.rubs]
    if rubs:
        takes = np.array([found.forces[name] for name in rubs])
        tally.add("friction power of a run", max(np.max(takes), 0.0) / (np.max(abs(takes)) or 1.0), scene.label)
    power = np.asarray(found.supplied)
    fine, coarse = (0.5 * span * _integral(x[::k], power[::k]) for k in (1, 2))
    ends = [(evaluate(scene.table, *(np.asarray(y)[k] for y in (run.ts, run.q, run.v))), np.asarray(run.v)[k]) for k in (0, -1)]
    energy = [0.5 * e.mass @ v.ravel() ** 2 + e.potential for e, v in ends]
    size = max(*map(abs, energy), span * np.max(abs(power)), scene.mass * (scene.length / scene.time) ** 2)
    if abs(fine - coarse) > 1e-9 * size:
        tally.leave_out("powers that 33 times cannot resolve")
        return
    tally.add("work", abs(energy[1] - energy[0] - fine) / size, scene.label)


def _integral(x: np.ndarray, y: np.ndarray) -> float:
    """Return the integral from -1 to 1 of the polynomial through values at Chebyshev's points."""
    terms = np.polynomial.chebyshev.chebint(np.polynomial.chebyshev.chebfit(x, y, len(x) - 1))
    return float(np.diff(np.polynomial.chebyshev.chebval([-1.0, 1.0], terms))[0])


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
