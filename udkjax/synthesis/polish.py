"""Newton's method for the best trials of a search, since Gauss-Newton steps converge slowly if residuals remain.

The merit is that of search.py, over all unknowns z = (x, s) in units of their scales. Its gradient is exact; its Hessian is
computed by differences of gradients, evaluated in one batch. Steps go downhill along every eigenvector,

    dz = -V (|Lambda| + mu)^(-1) V^T g.
"""

import numpy as np

from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.search import ROUNDING_LOSS, SearchState, harden, merit_of, must_continue
from udkjax.synthesis.steps import ACTIVE_SETS
from udkjax.synthesis.trials import TrialResiduals, Trials

# Relative to the scales; small enough for mechanisms that barely turn. Rounding errors of the Hessian are about 1e-8.
DIFFERENCE_STEP = 1e-7
FIRST_SHIFT, LEAST_SHIFT, MOST_SHIFT = 1e-3, 1e-14, 1e6  # mu, relative to the largest eigenvalue
CONVERGED_DECREASE = 1e-13  # predicted relative decrease of the merit


def polish(problem: DesignProblem, state: SearchState, steps: int, threads: int | None = None) -> SearchState:
    """Improve all trials of a state by at most `steps` Newton steps; return the state, which is changed in place."""
    members, sign = len(state.merit), np.sign(state.found.transmission[:, 0])
    shift, done = np.full(members, FIRST_SHIFT), ~state.found.exists
    for _ in range(steps):
        active = np.flatnonzero(~done)
        if not len(active):
            break
        _newton_step(problem, state, active, sign, shift, done, threads)
    return state


def _newton_step(
    problem: DesignProblem,
    state: SearchState,
    active: np.ndarray,
    sign: np.ndarray,
    shift: np.ndarray,
    done: np.ndarray,
    threads: int | None,
):
    trials, found = state.trials.take(active), state.found.take(active)
    u, weight = state.multipliers[active], state.weight[active]
    z, units = _join(problem, trials)
    pressed = found.limits + u > 0
    g = _gradient(problem, found, u, weight, pressed) * units
    H = _hessian(problem, trials, z, units, (u, weight, state.margin[active], pressed), threads)
    usable = np.isfinite(H).all((1, 2))
    H = np.where(usable[:, None, None], H, np.eye(H.shape[1]))
    slopes = np.zeros((*pressed.shape, len(units)))
    slopes[..., : problem.unknown_count] = found.limits_by_unknowns
    slopes *= units
    for _ in range(ACTIVE_SETS):
        dz = _downhill(problem, trials, H, g, shift[active])
        now = found.limits + u + np.einsum("mkp,mp->mk", slopes, dz) > 0
        if np.array_equal(now, pressed):
            break
        # A limit contributes curvature and slope only while it is active.
        change = 2.0 * weight[:, None] ** 2 * (now.astype(float) - pressed)
        H = H + slopes.transpose(0, 2, 1) @ (change[..., None] * slopes)
        g = g + np.einsum("mkp,mk->mp", slopes, change * (found.limits + u))
        pressed = now
    longest = np.abs(dz).max(1)
    dz *= np.minimum(1.0, 0.3 / np.maximum(longest, 1e-300))[:, None]
    new = _split(problem, z + dz * units, trials)
    trial = problem.evaluate(new, state.margin[active], threads)
    ordered = np.all(np.diff(new.s, axis=1) * np.sign(trials.s[:, -1:] - trials.s[:, :1]) > 0, axis=1) | (not problem.local)
    exists = usable & ordered & trial.exists & np.all(np.sign(trial.transmission) == sign[active][:, None], axis=1)
    merit = np.where(exists, merit_of(trial, u, weight), np.inf)
    better = merit < state.merit[active]
    accepted, rejected = active[better], active[~better]
    state.accept(problem, accepted, new.take(better), trial.take(better), merit[better])
    promised = np.abs(np.einsum("mk,mk->m", g, dz))
    small = promised <= CONVERGED_DECREASE * state.merit[active] + ROUNDING_LOSS * problem.scale**2
    shift[accepted] = np.maximum(0.1 * shift[accepted], LEAST_SHIFT)
    shift[rejected] = shift[rejected] * 10.0
    ended = active[small | (shift[active] > MOST_SHIFT)]
    wrong = must_continue(problem, state, ended)
    harden(problem, state, ended[wrong])
    shift[ended[wrong]] = FIRST_SHIFT
    done[ended[~wrong]] = True


