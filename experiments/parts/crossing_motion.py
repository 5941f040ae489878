"""Rows of the table of functions by models: motions, forces and balances."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.crossing_case import EXACT, TS, Case, WrongError, agree, by_twin, claim


def simulate(case: Case) -> str:
    twin, by = case.twin
    agree(udk.simulate(twin, TS, case.state, events=case.events, throw=False, **EXACT).q, case.run.q, by, 1e-6)
    return by


def simulate_engine(case: Case) -> str:
    other = udk.simulate(case.model, TS, case.state, events=case.events, throw=False, engine="jax", **EXACT)
    return agree(other.q, case.run.q, "diffrax", 1e-5)


def simulate_jit(case: Case) -> str:
    run = jax.jit(lambda m, s: udk.simulate(m, TS, s, events=case.events, throw=False, **EXACT).q)
    return agree(run(case.model, case.state), case.run.q, "jit", 1e-7)


def simulate_vmap(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])

    def q(x: Any) -> Any:
        changed = case.model.with_parameters({name: x})
        return udk.simulate(changed, TS, case.state, events=case.events, throw=False, **EXACT).q

    several = jax.vmap(q)(jnp.stack([x0, 1.01 * x0, 1.02 * x0]))
    agree(several[0], case.run.q, "vmap", 1e-6)
    return agree(several[2], q(1.02 * x0), "vmap", 1e-6)


def simulate_derivative(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])

    def last(x: Any) -> Any:
        run = udk.simulate(case.model.with_parameters({name: x * x0}), TS, case.state, events=case.events, throw=False, **EXACT)
        return jnp.sum(jnp.sin(run.q[case.reached - 1]))

    h = 1e-4
    wanted = (last(1.0 + h) - last(1.0 - h)) / (2 * h)
    agree(jax.jvp(last, (1.0,), (1.0,))[1], wanted, "differences", 1e-4)
    return agree(jax.grad(last)(1.0), wanted, "differences, forward and reverse", 1e-4)


def step(case: Case) -> str:
    end = udk.step(case.model, case.state, None, TS[1], **EXACT)
    agree(end.q, case.alone.q[1], "simulate", 1e-7)
    if case.is_system:
        return "simulate"
    inputs = dict(case.model.independent_parameters())
    inputs = {k: v for k, v in inputs.items() if not k.endswith(".values")}
    again = udk.step(case.model, case.state, inputs, TS[1], **EXACT)
    return agree(again.q, case.alone.q[1], f"simulate, with {len(inputs)} inputs", 1e-7)


def assemble(case: Case) -> str:
    one = np.asarray(case.state.q)[None], np.asarray(case.state.v)[None]
    psi = udk.violation(case.model, case.alone)
    if np.abs(np.asarray(psi)[0]).max(initial=0.0) > 1e-9 * (1 + np.abs(one[0]).max()):
        raise WrongError("the assembled state violates constraints")
    return agree(udk.assemble(case.twin[0]).q, case.state.q, f"Psi = 0, {case.twin[1]}")


def accelerations(case: Case) -> str:
    a = udk.accelerations(case.model, 0.0, case.state.q, case.state.v)
    h = 1e-4
    v = udk.simulate(case.model, [0.0, h, 2 * h, 3 * h], case.state, rtol=1e-12, atol=1e-12).v
    by_v = (-11 * v[0] + 18 * v[1] - 9 * v[2] + 2 * v[3]) / (6 * h)
    twin, by = case.twin
    agree(udk.accelerations(twin, 0.0, case.state.q, case.state.v), a, by, 1e-8)
    return agree(by_v, np.reshape(a, np.shape(by_v)), f"differences of v, {by}", 1e-3)


def energy(case: Case) -> str:
    found = udk.energy(case.model, case.run)
    agree(udk.energy(case.twin[0], case.run), found, case.twin[1])
    if case.is_system:
        return case.twin[1]
    mass = np.array([[float(b.mass)] * 2 + [float(b.inertia)] for b in case.model.bodies.values()])
    return agree(found.kinetic, 0.5 * np.sum(mass * np.asarray(case.run.v) ** 2, (1, 2)), f"v M v / 2, {case.twin[1]}")


def violation(case: Case) -> str:
    psi = np.asarray(udk.violation(case.model, case.alone))
    if np.abs(psi).max(initial=0.0) > 1e-7:
        raise WrongError(f"Psi {np.abs(psi).max():.2g}")
    return "Psi = 0"


def reactions(case: Case) -> str:
    found = udk.reactions(case.model, case.alone)
    by = agree(udk.reactions(case.twin[0], case.alone), found, case.twin[1])
    if case.is_system or case.model.forces or case.model.driver_names:
        return by
    bodies, g = case.model.body_names, np.asarray(case.model.gravity)
    total = np.zeros(np.shape(case.alone.q))
    for loads in found.values():
        for body, x in loads.items():
            if body in bodies:
                total[:, bodies.index(body)] += np.asarray(x)
    for k, b in enumerate(case.model.bodies.values()):
        total[:, k, :2] += float(b.mass) * g
        total[:, k] /= [float(b.mass), float(b.mass), float(b.inertia)]
    a = np.array([udk.accelerations(case.model, t, q, v) for t, q, v in zip(TS, case.alone.q, case.alone.v, strict=True)])
    return agree(total, a.reshape(total.shape), f"Newton's law, {by}", 1e-6)


def power(case: Case) -> str:
    relative = float(udk.power_balance(case.model, case.alone).relative)
    if relative > 1e-6:
        raise WrongError(f"power is not balanced: {relative:.2g}")
    return "balance of power"


def step_names(case: Case) -> str:
    """Each name of `parameters()` by itself is an input of `step`, as it is one of `with_parameters`."""
    m, dt, names, state = case.model, 0.01, 0, case.state
    for name, x in (m.parameters() if case.is_system else m.independent_parameters()).items():
        if name.endswith(".values"):  # of a `Held`, which takes no inputs
            continue
        given = {name: 1.001 * np.asarray(x) + 1e-6}
        try:
            changed = m.with_parameters(given)
            state = udk.assemble(changed, throw=False)
            wanted = udk.step(changed, state, None, dt)
        except (udk.SceneError, udk.SimulationError) as refusal:  # both refuse: a radius that does not fit its gear, an open loop
            try:
                udk.step(m, state, given, dt)
            except (udk.SceneError, udk.SimulationError):
                continue
            raise WrongError(f"{name}: step takes what with_parameters refuses: {refusal}") from refusal
        found = udk.step(m, state, given, dt)
        agree([found.q, found.v], [wanted.q, wanted.v], f"with_parameters, of {name}", 1e-9)
        names += 1
    return f"with_parameters, {names} names"


def reaction_peaks(case: Case) -> str:
    """Peaks between outputs are those of many outputs, except where friction or a sample lets a reaction jump."""
    runs = [udk.simulate(case.model, np.linspace(0.0, 0.2, n), case.state, **EXACT) for n in (401, 1601)]
    peaks = udk.reaction_peaks(case.model, runs[0])
    forces = udk.reactions(case.model, runs[1], about="joint")
    largest = {j: {b: np.hypot(x[:, 0], x[:, 1]).max() for b, x in by.items()} for j, by in forces.items()}
    return agree({j: {b: x.force for b, x in by.items()} for j, by in peaks.items()}, largest, "reactions at 1601 times", 2e-2)


def envelope(case: Case) -> str:
    both = [udk.reaction_peaks(case.model, case.alone)]
    heavier = case.model.with_parameters({case.number: 2.0 * np.asarray(case.model.parameters()[case.number])})
    both += [udk.reaction_peaks(heavier, case.alone)]
    found = udk.envelope(both)
    wanted = {j: {b: max(float(x[j][b].force) for x in both) for b in by} for j, by in found.items()}
    return agree({j: {b: x.force for b, x in by.items()} for j, by in found.items()}, wanted, "the larger peak", 1e-12)


def pin_reactions(case: Case) -> str:
    """The force at a pin of a single joint is the reaction of this joint."""
    found, forces = udk.pin_reactions(case.model, case.alone), udk.reactions(case.model, case.alone)
    single = [pin for pin in found if pin in forces and f"{pin}-2" not in forces]
    for pin in single:
        for body, load in found[pin].items():
            agree(load[:, :2], forces[pin][body][:, :2], f"reactions of {pin}")
    return by_twin(lambda case, m: list(udk.pin_reactions(m, case.alone).values()))(case) + f", reactions of {len(single)} joints"


def inverse(case: Case) -> str:
    m = case.model
    if not case.is_system and m.driver_names:
        return agree(udk.inverse_dynamics(m, TS).efforts, udk.efforts(m, case.alone), "efforts of the run", 1e-4)
    # A motion without drivers needs none.
    drivers = [case.driver, *(case.held or {})]
    free = udk.inverse_dynamics(m, TS, case.accelerated, drivers)
    resting = udk.inverse_dynamics(m, TS[:1], _at_rest(case), drivers)
    scale = max([float(np.abs(x).max()) for x in resting.efforts.values()] + [1e-3])
    worst = max(float(np.abs(x).max()) for x in free.efforts.values())
    claim(worst < 1e-5 * scale, f"a free motion needs {worst:.2g} of {scale:.2g}")
    return "no effort along the free motion"


def _at_rest(case: Case) -> Any:
    return udk.kinematics(case.model, case.driver, case.values(1), held=case.held, rate=0.0)


def feed_forward(case: Case) -> str:
    """A mechanism with the efforts that a motion needs follows it."""
    m, ts = case.model, np.linspace(-0.1, 0.2, 181)
    if not case.is_system and m.driver_names:
        wanted = udk.kinematics(m, None, ts)
        needed = udk.inverse_dynamics(m, ts)
    else:
        s = case.values(1)[0] + 0.3 * ts + 0.5 * ts**2
        wanted = udk.kinematics(m, case.driver, s, held=case.held, rate=0.3 + ts, acceleration=np.ones_like(ts))
        needed = udk.inverse_dynamics(m, ts, wanted, [case.driver, *(case.held or {})])
    first = int(np.argmin(np.abs(ts)))
    start = udk.State(wanted.q[first], wanted.v[first])
    run = udk.simulate(udk.feed_forward(m, needed), ts[first:151], start, **EXACT)
    return agree(run.q, wanted.q[first:151], "kinematics", 1e-5)


def step_engine(case: Case) -> str:
    found = udk.step(case.model, case.state, None, TS[1], engine="jax", **EXACT)
    return agree([found.q, found.v], [case.alone.q[1], case.alone.v[1]], "simulate by machine code", 1e-6)


def singular_values(case: Case) -> str:
    """Their number is that of the rows; all are those of the twin."""
    found = np.asarray(udk.singular_values(case.model, 0.0, case.state.q))
    claim((np.diff(found) <= 0).all() and (found >= 0).all(), "not in order")
    return by_twin(lambda case, m: udk.singular_values(m, 0.0, case.state.q))(case)


def efforts(case: Case) -> str:
    """The power of all drivers is that of the balance of power."""
    m, run = case.model, case.alone
    found = udk.efforts(m, run)
    by = agree(udk.efforts(case.twin[0], run), found, case.twin[1])
    if not found:
        return f"no driver, {by}"
    needed = udk.inverse_dynamics(m, TS)
    return agree(found, needed.efforts, f"inverse_dynamics, {by}", 1e-4)


def friction_loads(case: Case) -> str:
    """On the two bodies of a joint they are opposite; they take power."""
    found = udk.friction_loads(case.model, case.alone)
    by = agree(udk.friction_loads(case.twin[0], case.alone), found, case.twin[1])
    if not found:
        return f"no friction, {by}"
    bodies = case.model.body_names
    for name, loads in found.items():
        speeds, on = np.asarray(case.alone.v), [b for b in loads if b in bodies]
        power = sum((np.sum(np.asarray(loads[b]) * speeds[:, bodies.index(b)], 1) for b in on), np.zeros(len(speeds)))
        claim((power <= 1e-9 * (1e-3 + np.abs(power).max())).all(), f"{name} gives power: {power.max():.2g}")
    return f"takes power, {by}"
