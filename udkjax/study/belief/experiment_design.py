"""Design of experiments: the candidate whose measurements would determine the parameters best.

With J the derivatives of the predicted measurements, divided by the standard deviations of their noise, a candidate adds J^T J to
the Fisher information M: M^-1 is the covariance of an estimate, to first order in the noise. Nuisance unknowns (initial states,
other parameters) are eliminated by projecting J on the complement of their columns. The best candidate has the largest det M
(criterion "D"), the smallest trace M^-1 ("A"), or the largest smallest eigenvalue of M ("E"), in the dimensionless unknowns of
`identify/problem/parameters.py`. F. Pukelsheim, Optimal Design of Experiments, 2006.

J depends on the parameters. Draws from a posterior show which values are possible: the criterion is then averaged over the draws,
and the inverse of their covariance is prior information. For "D", this is the expected gain of information, up to a
factor and a constant. K. Chaloner & I. Verdinelli, Statistical Science 10 (1995) 273.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.argument_types import NOT_NEGATIVE, TIMES, ArgumentRequirement, of_kind
from udkjax.equations.rows.analysis import Analysis
from udkjax.positions.assembling.assembly import State
from udkjax.printing import PrintedTable, prints_table
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.study.belief.posterior import Posterior
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.answers.uncertainty import SMALLEST_PART
from udkjax.study.identify.problem.fit_problem import FitProblem, build_problem
from udkjax.study.identify.problem.parameters import ParametersLike
from udkjax.study.identify.problem.prediction import MEDIUM_TOL, TolerancePair
from udkjax.study.identify.problem.residuals import Reduction
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO
from udkjax.study.identify.records.records import ChannelKey, IdentificationError, Noise, Record, Start
from udkjax.wording import suggestion

RANKING_DRAWS = 32  # draws whose mean criterion ranks candidates: it then varies by a fifth of its deviation from draw to draw

Criterion = Literal["D", "A", "E"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible experiment.

    Args:
        conditions: numbers of the scene that differ in this experiment, by name.
        initial_state: initial state of this experiment; by default that of the scene.
        name: name of the candidate in tables; by default its number.
    """

    conditions: Mapping[str, Numbers] = field(default_factory=dict)
    initial_state: Start | State | None = None
    name: str = ""


