"""Comparison of models of the same records: which friction law, which damper, which number of springs.

The evidence of a model is the integral of its prior times its likelihood. If models are equally probable before the measurements,
their probabilities afterwards are proportional to their evidence; further parameters must earn the volume of their prior.
Leave-one-out compares how well each value is predicted from all others; it needs no priors, but hardly decides between a model
and one that contains it.
R. E. Kass & A. E. Raftery, Journal of the American Statistical Association 90 (1995) 773; A. Vehtari, A. Gelman & J. Gabry,
Statistics and Computing 27 (2017) 1413.
"""

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from udkjax.argument_types import ArgumentRequirement, of_kind
from udkjax.printing import PrintedTable, prints_table
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.study.belief.posterior import Posterior
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.density.laplace import TRUSTED_EXPONENT, Laplace, approximate, pareto_exponent, weigh
from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.identify.records.records import IdentificationError
from udkjax.wording import join_names, quote

MOST_DRAWS = 1024  # largest number of draws from which the prediction of each value is computed
# Weights with a smaller log ratio of the largest to the mean have a reliable mean, whatever their tail.
EQUAL_LOG_RATIO = np.log(2.0)
DECIDED_PROBABILITY = 0.95  # probability from which a model counts as the right one
LEAST_ERRORS = 2.0  # number of standard errors from which two predictions differ

ComparedModel: TypeAlias = InferenceProblem | Estimate | Laplace | Posterior
Score: TypeAlias = Literal["evidence", "loo"]

MODELS = ArgumentRequirement(
    "models",
    of_kind("map names to problems, estimates or posteriors, at least two", lambda x: isinstance(x, Mapping) and len(x) > 1),
)


@prints_table
class Comparison(NamedTuple):
    """A ranking of N models, the best first.

    Attributes:
        by: "evidence" or "loo".
        names: names of the models.
        scores: logarithms of the evidence, or of the density of each value predicted from all others, summed.
        errors: standard errors of the scores: of importance sampling, or of the sum over values.
        differences: scores relative to that of the best model.
        difference_errors: standard errors of the differences.
        probabilities: probabilities of the models by their evidence, if they were equally probable before; else NaN.
        exponents: exponent k of the importance weights of each model; scores are reliable up to 0.67.
    """

    by: Score
    names: tuple[str, ...]
    scores: Float[np.ndarray, "N"]
    errors: Float[np.ndarray, "N"]
    differences: Float[np.ndarray, "N"]
    difference_errors: Float[np.ndarray, "N"]
    probabilities: Float[np.ndarray, "N"]
    exponents: Float[np.ndarray, "N"]

    @property
    def best(self) -> str:
        """Name of the best model."""
        return self.names[0]

    @property
    def decided(self) -> bool:
        """True if the best model has a probability of 95 %, or predicts better than any other by two standard errors."""
        if self.by == "evidence":
            return bool(self.probabilities[0] >= DECIDED_PROBABILITY)
        return bool(np.all(self.differences[1:] < -LEAST_ERRORS * self.difference_errors[1:]))

    @property
    def message(self) -> str:
        """The verdict, one sentence per line."""
        likely = f" with probability {self.probabilities[0]:.3g}" if self.by == "evidence" else ""
        lines = [f"{self.best} is right{likely}" if self.decided and likely else f"{self.best} predicts best"]
        if not self.decided:
            lines = [f"the records do not decide: {self.best} is best{likely}; measure more, or choose the simplest"]
        if poor := [name for name, k in zip(self.names, self.exponents, strict=True) if not k < TRUSTED_EXPONENT]:
            lines.append(f"the score of {join_names(poor)} is unreliable: compare posteriors from `sample`")
        return "\n".join(lines)

    def _table(self) -> PrintedTable:
        columns = [self.scores, self.errors, self.differences, self.difference_errors, self.probabilities, self.exponents]
        rows = [(name, *(f"{x:.4g}" for x in own)) for name, own in zip(self.names, np.transpose(columns), strict=True)]
        what = "log evidence" if self.by == "evidence" else "log density left out"
        heads = "model", what, "error", "difference", "error", "probability", "k"
        return PrintedTable("models, the best first", rows, heads, self.message.splitlines())


