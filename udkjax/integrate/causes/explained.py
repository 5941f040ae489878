"""Give a failed solution what its cause is to be found from."""

from dataclasses import replace
from typing import Any

import numpy as np

from udkjax.equations.analysis import Analysis
from udkjax.integrate.causes.failed_run import FailedRun
from udkjax.integrate.causes.find import FoundCause
from udkjax.integrate.solution import Solution
from udkjax.integrate.solvers import is_explicit
from udkjax.scene.mechanism import Mechanism


def explained(
    solution: Solution, mechanism: Mechanism, analysis: Analysis | None, drift_tol: Any, solver: Any, end: Any = None
) -> Solution:
    """Return a failed solution of a single run that can say why it failed.

    Args:
        solution: the solution, of known numbers.
        mechanism: what moved.
        analysis: that of the run.
        drift_tol: that of the run.
        solver: that of the run; None is the default.
        end: the last state (t, (q, v)) of the integrator, if it is known.
    """
    assert analysis is not None  # a mechanism has one
    q, v = (np.asarray(x).reshape(len(solution.ts), -1) for x in (solution.q, solution.v))
    chosen = solution.settings
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
        is_projected=chosen["stabilization"] == "Projection",
        is_explicit=is_explicit(solver) or chosen["solver"] == "Adams",  # whose corrector is not solved, but applied once
        drops_rows=chosen["method"] in ("Auto", "Elimination"),
        formulation=chosen["formulation"],
    )
    return replace(solution, found_cause=FoundCause(run))
