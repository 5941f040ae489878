"""Identify: from a mechanism, records and the names of parameters to an estimate."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from udkjax.integrate.solution import CAUSES, Result
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.descent import method_of
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.estimate import Estimate
from udkjax.study.identify.fitting import Fit, descend
from udkjax.study.identify.losses import Loss, loss_of
from udkjax.study.identify.posing import TOL, posed
from udkjax.study.identify.problem import Problem
from udkjax.study.identify.records import Estimated, Start
from udkjax.study.identify.search import GUESSES, SETTLED, Found, Strategy, search
from udkjax.study.identify.shooting import Shooting
from udkjax.study.progress import Line

WEIGHED = 2  # fits, each with noise as the one before left it
EVEN = 1e-6  # of what a channel shows: residuals below it count alike, since they are not of measurements
EQUAL = 1.05  # weights that differ by less, compared with each other, move no estimate by what counts beside its error
POLISHED = 15  # steps at the end
PATIENCE = 2.0  # s: what is done before then needs no line to say so


def identify(
    mechanism: Mechanism,
    data: Any,
    parameters: Sequence[Any] | str,
    *,
    noise: Any = None,
    start: Start | Estimated | None = None,
    starts: int | Any = GUESSES,
    loss: str | Callable[[Any], Any] = "least_squares",
    optimizer: Any = None,
    strategy: Strategy = "auto",
    tol: float = TOL,
    seed: int = 0,
    ignore: Sequence[str] = (),
    progress: Any = None,
    **settings: Any,
) -> Estimate:
    """Find the values of parameters with which a mechanism moves as was measured.

    `data` is a `Record`, a mapping of times ("time") and channels, a table of pandas or a dataset of xarray, the path of a CSV or
    NetCDF file, or a sequence of these: records, each with a start of its own. `parameters` are names of numbers of the scene,
    `length`s, ties in text (`body.a.mass = body.b.mass`), or `Parameter`s with bounds and priors. `noise` is the standard
    deviation of all channels, or maps channels to theirs; where none is given it is estimated from what the fit leaves. `ignore`
    names columns of tables that are not looked at. `start` is the `Start` of every record, or what of it is to be estimated
    ("position", "velocity", "both"); by default the records' own, and for those of tables the scene's.

    With y what was measured and yhat(z) what the mechanism shows, sum ((yhat(z) - y) / sigma)^2 is minimized, by
    Levenberg-Marquardt with exact forward derivatives, through the closure of all loops; `loss="huber"` lets single wrong
    numbers count less, and a function of the weighted residuals (R,) by JAX is minimized itself (standard errors stay those of
    squares). `optimizer` is another least-squares solver of optimistix, or any optimizer of optax.

    Where the first guess does not lead to a fit that explains the records, it is looked for along growing parts of them, and
    from other guesses: `starts` is how many more there may be (0: none), or an array of guesses (B, P) to try besides the first.
    Where these do not lead to one either, as along chaotic motion, the records are cut into pieces that are held together;
    `strategy="pieces"` does so at once.

    `tol` is the tolerance of the integration at the end; `settings` are others of `simulate`. `progress`: None shows a line,
    False nothing.

    Raises `IdentificationError`, which lists every mistake; also where a parameter would open a loop that has more constraints
    than it needs. What the records cannot tell is no error: `Estimate.success` is false, and `Estimate.message` says what.
    """
    begun = time.perf_counter()
    problem = posed(mechanism, data, parameters, settings, noise, ignore, seed, strategy, start, tol)
    lost = None if callable(loss) else loss_of(loss, len(problem.where))
    tell = _teller(progress)
    guesses, more = _guesses(problem, starts)
    choices = {"loss": lost, "method": method_of(optimizer, loss)}
    found = search(problem, guesses, (tol, tol), more, seed, tell, strategy, **choices)
    _require_some(problem, found)
    fit, history = _settled(found, tol, tell, choices)
    tell("")
    return Estimate.of(fit, found, history, (tol, tol), lost, time.perf_counter() - begun)


def _settled(found: Found, tol: float, tell: Callable, choices: Mapping[str, Any]) -> tuple[Fit, list]:
    """The fit to the end, each channel weighted by the noise that it has turned out to have."""
    problem, fit, history = found.problem, found.fit, list(found.history)
    end = partial(_polished, problem, tol=(tol, tol), tell=tell, **choices)
    fit = end(fit.z)
    history += fit.history
    unknown = {problem.names[c] for c in np.unique(problem.where[~problem.known, 2])}
    for _ in range(WEIGHED if len(unknown) + problem.known.any() > 1 else 0):
        if not weigh(problem, fit.z, tol, choices["loss"], EVEN):
            break
        fit = end(fit.z)
        history += fit.history
    return fit, history


def _polished(problem: Problem | Shooting, z: np.ndarray, **choices: Any) -> Fit:
    """A fit from beside its minimum; with damped steps where other weights have moved it far along what is hardly known."""
    near = descend(problem, z, steps=POLISHED, near=True, **choices)
    if near.settled[0] or near.history[-1][1] <= SETTLED:
        return near
    fit = descend(problem, near.z, **choices)
    return fit._replace(history=near.history + fit.history)


def weigh(problem: Problem | Shooting, z: np.ndarray, tol: float, loss: Loss, least: float = 0.0) -> bool:
    """Take as the noise of each channel whose noise is not known what a fit leaves of it, and `least` of what it shows.

    Return whether residuals weigh otherwise now, compared with each other.
    """
    before = problem.sigma.copy()
    found = problem.evaluate(z, (tol, tol))
    found = found if loss is None else loss(found)
    rows = len(problem.where)
    left = found.r[0, :rows] * problem.sigma
    for c in range(len(problem.channels)):
        mine = (problem.where[:, 2] == c) & ~problem.known
        if mine.any():
            # Unknowns take their part of each channel's freedom.
            free = mine.sum() * (1.0 - (problem.K - problem.tied) / rows)
            size = np.sqrt(left[mine] @ left[mine] / max(free, 1.0))
            problem.sigma[mine] = max(size, least * problem.spread[c], np.finfo(float).tiny ** 0.25 * problem.spread[c])
    ratio = problem.sigma / before
    return bool(ratio.max() > EQUAL * ratio.min()) or loss is not None or bool(len(problem.priors))


def _guesses(problem: Problem, starts: Any) -> tuple[np.ndarray, int]:
    """First guesses (B, K), and how many more may be made."""
    first, P = np.zeros((1, problem.K)), len(problem.unknowns.names)
    if isinstance(starts, int | np.integer):
        if starts < 0:
            raise IdentificationError([f"starts: must be a number of guesses from 0 on, is {starts}"])
        return first, int(starts)
    given = np.asarray(starts, float)
    if given.ndim != 2 or given.shape[1] != P or not np.isfinite(given).all():
        raise IdentificationError(
            [f"starts: must be a number, or guesses (B, {P}), one value a parameter; is of shape {given.shape}"]
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        z = problem.unknowns.unknowns(given)
    if not np.isfinite(z).all():
        wrong = problem.unknowns.names[int(np.argmax(~np.isfinite(z).all(0)))]
        raise IdentificationError([f"starts: a guess of {wrong} is not between its bounds, or not positive"])
    return np.concatenate([first, np.concatenate([z, np.zeros((len(z), problem.K - P))], 1)]), 0


def _require_some(problem: Problem, found: Found) -> None:
    if np.isfinite(found.fit.cost).any():
        return
    code = problem.evaluate(found.fit.z, (1e-6, 1e-6)).code[0]
    raise IdentificationError([f"no first guess could be simulated along the records: {CAUSES[Result(int(code))]}"])


def _teller(progress: Callable[[str], Any] | bool | None) -> Callable[[str], Any]:
    if progress is False:
        return lambda text: None
    if progress is not None and progress is not True:
        return progress
    line, begun = Line(), time.monotonic()

    def tell(text: str) -> None:
        if time.monotonic() - begun < PATIENCE:
            return
        if text and line.due():
            line.say(text)
        elif not text and line.over:
            line.say("identified", last=True)

    return tell
