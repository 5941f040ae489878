"""Properties of runs of scenes in which many features meet."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.mixed_case import (
    MIDDLE,
    SPAN,
    Case,
    difference,
    difference_of_events,
    ending,
    extrapolated,
    happened,
    stack,
    states,
)
from experiments.parts.mixed_scenes import build, events
from experiments.parts.random_scenes import RandomScene, state_of
from experiments.parts.scene_views import can_be_turned, delayed, in_units, mirrored, moved, permuted
from experiments.parts.tally import Property

DOUBT = 0.3  # part of a property's tolerance by which differences may be uncertain
CONVERGES = 0.1  # part of the error of a loose tolerance that is left by a thousandth of it
UNITS = ((1e3, 1.0, 1e3), (1e3, 1.0, 1e-3), (1e-3, 1e-2, 1e-6), (1e3, 30.0, 1e9), (1.0, 10.0, 1.0), (1e-6, 1e-4, 1e-12))
GROWN = "the scene's own growth of errors, if it is larger"
SAME = f"runs at a tolerance of 1e-9, or {GROWN}"
PROPERTIES = {
    "converged": Property("A thousandth of the tolerance leaves a tenth of the error, or hardly any", 1e-5, SAME),
    "endings": Property("Runs of one scene end for the same reason", 0.5, "a count"),
    "events": Property("The same events happen at any tolerance, at the same times", 1e-5, SAME),
    "order of events": Property("Times of events never go back", 1e-14, "rounding of a time"),
    "moved and mirrored": Property("A scene that is turned, moved, mirrored and delayed moves alike", 1e-6, SAME),
    "rescaled": Property("So does a scene in other units, from micrometres to kilometres", 1e-6, SAME),
    "permuted": Property("So does a scene whose elements have another order", 1e-6, SAME),
    "continued": Property("A run that is stopped and continued arrives where one run does", 1e-6, SAME),
    "lanes": Property("Runs in a batch are those alone", 1e-7, "last digits, in which steps may differ"),
    "jit": Property("A run under jit is the one outside", 1e-7, "last digits, in which steps may differ"),
    "other engine": Property("Diffrax arrives where machine code does", 1e-6, SAME),
    "other methods": Property("So do pseudoinverses, formulations and stabilizations", 1e-5, "as above, and drift"),
    "other solvers": Property("So do Adams, BDF and Kvaerno5", 1e-5, "as above, and their local errors"),
    "sweep": Property("A sweep has the runs of its members", 1e-7, "last digits, in which steps may differ"),
    "forward and reverse": Property("Forward and reverse derivatives of runs are the same", 1e-6, "both by the same steps"),
    "derivative": Property("They are the limits of differences, through all events", 1e-4, "differences of runs at 1e-11"),
    "second derivative": Property(
        "So are second derivatives, without events or with Log and Stop", 1e-3, "differences of gradients"
    ),
}
CHANGES = {"set-valued", "release", "attach", "lock", "contact", "limit"}  # events after which equations or velocities are others
METHODS: tuple[dict[str, Any], ...] = (
    *({"method": m()} for m in (udk.SVD, udk.Greville, udk.GramSchmidt, udk.Householder, udk.Varga, udk.Elimination)),
    *({"formulation": f} for f in (udk.NullSpaceQR(), udk.NullSpaceSVD(), udk.Augmented(udk.SVD()))),
    *({"stabilization": s} for s in (udk.Baumgarte(5.0, 5.0), None)),
)


def check_tolerances(case: Case) -> None:
    """Compare runs at three tolerances."""
    loose, middle, tight = case.loose, case.middle, case.tight
    error, smaller = difference(loose, tight), difference(middle, tight)
    detail = f"{ending(loose)} {ending(middle)} {ending(tight)}"
    case.check("converged", 0.0 if smaller <= CONVERGES * error else smaller, detail)
    case.check("endings", float(len({_reason(run) for run in (loose, middle, tight)}) > 1), detail)
    if any(" rests" in name for run in (middle, tight) for name, _ in happened(run)):
        case.tally.leave_out("events of impacts that accumulate, whose number the tolerance decides")
    elif middle.result.is_success and _changes_of_joints(middle) < _changes_of_joints(tight):
        case.tally.leave_out("events of joints at speeds that the looser tolerance does not show")
    elif middle.result.is_success:
        case.check("events", difference_of_events(middle, tight) / case.growth, detail)
    back = max(-np.diff([t for _, t in happened(tight)]), default=0.0)
    case.check("order of events", max(back, 0.0), detail)


def _reason(run: Any) -> Any:
    """Return why a run ended. Beyond the reach of a driver, steps become too small, or positions drift at loose tolerances."""
    return "reach" if not run.result.is_success and "; the linkage reaches" in (run.cause or "") else run.result


def _changes_of_joints(run: Any) -> int:
    return sum(name.endswith((" turns round", " sticks", " slips")) for name, _ in happened(run))


def _seen(case: Case, name: str, scene: RandomScene, restore: Callable[[np.ndarray], np.ndarray], ts: Any) -> None:
    """Run another view of the scene, and compare its states, which `restore` brings back,."""
    state = udk.State(*state_of(scene.table))
    found = case.run(MIDDLE, ts, state, build(scene.table), events=events(scene.table))
    case.check(name, difference(restore(states(found)), case.middle) / case.growth, f"{ending(found)} {ending(case.middle)}")
    case.check("endings", float(found.result != case.middle.result), f"{name} {ending(found)} {ending(case.middle)}")


def check_views(case: Case) -> None:
    """Run the scene turned, moved, mirrored and delayed; in other units; and in another order."""
    rng, scene = case.rng, case.scene
    angle, shift, time = float(rng.uniform(-3, 3)), rng.uniform(-2, 2, 2), float(rng.choice([0.0, rng.uniform(-2, 2)]))
    if can_be_turned(scene.table):
        flips = bool(rng.random() < 0.5)
        back = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        sign = np.array([-1.0 if flips else 1.0, 1.0])

        def restore(y: np.ndarray) -> np.ndarray:
            place, rate = (x @ back.T * sign for x in (y[..., :2] - shift, y[..., 3:5]))
            turned, spin = y[..., 2:3] - angle, y[..., 5:]
            return np.concatenate([place, sign[0] * turned, rate, sign[0] * spin], axis=-1)

        seen = delayed(moved(mirrored(scene) if flips else scene, angle, shift), time)
        _seen(case, "moved and mirrored", seen, restore, case.ts + time)
    L, T, M = UNITS[int(rng.integers(len(UNITS)))]
    unit = np.array([L, L, 1.0, L / T, L / T, 1 / T])
    _seen(case, "rescaled", in_units(scene, L, T, M), lambda y: y / unit, case.ts * T)
    other = permuted(scene.table, rng)
    names = [body["name"] for body in other["body"]]
    order = [names.index(body["name"]) for body in scene.table["body"]]
    _seen(case, "permuted", scene._replace(table=other), lambda y: y[:, order], case.ts)


def check_parts(case: Case) -> None:
    """Stop a run somewhere, and continue it. What an event has changed for good, a new run does not know."""
    if case.kinds & {"release", "attach", "lock"} or not case.middle.result.is_success:
        return
    time = float(case.rng.uniform(0.2, 0.8) * SPAN)
    first = case.run(MIDDLE, [0.0, time])
    if not first.result.is_success or first.result == udk.Result.event_stop:
        return
    last = case.run(MIDDLE, [time, SPAN], udk.State(first.q[-1], first.v[-1]))
    error = difference(states(last)[-1], states(case.middle)[-1]) / case.growth
    case.check("continued", error, f"at {time} {ending(last)} {ending(case.middle)}")


def check_lanes(cases: list[Case]) -> None:
    """Run scenes of one structure as a batch at two tolerances, and each alone."""
    first = cases[0]

    def run(mechanism: Any, given: Any, q: Any, v: Any) -> Any:
        found = first.run(MIDDLE, first.ts, udk.State(q, v), mechanism, events=given)
        return found.q, found.v, found.code

    batch = stack([(case.mechanism, case.events, case.state.q, case.state.v) for case in cases])
    jitted = jax.jit(run)
    q, v, code = (np.asarray(x) for x in jax.jit(jax.vmap(run))(*batch))
    for k, case in enumerate(cases):
        found, alone = np.concatenate([q[k], v[k]], axis=-1), case.middle
        detail = f"{udk.Result(int(code[k])).name} {ending(alone)}"
        case.check("lanes", difference(found, alone) / case.growth, detail)
        case.check("endings", float(int(code[k]) != int(alone.code)), f"lanes {detail}")
    under = jitted(first.mechanism, first.events, first.state.q, first.state.v)
    found = np.concatenate([np.asarray(x) for x in under[:2]], axis=-1)
    first.check("jit", difference(found, first.middle) / first.growth, ending(first.middle))


def check_engines(case: Case) -> None:
    """Repeat the run by diffrax, by other methods and by other solvers."""
    import diffrax

    def tried(name: str, settings: dict[str, Any], ends_alike: bool = True) -> None:
        try:
            found = case.run(MIDDLE, **settings)
        except ValueError as error:  # what cannot be done is said
            case.tally.leave_out(f"refused: {str(error).splitlines()[0][:100]}")
            return
        if is_stiff and found.result == udk.Result.step_limit and found.settings["engine"].startswith("diffrax"):
            case.tally.leave_out("stiff scenes that take a solver of diffrax too many steps, and it says so")
            return
        if ends_alike:
            case.check_runs(name, found, case.middle, str(settings))
        elif found.result == case.middle.result:
            case.check(name, difference(found, case.middle) / case.growth, f"{settings} {ending(found)} {ending(case.middle)}")

    # By itself, that engine does not go on with implicit steps where a problem is stiff.
    is_stiff = int(case.middle.stats["implicit"]) > 0
    tried("other engine", {"engine": "diffrax"} | ({"solver": diffrax.Kvaerno5()} if is_stiff else {}))
    for k in case.rng.choice(len(METHODS), 2, replace=False):
        tried("other methods", METHODS[k], "stabilization" not in METHODS[k])
    solvers = udk.Adams(), udk.BDF(), diffrax.Kvaerno5()
    tried("other solvers", {"solver": solvers[int(case.rng.integers(3))]}, False)


def check_sweep(case: Case) -> None:
    """Sweep one number, and run the members one by one."""
    if not case.varied:
        return
    name, value = next(iter(case.varied.items()))
    values = value * np.array([1.0, 1.01, 0.98])
    given: dict[str, Any] = {"events": case.events} if case.events else {}
    found = udk.sweep(
        case.mechanism, {name: values}, [0.0, SPAN], progress=False, rtol=MIDDLE, atol=MIDDLE, state=case.state, **given
    )
    for k, x in enumerate(values):
        alone = case.run(MIDDLE, [0.0, SPAN], mechanism=case.mechanism.with_parameters({name: float(x)}))
        error = difference(np.asarray(found.q_end)[k], np.asarray(alone.q)[-1]) / case.growth
        case.check("sweep", error if int(found.result[k]) == int(alone.code) else np.inf, f"{name} {ending(alone)}")


def check_derivatives(case: Case) -> None:
    """Differentiate a number of the last state: forward, in reverse, by differences."""
    if not case.tight.result.is_success or not case.varied:
        return
    if not np.isfinite(states(case.tight)[-1]).all():
        case.tally.leave_out("derivatives of a state that a stop prevents")
        return
    f, x, names = case.end(), np.ones(len(case.varied)), list(case.varied)
    forward, reverse = np.asarray(jax.jacfwd(f)(jnp.asarray(x))), np.asarray(jax.grad(f)(jnp.asarray(x)))
    along, size = case.rng.standard_normal(len(x)), 1e-3 + np.max(np.abs(forward))
    detail = f"{names} {forward} {reverse} {ending(case.tight)}"
    case.check("forward and reverse", float(np.max(np.abs(forward - reverse)) / size), detail)
    _check_by_differences(case, "derivative", lambda z: f(jnp.asarray(z)), along, forward @ along, float(size), detail)


def check_second_derivatives(case: Case) -> None:
    """Differentiate twice, where the run has no events but those that change nothing."""
    if (
        not case.tight.result.is_success
        or not case.varied
        or case.kinds & {"set-valued", "contact", "limit", "release", "attach", "lock"}
    ):
        return
    f, x = case.end(), np.ones(len(case.varied))
    along, gradient = case.rng.standard_normal(len(x)), jax.grad(f)
    found = np.asarray(eqx.filter_jit(lambda z, d: jax.jvp(gradient, (z,), (d,))[1])(jnp.asarray(x), jnp.asarray(along)))
    size = 1e-2 + np.max(np.abs(found))
    detail = f"{list(case.varied)} {ending(case.tight)}"
    _check_by_differences(case, "second derivative", lambda z: gradient(jnp.asarray(z)), along, found, float(size), detail)


def _check_by_differences(
    case: Case, name: str, f: Callable[[Any], Any], along: np.ndarray, found: Any, size: float, detail: str
) -> None:
    """Compare a derivative along a direction with the most certain of some differences, relative to its size."""
    x = np.ones(len(along))
    right, doubt = min((extrapolated(f, x, along, step) for step in (2e-3, 2e-4, 2e-5)), key=_doubt)
    if not doubt <= DOUBT * case.tolerances[name] * size:
        case.tally.leave_out(f"{name}: differences do not settle")
    else:
        case.check(
            name, float(np.max(np.abs(right - found))) / size, f"{detail} along {along.tolist()}: {found}, differences {right}"
        )


def _doubt(difference: tuple[Any, float]) -> float:
    return np.nan_to_num(difference[1], nan=np.inf)