def _downhill(problem: DesignProblem, trials: Trials, H: np.ndarray, g: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the steps dz (M, N) of trials by their Hessians H, gradients g and shifts; unknowns at bounds may be fixed."""
    fixed = np.zeros(g.shape, bool)
    gradient_x = g[:, : problem.unknown_count]
    at_low, at_high = trials.x <= problem.low, trials.x >= problem.high
    fixed[:, : problem.unknown_count] = (at_low & (gradient_x > 0)) | (at_high & (gradient_x < 0))
    values, V = np.linalg.eigh(np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, H))
    size = np.maximum(np.abs(values).max(1), 1e-300)
    components = np.einsum("mki,mk->mi", V, np.where(fixed, 0.0, g)) / (np.abs(values) + (shift * size)[:, None])
    return np.where(fixed, 0.0, -np.einsum("mki,mi->mk", V, components))


def _join(problem: DesignProblem, trials: Trials) -> tuple[np.ndarray, np.ndarray]:
    """Return all unknowns of the trials, z = (x, s) (M, N), and their units (N,)."""
    units = np.ones(problem.unknown_count)
    units[: problem.free.count] = problem.sizes
    if not problem.local:
        return trials.x, units
    return np.concatenate([trials.x, trials.s], 1), np.append(units, np.ones(trials.s.shape[1]))


def _split(problem: DesignProblem, z: np.ndarray, trials: Trials) -> Trials:
    x = np.clip(z[:, : problem.unknown_count], problem.low, problem.high)
    return Trials(x, z[:, problem.unknown_count :] if problem.local else problem.values_at(x, trials.s), trials.q)


def _gradient(
    problem: DesignProblem, found: TrialResiduals, multipliers: np.ndarray, weight: np.ndarray, pressed: np.ndarray
) -> np.ndarray:
    excess = weight[:, None] ** 2 * (found.limits + multipliers) * pressed
    by_x = np.einsum("mjgp,mjg->mp", found.by_unknowns, found.r) + np.einsum("mkp,mk->mp", found.limits_by_unknowns, excess)
    by_x += np.einsum("mtp,mt->mp", found.terms_by_unknowns, found.terms)
    if not problem.local:
        return 2.0 * by_x
    return 2.0 * np.concatenate([by_x, np.einsum("mjg,mjg->mj", found.by_value, found.r)], 1)


def _hessian(
    problem: DesignProblem,
    trials: Trials,
    z: np.ndarray,
    units: np.ndarray,
    limits: tuple[np.ndarray, ...],
    threads: int | None,
) -> np.ndarray:
    members, N = z.shape
    moves = DIFFERENCE_STEP * np.concatenate([np.diag(units), -np.diag(units)])  # (2 N, N)
    moved = (z[:, None] + moves).reshape(-1, N)
    repeated = Trials(*(np.repeat(a, 2 * N, 0) for a in trials))
    x = moved[:, : problem.unknown_count]
    split = Trials(x, moved[:, problem.unknown_count :] if problem.local else problem.values_at(x, repeated.s), repeated.q)
    u, weight, margin, pressed = (np.repeat(a, 2 * N, 0) for a in limits)
    moved_trials = problem.evaluate(split, margin, threads)
    g = _gradient(problem, moved_trials, u, weight, pressed) * units
    g = np.where(moved_trials.exists[:, None], g, np.nan).reshape(members, 2, N, N)
    H = (g[:, 0] - g[:, 1]) / (2.0 * DIFFERENCE_STEP)
    return 0.5 * (H + H.transpose(0, 2, 1))
