"""Find the cause of a failed run, and describe it with its place, its time and a remedy."""

from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import numpy as np

from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.integrate.causes.failed_run import FailedRun
from udkjax.integrate.causes.force_causes import explain_stiff_force, explain_undefined_law, explain_violent_force
from udkjax.integrate.causes.jamming import explain_jamming
from udkjax.integrate.causes.reach import explain_reach
from udkjax.integrate.causes.system_causes import cause_in_functions
from udkjax.integrate.solution import Result, Solution
from udkjax.integrate.solvers import is_explicit
from udkjax.positions.assembling.open_rows import explain_open, name_not_finite
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import MOST_LISTED

NEAR_REACH = 1e-2  # fraction of the span by which a run may end before a dead point
SINGULAR_TOL = 1e-4  # bound on singular values of D, with rows of length one, relative to the largest
RATE_NAMES = ("vx", "vy", "omega")


class FoundCause:
    """The cause of a failed run, found on demand.

    All instances compare equal, so all solutions have the same tree structure. A solution may thus hold the cause of another
    run; the cause is returned only for the code and time of the run it was found for.

    Args:
        run: the failed run; None if `text` is known.
        text: the cause; None if it is to be found when it is asked for.
    """

    def __init__(self, run: FailedRun | None, text: str | None = None):
        self._run, self._text = run, text
        self._key = None if run is None else (int(run.result), run.time)

    @classmethod
    def of(cls, solution: Solution, text: str) -> "FoundCause":
        """Return the cause `text`, already known, of the failed run of a solution."""
        cause = cls(None, text)
        cause._key = int(solution.code), float(solution.time)
        return cause

    def text(self, code: int, time: float) -> str | None:
        """Return the cause of a run that ended with this code at this time (s); None for another run."""
        if (code, time) != self._key:
            return None
        if self._text is None and self._run is not None:
            with np.errstate(all="ignore"):
                self._text = find_cause(self._run)
            self._run = None
        return self._text

    def __eq__(self, other: Hashable) -> bool:
        return isinstance(other, FoundCause)

    def __hash__(self) -> int:
        return 0

    def __getstate__(self) -> dict:
        text = None if self._key is None else self.text(*self._key)
        return {"_run": None, "_text": text, "_key": self._key}


def find_cause(run: FailedRun) -> str | None:
    """Return the cause of a failed run in words; None if no cause is found that says more than its `Result`."""
    not_finite = " and ".join(
        text for text in (name_not_finite(run.mechanism, run.q[0]), name_not_finite(run.mechanism, run.v[0], RATE_NAMES)) if text
    )
    if not_finite:
        return f"the initial state is not finite: {not_finite}"
    match run.result:
        case Result.could_not_assemble:
            return _explain_open_guess(run)
        case Result.initial_state_open:
            text = run.open_rows(run.ts[0], run.q[0])
            return f"the initial state is open (m, rad): {text}; `assemble` closes it, and so does a run without an initial state"
        case Result.drift:
            return _explain_drift(run)
        case Result.singular:
            return _explain_singular(run)
        case Result.not_finite:
            return _explain_not_finite(run)
        case Result.step_too_small:
            return _explain_small_step(run)
        case Result.step_limit:
            return _explain_many_steps(run)
    return None


def cause_of_standstill(mechanism: Mechanism, span: float, state: tuple[float, Any, Any], time: float) -> str:
    """Describe the demands of drivers that stopped a run outside of Python, as on a web page; "" if drivers did not stop it.

    Args:
        mechanism: mechanism of concrete numbers.
        span: duration of the run (s).
        state: a state (t, q, v) of the run before its end.
        time: the time of its end (s).
    """
    t, q, v = state[0], *(np.ravel(np.asarray(x, float)) for x in state[1:])
    run = FailedRun(
        mechanism=mechanism,
        analysis=analyse(mechanism),
        result=Result.step_limit,
        time=time,
        ts=np.array([t, t + span]),
        q=np.stack([q, np.full_like(q, np.nan)]),
        v=np.stack([v, np.full_like(v, np.nan)]),
        end=None,
        steps=0,
        rtol=0.0,
        atol=0.0,
        drift_tol=0.0,
        stabilization="Projection",
        is_explicit=True,
        drops_rows=False,
        formulation="",
    )
    with np.errstate(all="ignore"):
        return explain_reach(run, time + NEAR_REACH * span)


