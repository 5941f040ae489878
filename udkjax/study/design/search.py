"""Levenberg-Marquardt steps of many trials at once, with values of the driver as unknowns of their own.

With residuals r(x, s), a position's value s_j moves its own residuals alone. So it is eliminated: with a_j = dr_j/ds_j,

    (A - W^T H^-1 W) dx = -(b - W^T H^-1 g),    ds_j = -(g_j + w_j dx) / h_j,
    A = sum_j J_j^T J_j,  w_j = a_j^T J_j,  g_j = a_j^T r_j,  h_j = a_j^T a_j,

each diagonal increased by a damping. Limits c(x) <= 0 are kept by an augmented Lagrangian: residuals w max(0, c + u), whose
multipliers u become max(0, c + u) whenever a trial has settled. Bounds are kept by active sets: unknowns that would leave stay.
"""

from dataclasses import dataclass

import numpy as np

from udkjax.study.design.design_problem import MARGIN_WEIGHT, DesignProblem, TrialResiduals, Trials

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-10, 1e8
RELAX, TIGHTEN = 0.2, 4.0  # of the damping, after a step that is taken and one that is not
# Weights w of limits beside residuals. A search begins with soft walls, along which it finds its way, and hardens them each time
# it has settled: the violation falls by the square of the weight.
FIRST_WEIGHT, HARDEN, MOST_WEIGHT = 0.5, 6.0, 100.0
# Squares of transmissions: where limits begin, and by what they shrink to what is asked for, whenever a trial has settled.
FIRST_MARGIN, SHRINK_MARGIN = 1e-3, 0.03
KEPT_TO = 1e-8  # scales: what a limit may be exceeded by in the end, before the last polish
SETTLED = 1e-9  # relative fall of the loss below which a trial has settled
ROUNDING = 1e-26  # of the squared scale: a loss below is zero to rounding
LONGEST_MOVE = 0.5  # scales: of an unknown in one step
ACTIVE_SETS = 5  # rounds in which a step finds out which limits it will press on
GAP_SHARE = 0.45  # of the gap to the next value that a value may move by in one step: so that their order stays


@dataclass
class SearchState:
    """Trials on their way: with all that is known where they are."""

    trials: Trials
    found: TrialResiduals
    multipliers: np.ndarray
    weight: np.ndarray
    margin: np.ndarray
    damping: np.ndarray
    merit: np.ndarray
    settled: np.ndarray

    def take(self, which: np.ndarray) -> "SearchState":
        """Return some of them."""
        found = TrialResiduals(*(a[which] for a in self.found))
        rest = (self.multipliers, self.weight, self.margin, self.damping, self.merit, self.settled)
        return SearchState(self.trials.take(which), found, *(a[which] for a in rest))


def loss_of(r: np.ndarray) -> np.ndarray:
    """Return the sum of the squares of residuals (M,)."""
    return np.einsum("mjg,mjg->m", r, r)


def improve(
    problem: DesignProblem, trials: Trials, steps: int, threads: int | None = None, state: SearchState | None = None
) -> SearchState:
    """Improve trials by so many steps at most; return where they got, those that have no positions with an infinite merit.

    `state` is that of the trials, where they have been improved before.
    """
    state = _first_state(problem, trials, threads) if state is None else state
    sign = np.sign(state.found.transmission[:, 0])
    for _ in range(steps):
        active = np.flatnonzero(~state.settled)
        if not len(active):
            break
        _step(problem, state, active, sign, threads)
    return state


def _first_state(problem: DesignProblem, trials: Trials, threads: int | None) -> SearchState:
    members = len(trials.x)
    margin = np.full(members, max(problem.least**2, FIRST_MARGIN))
    found = problem.evaluate(trials, margin, threads)
    multipliers = np.zeros_like(found.limits)
    weight, damping, merit = np.full(members, FIRST_WEIGHT), np.full(members, FIRST_DAMPING), np.full(members, np.inf)
    state = SearchState(trials, found, multipliers, weight, margin, damping, merit, ~found.is_there)
    state.merit[found.is_there] = merit_of(found, multipliers, weight)[found.is_there]
    return state