@checked
@concrete_only()
def compare(models: Annotated[Mapping[str, ComparedModel], MODELS], by: Score = "evidence") -> Comparison:
    """Compare models of the same records, by their evidence or by leaving out each measured value.

    Args:
        models: problems from `inference`, estimates, their `laplace()`, or draws from `sample`, by name. Problems and estimates
            are approximated at their mode; draws are more reliable where the approximation is poor.
        by: "evidence" for probabilities of the models, for which every number that is not in all of them needs a prior or
            bounds; "loo" for the density of each value predicted from all others, for any priors.

    Returns:
        The models, the best first, with the differences of their scores.

    Raises:
        IdentificationError: the models are of different records, or the evidence depends on a number without a prior.
    """
    found = {name: _with_draws(model) for name, model in models.items()}
    _require_same_records(found)
    if by == "evidence":
        _require_priors(found)
        scores, errors, exponents = np.array([_evidence(model) for model in found.values()]).T
        order = np.argsort(-scores)
        difference_errors = np.hypot(errors, errors[order[0]])
        probabilities = np.exp(scores - np.logaddexp.reduce(scores))
    else:
        each, exponents = zip(*map(_left_out, found.values()), strict=True)
        each, exponents = np.stack(each), np.array(exponents)
        scores, errors = each.sum(1), _error_of_sum(each)
        order = np.argsort(-scores)
        difference_errors = _error_of_sum(each - each[order[0]])
        probabilities = np.full(len(scores), np.nan)
    difference_errors[order[0]] = 0.0
    columns = scores, errors, scores - scores[order[0]], difference_errors, probabilities, exponents
    return Comparison(by, tuple(list(found)[k] for k in order), *(column[order] for column in columns))


def _with_draws(model: ComparedModel) -> Laplace | Posterior:
    if isinstance(model, InferenceProblem):
        return approximate(model, model.start)
    return model.laplace(quick=False) if isinstance(model, Estimate) else model


def _require_same_records(models: Mapping[str, Laplace | Posterior]) -> None:
    (first, one), *others = ((name, model.problem.fit_problem) for name, model in models.items())
    for name, other in others:
        if not np.array_equal(other.measured, one.measured) or not np.array_equal(other.index, one.index):
            cure = "give all models the same records, and the same columns to ignore"
            raise IdentificationError([f"models: {quote(name)} and {quote(first)} are of different measured values: {cure}"])


def _require_priors(models: Mapping[str, Laplace | Posterior]) -> None:
    """Raise an error if some models, but not all, have a number without a proper prior.

    The prior of such a number has no finite volume; this volume only cancels in a comparison if all models have the number.
    """
    without = {
        name: [n for n, p in zip(m.problem.names, m.problem.prior.proper, strict=True) if not p] for name, m in models.items()
    }
    common = set[str].intersection(*map(set, without.values()))
    problems = [
        f'models: the evidence of {quote(name)} needs a prior or bounds of {join_names(missing)}; or compare by="loo"'
        for name, names in without.items()
        if (missing := [n for n in names if n not in common])
    ]
    if problems:
        raise IdentificationError(problems)


def _evidence(model: Laplace | Posterior) -> tuple[float, float, float]:
    """Return the logarithm of a model's evidence, its standard error, and the exponent of the importance weights."""
    if isinstance(model, Posterior):
        x = model.x.reshape(-1, model.x.shape[2])
        model = weigh(model.problem, x.mean(0), np.linalg.cholesky(np.cov(x.T).reshape(x.shape[1], -1)))
    return model.log_evidence, model.log_evidence_error, model.k


def _left_out(model: Laplace | Posterior) -> tuple[Float[np.ndarray, "R"], float]:
    """Return the log density of each measured value, predicted from all others, and the largest exponent of the weights (k)."""
    if isinstance(model, Posterior):
        x = model.x.reshape(-1, model.x.shape[2])
        x, weights = x[:: -(-len(x) // MOST_DRAWS)], 0.0
    else:
        x, weights = model.trials, model.log_weights - np.logaddexp.reduce(model.log_weights)
    compiled = model.problem.compiled("likelihoods", lambda problem, x: jax.vmap(problem.log_likelihoods)(x))
    likelihoods = np.asarray(compiled(x)).T
    inverse = weights - np.where(np.isfinite(weights), likelihoods, 0.0)
    each = np.logaddexp.reduce(np.broadcast_to(weights, len(x))) - np.logaddexp.reduce(inverse, axis=1)
    rest = inverse[inverse.max(1) > np.logaddexp.reduce(inverse, axis=1) - np.log(len(x)) + EQUAL_LOG_RATIO]
    return each, max(map(pareto_exponent, rest), default=-np.inf)


def _error_of_sum(each: Float[np.ndarray, "N R"]) -> Float[np.ndarray, "N"]:
    """Return the standard error of the sum of the R values of each row."""
    return np.sqrt(each.shape[1] * each.var(axis=1))