def _explain_open_guess(run: FailedRun) -> str | None:
    mechanism, t, q, v = run.mechanism, float(run.ts[0]), run.q[0], run.v[0]
    psi, psi_dot = run.rows.at(t, q)[0], run.psi_dot(t, q, v)
    names = [name for name, _ in run.rows.names]
    return explain_open(mechanism, t, np.asarray(mechanism.q0).ravel(), names, psi, psi_dot, run.row_scales)


def _explain_drift(run: FailedRun) -> str | None:
    k = int(np.argmin(np.abs(run.ts - run.time)))
    q = run.q[k] if run.end is None or np.isfinite(run.q[k]).all() else run.end[1]
    left_out = sorted({run.rows.names[i][0] for i in run.analysis.redundant_rows or ()})
    text = run.open_rows(run.time, q)
    anew = "analyse the mechanism with its present numbers, or use method=SVD()"
    following = float(min(run.ts[run.ts > run.time], default=run.ts[-1]))
    # The last output is closed where the step after it, or a row that is left out, is not.
    reach = explain_reach(run, _shortly_after(run, run.time) if text else following)
    if reach:
        return reach
    if not text and left_out:
        return f"rows of {', '.join(left_out)} are left out as redundant, but are independent: {anew}"
    if not text:
        why = _near_singular(run) if run.states else ""
        return f"the constraints open before {following:.6g} s: {why or 'tighten rtol and atol'}"
    size = float(np.max(np.abs(run.psi(run.time, q)) / run.row_scales))
    open_by = f"open (m, rad): {text}, {size:.2g} of the scene's scales, more than drift_tol={run.drift_tol:g}"
    if not run.is_projected:
        return f"{open_by}; {_nothing_projects(run)}"
    if run.drops_rows and any(f'"{name}"' in text for name in left_out):
        return f"{open_by}; rows of {', '.join(left_out)} are left out as redundant, but are independent: {anew}"
    if run.rows.close(run.time, q) is None:
        return f"{open_by}; no position nearby satisfies the constraints"
    return f"{open_by}; a position nearby satisfies them: {_near_singular(run) or 'loosen drift_tol, or tighten rtol and atol'}"


def _explain_singular(run: FailedRun) -> str:
    """Describe the singular configuration that an unprojected run met, and how far its constraints were open there."""
    t, q, _ = run.states[0]
    size = float(np.max(np.abs(run.psi(t, q)) / run.row_scales))
    place = _nearest_singular(run)
    return (
        f"near a singular configuration{'' if place is None else f' of {place[0]}'} the constraints are open by {size:.1g} of "
        "the scene's scales: the run may change its branch or lose its energy there (the bound is drift_tol / 4 times the square "
        f"of the distance from it); {_nothing_projects(run)}"
    )


def _nothing_projects(run: FailedRun) -> str:
    if run.stabilization == "Baumgarte":
        return (
            "Baumgarte() only damps the violation, more slowly with smaller gains, and nothing returns the states to the "
            "constraints: use Projection(), or larger gains"
        )
    return "nothing returns the states to the constraints: stabilize them, by Projection()"


def _explain_not_finite(run: FailedRun) -> str | None:
    text = explain_undefined_law(run) or explain_jamming(run)
    if text:
        return text
    if run.formulation == "Augmented" and (run.analysis.redundant_rows or _rank(run) < run.rows.count):
        return (
            f"`Augmented()` solves its equations by plain LU, and they are singular: {run.rows.count} rows of rank {_rank(run)}; "
            "use another formulation"
        )
    return _near_singular(run)


def _explain_small_step(run: FailedRun) -> str | None:
    text = explain_undefined_law(run) or explain_jamming(run) or _reach_at_end(run)
    return text or explain_violent_force(run) or _near_singular(run) or explain_stiff_force(run)


