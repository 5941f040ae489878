"""Design of experiments: the candidate whose measurements would determine the parameters best.

With J the derivatives of the predicted measurements, divided by the standard deviations of their noise, a candidate adds J^T J to
the Fisher information M: M^-1 is the covariance of an estimate, to first order in the noise. Nuisance unknowns (initial states,
other parameters) are eliminated by projecting J on the complement of their columns. The best candidate has the largest det M
(criterion "D"), the smallest trace M^-1 ("A"), or the largest smallest eigenvalue of M ("E"), in the dimensionless unknowns of
`identify/problem/parameters.py`. F. Pukelsheim, Optimal Design of Experiments, 2006.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.argument_types import NOT_NEGATIVE, TIMES, ArgumentRequirement, of_kind
from udkjax.positions.assembling.assembly import State
from udkjax.printing import PrintedTable, prints_table
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.answers.uncertainty import SMALLEST_PART
from udkjax.study.identify.problem.fit_problem import FitProblem, build_problem
from udkjax.study.identify.problem.parameters import ParametersLike
from udkjax.study.identify.problem.prediction import MEDIUM_TOL, TolerancePair
from udkjax.study.identify.problem.residuals import Reduction
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO
from udkjax.study.identify.records.records import ChannelKey, IdentificationError, Noise, Record, Start
from udkjax.wording import suggestion

Criterion = Literal["D", "A", "E"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible experiment.

    Args:
        conditions: numbers of the scene that differ in this experiment, by name.
        initial_state: initial state of this experiment; by default that of the scene.
        name: its name in tables.
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
        standard_errors: standard errors in the units of the parameters; inf if a candidate does not determine the parameter.
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
    """Return True for a list of names of channels, and of user-defined quantities."""
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
    given: Estimate | None = None,
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
        given: an estimate, whose values are used and whose records count as prior information.
        tol: tolerance of the integration.
        settings: further arguments of `simulate`.

    Returns:
        The ranking; a candidate that cannot be simulated contributes no information.

    Raises:
        IdentificationError: lists every mistake.
    """
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
    problem = build_problem(mechanism if given is None else given.mechanism, records, parameters, settings)
    names = problem.unknowns.names
    wanted = _select_parameters(names, of)
    prior_rows = _prior_information(problem, given)
    dx_dz = problem.unknowns.dx_dz(np.zeros(len(names)))[wanted]
    roots = _information_of_records(problem, (float(tol), float(tol)))
    floor = INVISIBLE_RATIO * np.linalg.norm(np.concatenate([prior_rows, *roots]), 2)

    def evaluate(which: Sequence[int]) -> tuple[tuple[int, float], np.ndarray]:
        rows = np.concatenate([prior_rows, *(roots[k] for k in which)])
        return _score(_eliminate(rows, np.setdiff1d(np.arange(len(names)), wanted), floor), criterion, floor)

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
        np.stack([errors * dx_dz for _, errors in alone]),
        tuple(sorted(range(len(experiments)), key=lambda k: alone[k][0], reverse=True)),
        tuple(chosen),
        np.stack([evaluate(chosen[: n + 1])[1] * dx_dz for n in range(pick)]),
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


def _information_of_records(problem: FitProblem, tol: TolerancePair) -> list[np.ndarray]:
    """Return rows J (., P) for each record, whose information is J^T J; no rows if a record cannot be computed."""
    P, fine = len(problem.unknowns.names), np.ones(len(problem.records), bool)
    reduced = [Reduction(problem.K) for _ in problem.records]
    for block in problem.row_blocks(np.zeros((1, problem.K)), tol):
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
    """Return rows J; J^T J is the prior information, from the records of an estimate and from priors."""
    u = problem.unknowns
    which = problem.priors
    priors = np.zeros((len(which), len(u.names)))
    priors[np.arange(len(which)), which] = u.dx_dz(np.zeros(len(u.names)))[which] / u.sigma[which]
    if given is None:
        return priors
    if given.names != u.names:
        raise IdentificationError([f"given: is an estimate of {', '.join(given.names)}, not of {', '.join(u.names)}"])
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
    """Return J without `columns`, projected on the complement of these."""
    others = np.delete(J, columns, axis=1)
    if not len(columns) or not len(J):
        return others
    u, s, _ = np.linalg.svd(J[:, columns], full_matrices=False)
    u = u[:, s > floor]
    return others - u @ (u.T @ others)


def _score(rows: np.ndarray, criterion: Criterion, floor: float) -> tuple[tuple[int, float], np.ndarray]:
    """Return the number of determined directions and their score, and the standard errors of the unknowns."""
    K = rows.shape[1]
    _, s, vt = np.linalg.svd(np.concatenate([rows, np.zeros((K, K))]))
    determined = s > floor
    s, lost = s[determined], np.any(np.abs(vt[~determined]) > SMALLEST_PART, axis=0)
    value = {"D": 2.0 * np.log(s).sum(), "A": -np.sum(s**-2.0), "E": float(np.min(s, initial=np.inf) ** 2) if len(s) else 0.0}
    errors = np.sqrt(np.sum((vt[determined] / s[:, None]) ** 2, axis=0))
    return (int(determined.sum()), float(value[criterion])), np.where(lost, np.inf, errors)
