"""Properties of single states, of statics and of studies of scenes in which many features meet."""

import itertools
import warnings
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import linear_sum_assignment

import udkjax as udk
from experiments.parts.friction_reference import Balance, rubs_of
from experiments.parts.mixed_case import SPAN, TIGHT, Case, difference, ending
from experiments.parts.mixed_runs import CHANGES
from experiments.parts.reference_equations import Terms, evaluate
from experiments.parts.tally import Property

ORDINARY = 30.0  # condition number of the rows up to which errors are not divided by its growth
RANK = 1e-8  # singular values, relative to the largest, of rows that count
STIFF = 30.0  # damping (N m s or N s/m) beyond which SciPy's explicit method takes too long
STEP = 1e-5  # of differences around an equilibrium
EVALUATIONS = 40_000  # of the reference in one run
NEAR, FINE = (
    0.02,
    400,
)  # smallest of the singular values that count, relative to the largest, at a change point; outputs to find it
PROPERTIES = {
    "closed": Property("Joints stay closed along a run, positions and velocities", 1e-8, "Newton's method after each step"),
    "accelerations": Property("Accelerations are those of the reference", 1e-9, "rounding, and its growth"),
    "Newton's law": Property("Loads, reactions and friction add up to mass times acceleration", 1e-7, "rounding, and its growth"),
    "friction takes power": Property("Friction of both laws takes power", 1e-9, "rounding"),
    "no energy from nothing": Property("Energy never grows without drivers and loads", 1e-7, "relative, at a tolerance of 1e-11"),
    "reference": Property("A run is that of the independent equations by SciPy", 1e-5, "tolerances of 1e-10, over kinks"),
    "equilibrium": Property("At an equilibrium the reference has no accelerations", 1e-6, "Newton's method"),
    "modes": Property("Modes are eigenvalues of the reference's linearization by differences", 1e-4, "differences"),
    "driven motion": Property("Kinematics are the run of a mechanism whose drivers decide", 1e-6, "a tolerance of 1e-11"),
    "driving efforts": Property("Efforts by inverse dynamics are those of the run", 1e-6, "a tolerance of 1e-11"),
    "identification": Property("A number is found again from its own exact data, with events, too", 1e-4, "relative"),
}


def solve(case: Case, t: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, Terms, float] | None:
    """Return a (n,), the terms and the condition number by the reference; None if its loads of friction do not settle."""
    terms = evaluate(case.table, t, q, v)
    rubs = list(rubs_of(case.table, q, v).values())
    free = terms.force / terms.mass
    if not len(terms.psi):
        return free, terms, 1.0
    root = 1 / np.sqrt(terms.mass)
    rows = terms.psi_q * root
    size = np.linalg.norm(rows, axis=1)
    u, sigma, vt = np.linalg.svd(rows / size[:, None], full_matrices=False)
    rank = int(np.sum(sigma > RANK * sigma[0]))
    condition = float(sigma[0] / sigma[rank - 1])
    if rubs:
        found = Balance(case.scene, terms, rubs)
        solution = found.solve(np.zeros(found.N.shape[1]))
        return None if solution is None else (solution[0], terms, condition)
    b = (terms.gamma - terms.psi_q @ free) / size
    return free + root * (vt[:rank].T @ ((u[:, :rank].T @ b) / sigma[:rank])), terms, condition


def check_states(case: Case) -> None:
    """Compare states of a run with the reference: closure, accelerations, and the balance of all loads."""
    run = case.tight
    if case.kinds & CHANGES or not np.isfinite(np.asarray(run.q)).all():
        return
    reactions = udk.reactions(case.mechanism, run)
    rubs = {f["name"] for f in case.table["force"] if f["type"] == "friction"}
    friction = udk.friction_loads(case.mechanism, run) if rubs else {}
    without = case.table | {"force": [f for f in case.table["force"] if f["name"] not in rubs]}
    index = {body["name"]: k for k, body in enumerate(case.table["body"])}
    for k in (0, 3, 6):
        t, q, v = float(case.ts[k]), np.asarray(run.q)[k], np.asarray(run.v)[k]
        solved = solve(case, t, q, v)
        if solved is None:
            case.tally.leave_out("loads of friction that do not settle by substitution")
            continue
        a, terms, condition = solved
        grown = max(1.0, condition / ORDINARY) ** 2
        if len(terms.psi):
            rate = np.max(np.abs(terms.psi_dot)) / (1 + np.max(np.abs(v)))
            case.check("closed", float(max(np.max(np.abs(terms.psi)), rate)), f"t={t}")
        found = np.ravel(udk.accelerations(case.mechanism, t, q, v))
        case.check("accelerations", np.max(np.abs(found - a)) / (1 + np.max(np.abs(a))) / grown, f"t={t}")
        loads = evaluate(without, t, q, v).force.reshape(-1, 3).copy()
        for part in (*reactions.values(), *friction.values()):
            for body, load in part.items():
                if body in index:
                    loads[index[body]] += np.asarray(load)[k]
        inertia = terms.mass * a
        size = 1 + np.max(np.abs(terms.force)) + np.max(np.abs(inertia))
        case.check("Newton's law", np.max(np.abs(loads.ravel() - inertia)) / size / grown, f"t={t}")


