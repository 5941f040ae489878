"""Builds the problem that mechanism, data and parameters pose, or raises everything that is wrong with them."""

import dataclasses
import inspect
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, get_args

import jax
import numpy as np

from udkjax.equations.analysis import Analysis, analyse
from udkjax.integrate.assembly import AssemblyError, close, require_closed
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Result
from udkjax.scene.checks import SceneError, suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.loop_consistency import loop_problems
from udkjax.study.identify.parameters import Asked, unknowns_of
from udkjax.study.identify.prediction import LOOSE, TIGHT
from udkjax.study.identify.problem import Problem
from udkjax.study.identify.record_reader import Data, records_of
from udkjax.study.identify.records import Estimated, IdentificationError, Noise, Record, Start
from udkjax.study.identify.search import Strategy
from udkjax.study.identify.unknowns import Unknowns, apply_values, sample_guesses

NEARBY_GUESSES = 64  # that are tried where the first cannot be closed
MOST_STORED = 256  # structures of mechanisms whose parameters keep all loops closed
# Arguments of `simulate` that an identification decides about.
DECIDED = ("ts", "mechanism", "state", "rtol", "atol", "adjoint", "throw", "progress", "analysis")


def build_problem(
    mechanism: Mechanism,
    data: Data,
    parameters: Asked,
    settings: Mapping[str, Any],
    noise: Noise = None,
    ignore: Sequence[str] = (),
    seed: int = 0,
    strategy: Strategy = "auto",
    initial_state: Start | Estimated | None = None,
    tol: float = TIGHT,
) -> Problem:
    """Build the problem that arguments of `identify` pose.

    Raises:
        IdentificationError: with every mistake in them.
        AssemblyError: the mechanism cannot be closed with the first guess, nor with any near it.
    """
    unknowns, records = _collect(
        lambda: _check(settings, strategy),
        lambda: unknowns_of(mechanism, parameters),
        lambda: _with_initial_state(records_of(mechanism, data, noise, ignore), initial_state),
    )[1:]
    return _closable_problem(mechanism, unknowns, records, settings, seed, tol)


def _collect(*steps: Callable[[], Any]) -> list[Any]:
    """Return the results of some steps; if any of them raises `IdentificationError`, raise one with the mistakes of all."""
    found, problems = [], []
    for step in steps:
        try:
            found.append(step())
        except IdentificationError as error:
            problems += error.problems
    if problems:
        raise IdentificationError(problems)
    return found


def _with_initial_state(records: Sequence[Record], given: Start | Estimated | None) -> Sequence[Record]:
    if given is None:
        return records
    start = given if isinstance(given, Start) else Start(estimate=given)
    return [record.with_start(start) for record in records]


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


def _closable_problem(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any], seed: int, tol: float
) -> Problem:
    """Build the problem at the first guess; where that cannot be closed, at the nearest that can.

    Whether a mechanism without redundant rows closes is seen by the first run, which the fit begins with: to look before would
    cost more than the run.
    """
    if unknowns.at_scene_values and analyse(mechanism).redundant_rows == ():
        try:
            problem = Problem(mechanism, unknowns, records, settings)
            first = problem.evaluate(np.zeros((1, problem.K)), (max(tol, LOOSE), max(tol, LOOSE)))
            if first.code[0] != Result.could_not_assemble:
                return problem
        except AssemblyError:
            pass
    analysis, unknowns = _nearest_closable(mechanism, unknowns, seed)
    if analysis.redundant_rows:
        _require_consistent_loops(mechanism, unknowns)
    return Problem(mechanism, unknowns, records, {**settings, "analysis": analysis})


def _nearest_closable(mechanism: Mechanism, unknowns: Unknowns, seed: int) -> tuple[Analysis, Unknowns]:
    """Return the analysis of the mechanism at its first guess, or, where that cannot be closed, at the nearest that can."""
    z = sample_guesses(unknowns, np.zeros(len(unknowns.names)), NEARBY_GUESSES, seed)
    nearby = unknowns.values(z[np.argsort(np.linalg.norm(z, axis=1))])
    for k, x in enumerate([unknowns.guess, *nearby]):
        try:
            placed = mechanism if k == 0 and unknowns.at_scene_values else apply_values(mechanism, unknowns.targets, x)
        except SceneError:
            continue
        if close(placed).is_closed:
            return analyse(placed), dataclasses.replace(unknowns, guess=np.asarray(x, float))
    placed = apply_values(mechanism, unknowns.targets, unknowns.guess)
    require_closed(placed, close(placed))
    raise AssertionError


def _require_consistent_loops(mechanism: Mechanism, unknowns: Unknowns) -> None:
    """Raise where the parameters would open a loop. What keeps it closed does so for other numbers with the same structure."""
    structure = jax.tree.structure(mechanism), unknowns.targets
    if structure in _consistent:
        return
    wrong = loop_problems(mechanism, lambda mech, x: apply_values(mech, unknowns.targets, x), unknowns.guess, unknowns.names)
    if wrong:
        raise IdentificationError(wrong)
    if len(_consistent) >= MOST_STORED:
        _consistent.clear()
    _consistent.add(structure)


_consistent: set[Hashable] = set()