@prints_table
class Design(NamedTuple):
    """A ranking of N candidate experiments by the accuracy with which each, with prior information, determines P parameters.

    Attributes:
        criterion: criterion of the ranking.
        names: names of the parameters.
        candidates: names of the candidates.
        scores: value of the criterion (larger is better): log det M, -trace M^-1, or the smallest eigenvalue; -inf or 0 if a
            combination of parameters is not determined.
        standard_errors: standard errors in the units of the parameters; inf if a candidate does not determine the parameter. With
            draws from a posterior, they are root mean squares over the draws.
        order: indices of the candidates, the best first.
        chosen: candidates to carry out together, the most useful first.
        together: standard errors after the first chosen candidate, the first two, and so on.
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
        """Index of the best candidate."""
        return self.order[0]

    def _table(self) -> PrintedTable:
        errors = [[f"{error:.3g}" for error in self.standard_errors[k]] for k in self.order]
        rows = [(self.candidates[k], f"{self.scores[k]:.4g}", *own) for k, own in zip(self.order, errors, strict=True)]
        return PrintedTable("experiments, the best first: score and standard errors", rows, ("", self.criterion, *self.names))


def _are_channels(x: Any) -> bool:
    """Return True if x is a list of channels: names, or user-defined quantities."""
    is_list = isinstance(x, Sequence) and not isinstance(x, str) and len(x) > 0
    return is_list and all(isinstance(channel, str) or hasattr(channel, "name") for channel in x)


CHANNELS = ArgumentRequirement("channels", of_kind("be a list of channels, by name or as a Quantity", _are_channels))
CANDIDATES = ArgumentRequirement(
    "candidates", of_kind("be a list of candidates", lambda x: isinstance(x, Sequence) and not isinstance(x, str))
)


@checked
@concrete_only()
def design_experiment(
    mechanism: Mechanism,
    candidates: Annotated[Sequence[Candidate | Mapping[str, Numbers] | Start | State], CANDIDATES],
    parameters: ParametersLike,
    channels: Annotated[Sequence[ChannelKey], CHANNELS],
    ts: Annotated[Numbers, TIMES],
    noise: Noise,
    criterion: Criterion = "D",
    pick: int = 1,
    of: str | Sequence[str] | None = None,
    given: Estimate | Posterior | None = None,
    tol: Annotated[float, NOT_NEGATIVE] = MEDIUM_TOL,
    **settings: Any,
) -> Design:
    """Rank experiments by how well they would determine parameters, and choose some to be carried out together.

    Args:
        mechanism: mechanism with the parameter values at which the experiments are predicted.
        candidates: `Candidate`s; or the conditions (such as a driver's amplitude and frequency by name) or initial state of each.
        parameters: parameters to identify, as for `identify`, with their priors.
        channels: channels that would be measured in each experiment.
        ts: times (T,) of the measurements, s.
        noise: standard deviation, of all channels or by channel.
        criterion: "D", the largest det M; "A", the smallest trace M^-1; "E", the largest smallest eigenvalue of M.
        pick: number of candidates to choose in sequence; each is the best addition to the previous ones.
        of: names of the parameters to determine; by default all.
        given: an estimate, whose values are used and whose records count as prior information; or draws from a posterior, over
            which the criterion is averaged, and whose covariance counts as prior information.
        tol: tolerance of the integration.
        settings: further arguments of `simulate`.

    Returns:
        The ranking; a candidate that cannot be simulated contributes no information.

    Raises:
        IdentificationError: lists every mistake.
    """
    Analysis.require_masses(mechanism, "free motions")
    experiments = [_candidate(candidate, k) for k, candidate in enumerate(candidates)]
    problems = [] if experiments else ["candidates: the list is empty"]
    ts = np.asarray(ts, float)
    if not np.all(np.diff(ts) > 0):
        problems.append("ts: must increase")
    if not 1 <= pick <= max(len(experiments), 1):
        problems.append(f"pick must be from 1 to {len(experiments)}, the number of candidates, not {pick}")
    if problems:
        raise IdentificationError(problems)
    records = [
        Record(ts, dict.fromkeys(channels, np.zeros(ts.shape)), noise, c.initial_state, None, c.conditions, c.name)
        for c in experiments
    ]
    problem = build_problem(_mechanism(mechanism, given), records, parameters, settings)
    names = problem.unknowns.names
    wanted = _select_parameters(names, of)
    drawn = _places(problem, given)
    prior_rows = _covariance_rows(drawn) if isinstance(given, Posterior) else _prior_information(problem, given)
    places = drawn[np.linspace(0, len(drawn) - 1, min(RANKING_DRAWS, len(drawn))).round().astype(int)]
    dx_dz = problem.unknowns.dx_dz(places)[:, wanted]
    tols = float(tol), float(tol)
    # Roots of the information of each record, at each place.
    roots = [_information_of_records(problem, np.append(z, np.zeros(problem.K - len(z))), tols) for z in places]
    floors = [INVISIBLE_RATIO * np.linalg.norm(np.concatenate([prior_rows, *own]), 2) for own in roots]

    def evaluate(which: Sequence[int]) -> tuple[tuple[int, float], np.ndarray]:
        """Return (number of determined directions, score) and the standard errors if these candidates are carried out."""
        found = []
        for own, floor in zip(roots, floors, strict=True):
            rows = np.concatenate([prior_rows, *(own[k] for k in which)])
            found.append(_score(_eliminate(rows, np.setdiff1d(np.arange(len(names)), wanted), floor), criterion, floor))
        (ranks, scores), errors = np.array([score for score, _ in found]).T, np.stack([errors for _, errors in found])
        return (int(ranks.min()), float(scores.mean())), np.sqrt(np.mean((errors * dx_dz) ** 2, axis=0))

    alone = [evaluate([k]) for k in range(len(experiments))]
    chosen: list[int] = []
    while len(chosen) < pick:
        left = [k for k in range(len(experiments)) if k not in chosen]
        chosen.append(max(left, key=lambda k: evaluate([*chosen, k])[0]))
    full = len(wanted)
    nothing = 0.0 if criterion == "E" else -np.inf
    return Design(
        criterion,
        tuple(names[k] for k in wanted),
        tuple(c.name for c in experiments),
        np.array([score if rank == full else nothing for (rank, score), _ in alone]),
        np.stack([errors for _, errors in alone]),
        tuple(sorted(range(len(experiments)), key=lambda k: alone[k][0], reverse=True)),
        tuple(chosen),
        np.stack([evaluate(chosen[: n + 1])[1] for n in range(pick)]),
    )


def _candidate(given: Candidate | Mapping[str, Numbers] | Start | State, k: int) -> Candidate:
    candidate = given if isinstance(given, Candidate) else None
    if isinstance(given, Mapping):
        candidate = Candidate(given, name=", ".join(f"{name} = {value}" for name, value in given.items()))
    elif isinstance(given, Start | State):
        candidate = Candidate(initial_state=given)
    if candidate is None:
        raise IdentificationError([f"candidates[{k}]: must be a Candidate, conditions or a start, not {type(given).__name__}"])
    return candidate if candidate.name else Candidate(candidate.conditions, candidate.initial_state, f"candidate {k + 1}")


def _select_parameters(names: Sequence[str], of: str | Sequence[str] | None) -> np.ndarray:
    wanted = names if of is None else [of] if isinstance(of, str) else of
    problems = [f"of: {name} is not among the parameters{suggestion(name, names)}" for name in wanted if name not in names]
    if problems or not wanted:
        raise IdentificationError(problems or ["of: names no parameter"])
    return np.array([names.index(name) for name in wanted])


def _mechanism(mechanism: Mechanism, given: Estimate | Posterior | None) -> Mechanism:
    if isinstance(given, Posterior):
        fit: Any = given.problem.fit_problem
        return fit.mechanism
    return mechanism if given is None else given.mechanism


def _require_same(names: Sequence[str], given: Sequence[str], what: str) -> None:
    if tuple(given) != tuple(names):
        raise IdentificationError([f"given: is {what} of {', '.join(given)}, not of {', '.join(names)}"])


def _places(problem: FitProblem, given: Estimate | Posterior | None) -> Float[np.ndarray, "S P"]:
    """Return the points z at which experiments are predicted: all draws of a posterior, or zero, the mechanism's values."""
    u = problem.unknowns
    if not isinstance(given, Posterior):
        return np.zeros((1, len(u.names)))
    fit = given.problem.fit_problem
    _require_same(u.names, fit.unknowns.names, "a posterior")
    x = fit.unknowns.values(given.x[..., : len(u.names)]).reshape(-1, len(u.names))
    z = u.z_of(x)
    if not np.isfinite(z).all():
        outside = [name for name, known in zip(u.names, np.isfinite(z).all(0), strict=True) if not known]
        raise IdentificationError([f"parameters: the bounds of {name} exclude draws of the posterior" for name in outside])
    return z


def _covariance_rows(z: Float[np.ndarray, "S P"]) -> np.ndarray:
    """Return rows J for which J^T J is the inverse of the covariance of draws z."""
    return np.linalg.inv(np.linalg.cholesky(np.cov(z.T).reshape(z.shape[1], -1)))


def _information_of_records(problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair) -> list[np.ndarray]:
    """Return, for each record, rows J (., P) whose information about the parameters is J^T J, with initial states eliminated.

    A record that cannot be computed has no rows.
    """
    P, fine = len(problem.unknowns.names), np.ones(len(problem.records), bool)
    reduced = [Reduction(problem.K) for _ in problem.records]
    for block in problem.row_blocks(z[None], tol):
        count = block.count_before(len(problem.index))
        record, J = problem.index[block.row_numbers[:count], 0], block.J[0, :count]
        for k in np.unique(record).tolist():
            own = J[record == k]
            fine[k] &= np.isfinite(own).all()
            if fine[k]:
                reduced[k].add(np.zeros(len(own)), own)
    roots = [rows.J if well else rows.J[:0] for rows, well in zip(reduced, fine, strict=True)]
    return [_eliminate(J, np.arange(P, problem.K), INVISIBLE_RATIO * np.linalg.norm(J, 2) if len(J) else 0.0) for J in roots]


def _prior_information(problem: FitProblem, given: Estimate | None) -> np.ndarray:
    """Return rows J (., P) for which J^T J is the prior information.

    It is the information of the records and priors of an estimate, if one is given; otherwise that of the priors of `problem`.
    """
    u = problem.unknowns
    which = problem.priors
    priors = np.zeros((len(which), len(u.names)))
    priors[np.arange(len(which)), which] = u.dx_dz(np.zeros(len(u.names)))[which] / u.sigma[which]
    if given is None:
        return priors
    _require_same(u.names, given.names, "an estimate")
    P, earlier = len(u.names), given.problem.unknowns
    scale = np.append(given.uncertainty.noise, 1.0)[given.problem.noise_groups()]
    reduced = Reduction(given.problem.K)
    for block in given.problem.row_blocks(given.z[None], given.tol):
        reduced.add(block.r[0], block.J[0] / scale[block.row_numbers, None])
    J = reduced.J
    rows = _eliminate(J, np.arange(P, given.problem.K), INVISIBLE_RATIO * np.linalg.norm(J, 2))
    factor = u.dx_dz(np.zeros(P)) / earlier.dx_dz(given.z[:P])  # the two sets of unknowns have different first guesses
    return rows * factor  # these include the priors of the estimate


def _eliminate(J: np.ndarray, columns: np.ndarray, floor: float) -> np.ndarray:
    """Return J without `columns`, with its other columns projected on the orthogonal complement of those.

    Singular values of the eliminated columns up to `floor` count as zero.
    """
    others = np.delete(J, columns, axis=1)
    if not len(columns) or not len(J):
        return others
    u, s, _ = np.linalg.svd(J[:, columns], full_matrices=False)
    u = u[:, s > floor]
    return others - u @ (u.T @ others)


def _score(rows: np.ndarray, criterion: Criterion, floor: float) -> tuple[tuple[int, float], np.ndarray]:
    """Return (number of determined directions, score) and the standard errors of the unknowns (K,) for rows J of the information.

    Directions whose singular value is at most `floor` are not determined; the errors of unknowns that change along them are inf.
    """
    K = rows.shape[1]
    _, s, vt = np.linalg.svd(np.concatenate([rows, np.zeros((K, K))]))
    determined = s > floor
    s, lost = s[determined], np.any(np.abs(vt[~determined]) > SMALLEST_PART, axis=0)
    value = {"D": 2.0 * np.log(s).sum(), "A": -np.sum(s**-2.0), "E": float(np.min(s, initial=np.inf) ** 2) if len(s) else 0.0}
    errors = np.sqrt(np.sum((vt[determined] / s[:, None]) ** 2, axis=0))
    return (int(determined.sum()), float(value[criterion])), np.where(lost, np.inf, errors)