def check_energy(case: Case) -> None:
    """Check the power of friction, and that energy does not grow."""
    run = case.tight
    if not np.isfinite(np.asarray(run.q)).all():
        return
    rubs = [f["name"] for f in case.table["force"] if f["type"] == "friction"]
    if rubs and not case.kinds & {"attach", "release", "lock"}:
        power = np.array([np.asarray(udk.power_balance(case.mechanism, run).forces[name]) for name in rubs])
        case.check("friction takes power", max(float(np.nanmax(power)), 0.0) / (1 + float(np.nanmax(np.abs(power)))))
    if case.table["driver"] or case.kinds & {"torque", "servo", "force", "zone"}:
        return
    ends = [(evaluate(case.table, 0.0, q, v), v.ravel()) for q, v in zip(np.asarray(run.q), np.asarray(run.v), strict=True)]
    kinetic = np.array([0.5 * v @ (terms.mass * v) for terms, v in ends])
    energy = kinetic + [terms.potential for terms, _ in ends]
    size = 1 + np.max(np.abs(energy)) + np.max(kinetic)
    case.check("no energy from nothing", max(float(np.max(np.diff(energy))), 0.0) / size, ending(run))


def check_reference(case: Case) -> None:
    """Integrate the equations of the reference by SciPy, between samples and knots."""
    damping = max((f.get("damping", 0.0) for f in case.table["force"]), default=0.0)
    if case.has_events or not case.tight.result.is_success or damping > STIFF:
        return
    n, evaluations = 3 * len(case.table["body"]), 0

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        inside = min(max(t, start), end - 1e-11 * (end - start))
        solved = solve(case, inside, y[:n].reshape(-1, 3), y[n:].reshape(-1, 3))
        if solved is None or evaluations > EVALUATIONS:
            raise ArithmeticError
        return np.concatenate([y[n:], solved[0]])

    y = np.concatenate([np.ravel(x) for x in (case.state.q, case.state.v)])
    edges = [0.0, *_breakpoints(case), SPAN]
    for start, end in itertools.pairwise(edges):
        try:
            found = solve_ivp(rate, (start, end), y, method="DOP853", rtol=1e-10, atol=1e-11)
        except ArithmeticError:
            case.tally.leave_out("the reference takes too long, or its loads of friction do not settle")
            return
        if not found.success:
            case.tally.leave_out("the reference stops at a singular configuration, where its rank changes")
            return
        y = found.y[:, -1]
    right = np.concatenate([y[:n].reshape(-1, 3), y[n:].reshape(-1, 3)], axis=-1)
    last = np.concatenate([np.asarray(case.tight.q)[-1], np.asarray(case.tight.v)[-1]], axis=-1)
    error = difference(last, right) / case.growth
    if error > case.tolerances["reference"] and _passes_a_change_point(case):
        case.tally.leave_out("the reference, without projection, takes the other branch at a change point")
        return
    case.check("reference", error, ending(case.tight))


def _passes_a_change_point(case: Case) -> bool:
    """Return whether motions branch somewhere along the run, where a rounding error decides which one the reference follows."""
    run = case.run(TIGHT, np.linspace(0.0, SPAN, FINE))
    ordinary = int(np.sum((start := np.asarray(udk.singular_values(case.mechanism, 0.0, run.q[0]))) > RANK * start[0]))
    along = (np.asarray(udk.singular_values(case.mechanism, t, q)) for t, q in zip(run.ts, run.q, strict=True))
    return any(s[ordinary - 1] < NEAR * s[0] for s in along)


def _breakpoints(case: Case) -> list[float]:
    """Return the times of knots and samples within the run."""
    knots = [t for d in case.table["driver"] for t in d["motion"].get("times", [])]
    held = [f["value"] for f in case.table["force"] if isinstance(f.get("value"), dict)]
    knots += [x["t0"] + x["dt"] * k for x in held for k in range(len(x["values"]))]
    return sorted({float(t) for t in knots if 1e-9 < t < SPAN - 1e-9})