def merit_of(found: TrialResiduals, multipliers: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the loss with what limits add to it (M,)."""
    excess = weight[:, None] * np.maximum(found.limits + multipliers, 0.0)
    return loss_of(found.r) + np.einsum("mk,mk->m", excess, excess)


def _step(problem: DesignProblem, state: SearchState, active: np.ndarray, sign: np.ndarray, threads: int | None):
    trials, found = state.trials.take(active), TrialResiduals(*(a[active] for a in state.found))
    dx, ds = _find_step(problem, trials, found, state.multipliers[active], state.weight[active], state.damping[active])
    new = Trials(np.clip(trials.x + dx, problem.low, problem.high), trials.s + ds, trials.q)
    there = problem.evaluate(new, state.margin[active], threads)
    exists = there.is_there & np.all(np.sign(there.transmission) == sign[active][:, None], axis=1)
    merit = np.where(exists, merit_of(there, state.multipliers[active], state.weight[active]), np.inf)
    with np.errstate(invalid="ignore"):
        better = merit < state.merit[active]
        fall = state.merit[active] - merit
    taken, kept = active[better], active[~better]
    settled = fall[better] < SETTLED * state.merit[taken]
    for a, b in zip((*state.trials, *state.found), (*new[:2], there.q, *there), strict=True):
        a[taken] = b[better]
    state.merit[taken] = merit[better]
    state.damping[taken] = np.maximum(RELAX * state.damping[taken], LEAST_DAMPING)
    state.damping[kept] *= TIGHTEN
    done = np.concatenate(
        [taken[settled | (merit[better] < ROUNDING * problem.scale**2)], kept[state.damping[kept] > MOST_DAMPING]]
    )
    _settle(problem, state, done)


def _settle(problem: DesignProblem, state: SearchState, done: np.ndarray):
    """Trials that go no farther have settled, unless a limit is still exceeded or pressed on in vain: multipliers change then."""
    again = done[goes_on(problem, state, done)]
    state.settled[done] = True
    harden(problem, state, again)
    state.damping[again] = np.minimum(state.damping[again], FIRST_DAMPING)


def goes_on(problem: DesignProblem, state: SearchState, which: np.ndarray) -> np.ndarray:
    """Return of trials that go no farther whether they should, once limits have changed."""
    limits, u = state.found.limits[which], state.multipliers[which]
    wrong = np.max(np.abs(np.maximum(limits, -u)), axis=1, initial=0.0) > KEPT_TO * problem.scale
    if problem.has_margin:  # the last rows
        rows = slice(problem.lengths.count, None)
        wrong |= (state.margin[which] > problem.least**2) & np.any(limits[:, rows] + u[:, rows] > 0, axis=1)
    return wrong


def harden(problem: DesignProblem, state: SearchState, which: np.ndarray):
    """Update the multipliers of some trials, harden their limits, and bring their margins nearer to what is asked for."""
    harder = np.minimum(state.weight[which] * HARDEN, MOST_WEIGHT)
    softer = (state.weight[which] / harder)[:, None] ** 2
    state.multipliers[which] = softer * np.maximum(0.0, state.found.limits[which] + state.multipliers[which])
    state.weight[which], state.settled[which] = harder, False
    margin = np.maximum(SHRINK_MARGIN * state.margin[which], problem.least**2)
    if problem.has_margin:
        unit = MARGIN_WEIGHT * problem.scale
        state.found.limits[which, problem.lengths.count :] += unit * (margin - state.margin[which])[:, None]
    state.margin[which] = margin
    state.merit[which] = merit_of(TrialResiduals(*(a[which] for a in state.found)), state.multipliers[which], harder)


def _find_step(
    problem: DesignProblem,
    trials: Trials,
    found: TrialResiduals,
    multipliers: np.ndarray,
    weight: np.ndarray,
    damping: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    members, P = trials.x.shape
    J, r = found.by_unknowns.reshape(members, -1, P), found.r.reshape(members, -1)
    Jt = J.transpose(0, 2, 1)
    A, b = Jt @ J, (Jt @ r[..., None])[..., 0]
    diagonal = np.einsum("mpp->mp", A).copy()
    w = g = h = np.zeros(0)
    if problem.local:
        w = np.einsum("mjg,mjgp->mjp", found.by_value, found.by_unknowns)
        g = np.einsum("mjg,mjg->mj", found.by_value, found.r)
        h = np.einsum("mjg,mjg->mj", found.by_value, found.by_value)
        h = h * (1.0 + damping[:, None]) + np.finfo(float).eps * problem.scale**2
        scaled = w / h[..., None]
        A, b = A - scaled.transpose(0, 2, 1) @ w, b - np.einsum("mjp,mj->mp", scaled, g)
    excess, slopes, places = found.limits + multipliers, found.limits_by_unknowns, np.arange(P)
    pressed = excess > 0
    for _ in range(ACTIVE_SETS):
        force = weight[:, None] ** 2 * pressed
        with_limits = A + slopes.transpose(0, 2, 1) @ (force[..., None] * slopes)
        gradient = b + np.einsum("mkp,mk->mp", slopes, force * excess)
        size = diagonal + np.einsum("mkp,mk->mp", slopes**2, force)
        steepest = np.max(size, axis=1, keepdims=True)
        with_limits[:, places, places] += damping[:, None] * size + np.finfo(float).eps * (steepest + (steepest == 0))
        held = ((trials.x <= problem.low) & (gradient > 0)) | ((trials.x >= problem.high) & (gradient < 0))
        with_limits = np.where(held[:, :, None] | held[:, None, :], 0.0, with_limits)
        with_limits[:, places, places] += held
        dx = -np.linalg.solve(with_limits, np.where(held, 0.0, gradient)[..., None])[..., 0]
        before, pressed = pressed, excess + np.einsum("mkp,mp->mk", slopes, dx) > 0
        if np.array_equal(before, pressed):
            break
    longest = np.max(np.abs(dx[:, : problem.free.count]), axis=1, initial=0.0)
    dx *= np.minimum(1.0, LONGEST_MOVE * problem.reach / np.maximum(longest, 1e-300))[:, None]
    if not problem.local:
        return dx, np.zeros_like(trials.s)
    ds = -(g + np.einsum("mjp,mp->mj", w, dx)) / h
    return dx, _in_order(ds, trials.s, np.inf if problem.is_closed else problem.period)


def _in_order(ds: np.ndarray, s: np.ndarray, period: float) -> np.ndarray:
    """Shorten changes of values so that their order stays, around the whole period; of a closed curve its ends may meet."""
    gap = np.abs(np.diff(s, axis=1))
    last = np.maximum(period - np.abs(s[:, -1:] - s[:, :1]), 0.0)
    gap = np.concatenate([gap, last], 1)
    most = GAP_SHARE * np.minimum(gap, np.roll(gap, 1, axis=1))
    return np.clip(ds, -most, most)
