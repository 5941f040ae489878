"""Which experiment to make next: what records that are not measured yet would tell of parameters.

With J the derivatives of what would be measured, each divided by the standard deviation of its noise, a candidate adds J^T J to
the information M that there is: M^-1 is the covariance of an estimate, to first order in the noise. What is not asked for (starts
that are estimated too, other parameters) is eliminated: what is left of J is its part that they cannot make up for. The best
candidate has the largest det M (criterion "D"), the smallest trace M^-1 ("A"), or the largest least eigenvalue of M ("E"), in the
dimensionless unknowns of `udkjax.study.identify.parameters`. F. Pukelsheim, Optimal Design of Experiments, 2006.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.integrate.assembly import State
from udkjax.scene.checks import suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.estimate import Estimate, groups_of
from udkjax.study.identify.posing import posed
from udkjax.study.identify.problem import Problem
from udkjax.study.identify.records import Record, Start

Criterion = Literal["D", "A", "E"]
TOL = 1e-9  # of the integration: singular values are known to about as much of the largest
FLAT = 1e-8  # of the largest singular value of all candidates together: directions below it do not show
PART = 1e-4  # of a direction that does not show: parameters with a larger part in it are not known


@dataclass(frozen=True, eq=False)
class Candidate:
    """An experiment that may be made: what of the scene is different in it (`conditions`, by name), and how it begins."""

    conditions: Mapping[str, Any] = field(default_factory=dict)
    start: Start | State | None = None
    name: str = ""


@dataclass(frozen=True, eq=False)
class Design:
    """What candidates would tell of parameters, N of them; each alone, with what was known before.

    `standard_errors` (N, P) are in the units of the parameters, inf where a candidate does not tell. `scores` (N,) are of the
    criterion, the larger the better: log det M, -trace M^-1, or the least eigenvalue; -inf, or 0, where a direction is not known.
    `order` (N,) has the best first. `chosen` are those to be made together, the most useful first, and `together` (n, P) the
    standard errors after the first of them, the first two, and so on.
    """

    criterion: Criterion
    names: tuple[str, ...]
    candidates: tuple[str, ...]
    scores: Float[np.ndarray, "N"]
    standard_errors: Float[np.ndarray, "N P"]
    order: tuple[int, ...]
    chosen: tuple[int, ...]
    together: Float[np.ndarray, "n P"]

    @property
    def best(self) -> int:
        """The candidate that tells most."""
        return self.order[0]

    def __str__(self) -> str:
        rows = [f"{'':24}{f'{self.criterion}':>12}" + "".join(f"{name[-24:]:>26}" for name in self.names)]
        for k in self.order:
            errors = "".join(f"{error:26.3g}" for error in self.standard_errors[k])
            rows.append(f"{self.candidates[k][:24]:24}{self.scores[k]:12.4g}{errors}")
        return "\n".join(rows)


def design_experiment(
    mechanism: Mechanism,
    candidates: Sequence[Candidate | Mapping[str, Any] | Start | State],
    parameters: Sequence[Any] | str,
    channels: Sequence[Any],
    ts: ArrayLike,
    noise: Mapping[Any, Any] | float,
    criterion: Criterion = "D",
    pick: int = 1,
    of: Sequence[str] | None = None,
    given: Estimate | None = None,
    tol: float = TOL,
    **settings: Any,
) -> Design:
    """Rank experiments by what they would tell of `parameters`, and pick some to be made together.

    A candidate is a `Candidate`, the conditions of one (a driver's amplitude and frequency by name), or its start. In each the
    `channels` would be measured at the times `ts` (T,), s, with the standard deviation `noise` (of all channels, or by channel).
    The parameters have the values of the mechanism; with an estimate `given` those of the estimate, whose records count as made.
    Priors of parameters count too. `of` names the parameters that matter, if not all. `pick` are chosen one after another, each
    to the best together with those before.

    Raises `IdentificationError`, which lists every mistake. A candidate that cannot be simulated tells nothing.
    """
    made = [_candidate(candidate, k) for k, candidate in enumerate(candidates)]
    problems = [] if made else ["candidates: there is none"]
    if criterion not in get_args(Criterion):
        problems.append(f"criterion must be one of {', '.join(get_args(Criterion))}, is {criterion!r}")
    if not 1 <= pick <= max(len(made), 1):
        problems.append(f"pick must be from 1 to {len(made)}, the number of candidates, is {pick}")
    if problems:
        raise IdentificationError(problems)
    ts = np.asarray(ts, float)
    records = [
        Record(ts, {channel: np.zeros(ts.shape) for channel in channels}, noise, c.start, conditions=c.conditions, name=c.name)
        for c in made
    ]
    problem = posed(mechanism if given is None else given.mechanism, records, parameters, settings)
    names = problem.unknowns.names
    wanted = _wanted(names, of)
    before = _before(problem, given)
    slopes = problem.unknowns.slopes(np.zeros(len(names)))[wanted]
    roots = _roots(problem, (tol, tol))
    floor = FLAT * np.linalg.norm(np.concatenate([before, *roots]), 2)

    def told(which: Sequence[int]) -> tuple[tuple[int, float], np.ndarray]:
        every = np.concatenate([before, *(roots[k] for k in which)])
        return _told(_without(every, np.setdiff1d(np.arange(len(names)), wanted), floor), criterion, floor)

    alone = [told([k]) for k in range(len(made))]
    chosen: list[int] = []
    while len(chosen) < pick:
        left = [k for k in range(len(made)) if k not in chosen]
        chosen.append(max(left, key=lambda k: told([*chosen, k])[0]))
    full = len(wanted)
    nothing = 0.0 if criterion == "E" else -np.inf
    return Design(
        criterion,
        tuple(names[k] for k in wanted),
        tuple(c.name for c in made),
        np.array([score if rank == full else nothing for (rank, score), _ in alone]),
        np.stack([errors * slopes for _, errors in alone]),
        tuple(sorted(range(len(made)), key=lambda k: alone[k][0], reverse=True)),
        tuple(chosen),
        np.stack([told(chosen[: n + 1])[1] * slopes for n in range(pick)]),
    )


def _candidate(given: Any, k: int) -> Candidate:
    found = given if isinstance(given, Candidate) else None
    if isinstance(given, Mapping):
        found = Candidate(given, name=", ".join(f"{name} = {value}" for name, value in given.items()))
    elif isinstance(given, Start | State):
        found = Candidate(start=given)
    if found is None:
        raise IdentificationError([f"candidate {k + 1}: must be a Candidate, conditions or a start, is {type(given).__name__}"])
    return found if found.name else Candidate(found.conditions, found.start, f"candidate {k + 1}")


def _wanted(names: Sequence[str], of: Sequence[str] | None) -> np.ndarray:
    asked = names if of is None else [of] if isinstance(of, str) else of
    problems = [f"of: {name} is not among the parameters{suggestion(name, names)}" for name in asked if name not in names]
    if problems or not asked:
        raise IdentificationError(problems or ["of: names no parameter"])
    return np.array([names.index(name) for name in asked])


def _roots(problem: Problem, tol: tuple[float, float]) -> list[np.ndarray]:
    """Of each record, rows (., P) whose squares are its information; none of one that cannot be computed."""
    P = len(problem.unknowns.names)
    J = problem.evaluate(np.zeros((1, problem.K)), tol).J[0, : len(problem.where)]
    found = []
    for k in range(len(problem.records)):
        mine = J[problem.where[:, 0] == k]
        fine = np.isfinite(mine).all()
        found.append(_without(mine, np.arange(P, problem.K), FLAT * np.linalg.norm(mine, 2)) if fine else np.zeros((0, P)))
    return found


def _before(problem: Problem, given: Estimate | None) -> np.ndarray:
    """Rows of what is known already: from records, and from priors."""
    u = problem.unknowns
    which = problem.priors
    priors = np.zeros((len(which), len(u.names)))
    priors[np.arange(len(which)), which] = u.slopes(np.zeros(len(u.names)))[which] / u.sigma[which]
    if given is None:
        return priors
    if given.names != u.names:
        raise IdentificationError([f"given: is an estimate of {', '.join(given.names)}, not of {', '.join(u.names)}"])
    P, old = len(u.names), given.problem.unknowns
    J = (
        given.problem.evaluate(given.z[None], given.tol).J[0]
        / np.append(given.knowledge.noise, 1.0)[groups_of(given.problem), None]
    )
    rows = _without(J, np.arange(P, given.problem.K), FLAT * np.linalg.norm(J, 2))
    same = u.slopes(np.zeros(P)) / old.slopes(given.z[:P])  # unknowns are measured from other first guesses
    return rows * same  # the priors of the estimate are among its rows


def _without(J: np.ndarray, columns: np.ndarray, floor: float) -> np.ndarray:
    """The other columns of J, less what these columns can make up for."""
    rest = np.delete(J, columns, axis=1)
    if not len(columns) or not len(J):
        return rest
    u, s, _ = np.linalg.svd(J[:, columns], full_matrices=False)
    u = u[:, s > floor]
    return rest - u @ (u.T @ rest)


def _told(rows: np.ndarray, criterion: Criterion, floor: float) -> tuple[tuple[int, float], np.ndarray]:
    """How many directions are known and how well; and the standard errors of the unknowns."""
    K = rows.shape[1]
    _, s, vt = np.linalg.svd(np.concatenate([rows, np.zeros((K, K))]))
    known = s > floor
    s, lost = s[known], np.any(np.abs(vt[~known]) > PART, axis=0)
    value = {"D": 2.0 * np.log(s).sum(), "A": -np.sum(s**-2.0), "E": float(np.min(s, initial=np.inf) ** 2) if len(s) else 0.0}
    errors = np.sqrt(np.sum((vt[known] / s[:, None]) ** 2, axis=0))
    return (int(known.sum()), float(value[criterion])), np.where(lost, np.inf, errors)