def check_statics(case: Case) -> None:
    """Find an equilibrium of a smooth scene, and its modes."""
    if case.table["driver"] or case.has_events or case.kinds & {"zone", "friction"} or _breakpoints(case):
        return
    found = udk.equilibrium(case.mechanism, udk.State(case.state.q, 0 * case.state.v))
    q = np.asarray(found.q)
    if not bool(found.balanced) or np.max(np.abs(q)) > 100:
        case.tally.leave_out("no equilibrium nearby")
        return
    at_rest = solve(case, 0.0, q, 0 * q)
    assert at_rest is not None  # there is no friction
    a, terms, condition = at_rest
    case.check("equilibrium", np.max(np.abs(a)) / (1 + np.max(np.abs(terms.force / terms.mass))))
    root = 1 / np.sqrt(terms.mass)
    _, sigma, vt = np.linalg.svd(terms.psi_q * root) if len(terms.psi) else (0, np.zeros(0), np.eye(len(root)))
    rank = int(np.sum(sigma > RANK * sigma[0])) if len(sigma) else 0
    N = root[:, None] * vt[rank:].T
    if not N.shape[1] or condition > 1e4:
        return

    def along(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        solved = solve(case, 0.0, q + (N @ x).reshape(q.shape), (N @ y).reshape(q.shape))
        assert solved is not None
        return N.T @ (terms.mass * solved[0])

    unit, zero = STEP * np.eye(N.shape[1]), np.zeros(N.shape[1])
    K = np.array([(along(e, zero) - along(-e, zero)) / (2 * STEP) for e in unit]).T
    C = np.array([(along(zero, e) - along(zero, -e)) / (2 * STEP) for e in unit]).T
    right = np.linalg.eigvals(np.block([[np.zeros_like(K), np.eye(len(K))], [K, C]]))
    values = np.ravel(np.asarray(udk.modes(case.mechanism, udk.State(q, 0 * q)).s))
    if len(values) != len(right):
        case.check("modes", np.inf, f"{right} {values}")
        return
    gaps = np.abs(right[:, None] - values)
    # A double eigenvalue changes by the root of the error of its matrix.
    errors = np.minimum(gaps, gaps**2)[linear_sum_assignment(gaps)]
    case.check("modes", float(np.max(errors)) / (1 + np.max(np.abs(right))), f"{right} {values}")


def check_driven(case: Case) -> None:
    """Compare the run of a mechanism whose driver decides its motion with kinematics and inverse dynamics."""
    if not case.table["driver"] or case.has_events or not case.tight.result.is_success:
        return
    if len(case.table["joint"]) == len(case.table["body"]) and len(case.table["body"]) > 1:  # an open chain
        return
    found = udk.kinematics(case.mechanism, None, case.ts, state=case.state)
    if not np.isfinite(np.asarray(found.q)).all():
        case.tally.leave_out("a driven motion that ends")
        return
    q, v = (np.asarray(x) for x in (found.q, found.v))
    case.check("driven motion", difference(np.concatenate([q, v], axis=-1), case.tight) / case.growth, ending(case.tight))
    efforts = np.asarray(udk.inverse_dynamics(case.mechanism, case.ts).efforts["driver"])
    right = np.asarray(udk.efforts(case.mechanism, case.tight)["driver"])
    if np.isfinite(efforts).all():
        error = float(np.max(np.abs(efforts - right)) / (1 + np.max(np.abs(right))))
        case.check("driving efforts", error / case.growth, f"{efforts} {right}")


def check_identification(case: Case) -> None:
    """Change a number of a force, and find it again from the exact motion."""
    names = [name for name in case.varied if name.startswith("force")]
    if not names or case.table["driver"] or not case.tight.result.is_success:
        return
    name, ts = names[0], np.linspace(0.0, SPAN, 31)
    given: dict[str, Any] = {"events": case.events} if case.events else {}
    data = case.run(TIGHT, ts)
    if not data.result.is_success or data.result == udk.Result.event_stop:
        return
    channels = {f"body.{body}.angle": np.asarray(data.q)[:, k, 2] for k, body in enumerate(case.mechanism.body_names)}
    record: Any = udk.Record(ts, channels, noise=1e-6, initial_state=case.state)
    changed = case.mechanism.with_parameters({name: 1.05 * case.varied[name]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = udk.identify(changed, record, [name], progress=False, n_starts=0, **given)
    if not bool(found.success):
        case.tally.leave_out("a fit that says that it has not succeeded")
        return
    value, true, error = float(found.parameters[name]), case.varied[name], float(found.standard_errors[name])
    if not error < 1e-3 * abs(true):
        case.tally.leave_out("data that hardly depend on the number")
        return
    case.check("identification", abs(value - true) / abs(true), f"{name} {value} instead of {true} +- {error}: {found.message}")
