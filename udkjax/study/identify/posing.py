"""The problem that data and parameters pose, or everything that is wrong with them."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import jax
import numpy as np

from udkjax.equations.analysis import Analysis, analyse
from udkjax.integrate.assembly import AssemblyError, close, require_closed
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Result
from udkjax.scene.checks import SceneError, suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.legality import illegal
from udkjax.study.identify.parameters import unknowns_of
from udkjax.study.identify.problem import Problem
from udkjax.study.identify.reading import records_of
from udkjax.study.identify.records import Estimated, Record, Start
from udkjax.study.identify.search import LOOSE, Strategy, beside
from udkjax.study.identify.unknowns import Unknowns, applied

TOL = 1e-11  # relative and absolute, of the integration: what parameters are known to where there is no noise
NEARBY = 64  # guesses that are tried where the first cannot be closed
KNOWN = 256  # structures of mechanisms whose parameters were found legal
DECIDED = (
    "ts",
    "mechanism",
    "state",
    "rtol",
    "atol",
    "adjoint",
    "throw",
    "progress",
    "analysis",
)  # not settings that one may give


def posed(
    mechanism: Mechanism,
    data: Any,
    parameters: Sequence[Any] | str,
    settings: Mapping[str, Any],
    noise: Any = None,
    ignore: Sequence[str] = (),
    seed: int = 0,
    strategy: Strategy = "auto",
    start: Start | Estimated | None = None,
    tol: float = TOL,
) -> Problem:
    """The problem that arguments of `identify` pose. Raises `IdentificationError`, which lists every mistake."""
    unknowns, records = _gathered(
        lambda: _check(settings, strategy),
        lambda: unknowns_of(mechanism, parameters),
        lambda: _started(records_of(mechanism, data, noise, ignore), start),
    )[1:]
    return _begun(mechanism, unknowns, records, settings, seed, tol)


def _started(records: Sequence[Record], start: Start | Estimated | None) -> Sequence[Record]:
    if start is None:
        return records
    given = start if isinstance(start, Start) else Start(estimate=start)
    return [record.starting(given) for record in records]


def _gathered(*steps: Callable[[], Any]) -> list[Any]:
    """What some steps give; if any of them finds mistakes, those of all."""
    found, problems = [], []
    for step in steps:
        try:
            found.append(step())
        except IdentificationError as error:
            problems += error.problems
    if problems:
        raise IdentificationError(problems)
    return found


def _begun(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any], seed: int, tol: float
) -> Problem:
    """The problem from the first guess; where that cannot be closed, from the nearest that can. Raises `IdentificationError`.

    Whether a mechanism without redundant rows closes is seen by the first run, which the fit begins with: to look before would
    cost more than the run.
    """
    if unknowns.own and analyse(mechanism).redundant_rows == ():
        try:
            problem = Problem(mechanism, unknowns, records, settings)
            first = problem.evaluate(np.zeros((1, problem.K)), (max(tol, LOOSE), max(tol, LOOSE)))
            if first.code[0] != Result.could_not_assemble:
                return problem
        except AssemblyError:
            pass
    analysis, unknowns = _closable(mechanism, unknowns, seed)
    if analysis.redundant_rows:
        _require_legal(mechanism, unknowns)
    return Problem(mechanism, unknowns, records, {**settings, "analysis": analysis})


def _require_legal(mechanism: Mechanism, unknowns: Unknowns) -> None:
    """Raise where the parameters would open a loop. What is legal is so for other numbers too with the same redundant rows."""
    structure = jax.tree.structure(mechanism), unknowns.targets
    if structure in _legal:
        return
    wrong = illegal(mechanism, lambda mech, x: applied(mech, unknowns.targets, x), unknowns.start, unknowns.names)
    if wrong:
        raise IdentificationError(wrong)
    if len(_legal) >= KNOWN:
        _legal.clear()
    _legal.add(structure)


_legal: set[Any] = set()


def _check(settings: Mapping[str, Any], strategy: str) -> None:
    known = [name for name in inspect.signature(simulate).parameters if name not in DECIDED]
    problems = [
        f"{name}: no setting of simulate that can be given here{suggestion(name, known)}"
        for name in settings
        if name not in known
    ]
    if strategy not in get_args(Strategy):
        problems.append(f"strategy must be one of {', '.join(get_args(Strategy))}, is {strategy!r}")
    if problems:
        raise IdentificationError(problems)


def _closable(mechanism: Mechanism, unknowns: Unknowns, seed: int) -> tuple[Analysis, Unknowns]:
    """The analysis of the mechanism at its first guess, or, where that cannot be closed, at the nearest that can."""
    for k, x in enumerate([unknowns.start, *_nearby(unknowns, seed)]):
        try:
            placed = mechanism if k == 0 and unknowns.own else applied(mechanism, unknowns.targets, x)
        except SceneError:
            continue
        if close(placed).is_closed:
            return analyse(placed), dataclasses.replace(unknowns, start=np.asarray(x, float))
    placed = applied(mechanism, unknowns.targets, unknowns.start)
    require_closed(placed, close(placed))
    raise AssertionError


def _nearby(unknowns: Unknowns, seed: int) -> list[np.ndarray]:
    """Values beside the first guesses, the nearest first."""
    z = beside(unknowns, np.zeros(len(unknowns.names)), NEARBY, seed)
    return list(unknowns.values(z[np.argsort(np.linalg.norm(z, axis=1))]))