def _explain_many_steps(run: FailedRun) -> str | None:
    text = explain_jamming(run) or _reach_at_end(run) or explain_violent_force(run) or explain_stiff_force(run)
    text = text or _near_singular(run)
    if text:
        return f"the limit of {run.steps} steps was reached: {text}"
    done = (run.time - run.ts[0]) / (run.ts[-1] - run.ts[0])
    if not done > 0:
        return None
    return (
        f"{run.steps} steps made {100 * done:.3g} % of the way; at this pace {run.steps / done:.2g} are needed: "
        "raise `max_steps`, or loosen the tolerances"
    )


def _reach_at_end(run: FailedRun) -> str:
    """Describe the demands of drivers if the run ended where the mechanism cannot follow them, else return ""."""
    t = run.states[0][0]
    return explain_reach(run, _shortly_after(run, t)) if t < run.ts[-1] else ""


def _shortly_after(run: FailedRun, t: float) -> float:
    """Return a time (s) at which a demand of a driver that stopped the run at t is clearly out of reach."""
    return min(float(run.ts[-1]), t + NEAR_REACH * float(run.ts[-1] - run.ts[0]))


def _near_singular(run: FailedRun) -> str:
    """Describe the singular configuration near which the run ended, with its joints; "" if there is none."""
    place = _nearest_singular(run)
    if place is None or not place[1] < SINGULAR_TOL:
        return ""
    return f"the state is near a singular configuration of {place[0]} (smallest singular value {place[1]:.1g} of the largest)"


def _nearest_singular(run: FailedRun) -> tuple[str, float] | None:
    """Return the joints whose rows are closest to dependence at the end, and the smallest singular value over the largest.

    Return None if the rank of the mechanism is unknown or zero.
    """
    t, q, _ = run.states[0]
    rank = run.analysis.rank
    if rank is None or not rank:
        return None
    u, sigma = run.decomposed(t, q)
    involved = np.abs(u[:, rank - 1]) > 0.1 * np.abs(u[:, rank - 1]).max()
    names = list(dict.fromkeys(name for (name, _), is_involved in zip(run.rows.names, involved, strict=True) if is_involved))
    return ", ".join(names[:MOST_LISTED]), float(sigma[rank - 1] / sigma[0])


def _rank(run: FailedRun) -> int:
    t, q, _ = run.states[0]
    sigma = run.decomposed(t, q)[1]
    return int(np.sum(sigma > SINGULAR_TOL * sigma[0]))


def explained(
    solution: Solution, mechanism: Any, analysis: Analysis | None, drift_tol: Any, solver: Any, end: Any = None
) -> Solution:
    """Return the solution of a failed single run with its cause.

    The cause of a mechanism's run is searched for when it is first read. The cause of a user-defined system's run is found here,
    if the values of its functions show one.

    Args:
        solution: the solution, of concrete numbers.
        mechanism: the mechanism, or the system.
        analysis: the `Analysis` of the mechanism; None for a system.
        drift_tol: the `drift_tol` of the run.
        solver: the run's solver; None: the default.
        end: the last time and state (t, y) of the integrator, y = (q, v), if available.
    """
    if analysis is None:  # of a system
        text = cause_in_functions(solution, mechanism, end)
        return replace(solution, found_cause=FoundCause.of(solution, text)) if text else solution
    q, v = (np.asarray(x).reshape(len(solution.ts), -1) for x in (solution.q, solution.v))
    settings = solution.settings
    last = None
    if end is not None:
        t, y = (np.asarray(x) for x in end)
        last = float(t), y[: q.shape[1]], y[q.shape[1] :]
    run = FailedRun(
        mechanism=mechanism,
        analysis=analysis,
        result=solution.result,
        time=float(solution.time),
        ts=np.asarray(solution.ts),
        q=q,
        v=v,
        end=last,
        steps=int(solution.stats["steps"]),
        rtol=float(solution.rtol),
        atol=float(solution.atol),
        drift_tol=float(drift_tol),
        stabilization=settings["stabilization"],
        # The corrector of Adams is applied once, not solved; a run by the default method of machine code goes on implicitly.
        is_explicit=(is_explicit(solver) or settings["solver"] == "Adams") and "stiff_solver" not in settings,
        drops_rows=settings["method"] in ("Auto", "Elimination"),
        formulation=settings["formulation"],
    )
    return replace(solution, found_cause=FoundCause(run))
