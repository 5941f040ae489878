"""`inference`: from a mechanism, records, the names of parameters and priors to the logarithm of a posterior density."""

from collections.abc import Sequence
from typing import Annotated, Any

from udkjax.argument_types import NOT_NEGATIVE, NOT_NEGATIVE_COUNT
from udkjax.equations.rows.analysis import Analysis
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.identify.density.priors import Priors, with_normal_priors
from udkjax.study.identify.problem.fit_problem import FitProblem, build_problem
from udkjax.study.identify.problem.parameters import ParametersLike
from udkjax.study.identify.problem.prediction import LOOSE_TOL
from udkjax.study.identify.records.record_reader import Data
from udkjax.study.identify.records.records import Estimated, Noise, Start
from udkjax.study.quantities import StudyModel


@checked
@concrete_only()
def inference(
    mechanism: StudyModel,
    data: Data,
    parameters: ParametersLike,
    *,
    priors: Priors = None,
    noise: Noise = None,
    initial_state: Start | Estimated | None = None,
    tol: Annotated[float, NOT_NEGATIVE] = LOOSE_TOL,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    ignore: Sequence[str] = (),
    **settings: Any,
) -> InferenceProblem:
    """Return the posterior density of parameters of a mechanism, given measured motion.

    The density is the prior times the likelihood of `identify`, normal noise of the measurements. It is a function of JAX of an
    unconstrained vector, for any sampler; see `InferenceProblem.log_density`.

    Args:
        mechanism: the scene, or a `ConstrainedSystem` with q0: as for `identify`.
        data: records, as for `identify`.
        parameters: names of numbers, `length`s, ties or `Parameter`s, as for `identify`.
        priors: for each name, the mean and standard deviation of a normal distribution, which is cut off at the bounds of the
            number; a function of JAX that returns the logarithm of the density; or an object with such a function as `log_prob`
            (a distribution of numpyro) or `logpdf`. Without a prior, a number is uniform: between its bounds, above zero, or
            everywhere.
        noise: standard deviation, in SI units, of all channels or by channel. If it is not given, that of each channel is one
            more unknown, "noise of" the channel, whose logarithm is uniform unless it has a prior.
        initial_state: the `Start` of every record, or the parts of the initial state that are unknown.
        tol: tolerance of the integration, relative and absolute.
        seed: seed of guesses that close the loops, if the first guess does not.
        ignore: columns of tables that are not read.
        settings: further arguments of `simulate`. By default, `max_steps` is 20 times the number of steps at the start; with
            numbers far from it, where a run takes more, the density is zero.

    Returns:
        The problem, with `log_density`, `names`, `units`, `start` and `parameters`.

    Raises:
        IdentificationError: lists every mistake, such as a start that cannot be simulated or where a prior has no density.
    """
    Analysis.require_masses(mechanism, "free motions")
    tol = float(tol)
    problem = build_problem(mechanism, data, parameters, settings, noise, ignore, seed, "auto", initial_state, tol)
    unknowns, functions = with_normal_priors(problem.unknowns, priors or {})
    return InferenceProblem(FitProblem(problem.mechanism, unknowns, problem.records, problem.settings), functions, (tol, tol))
