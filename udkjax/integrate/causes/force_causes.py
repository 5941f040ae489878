"""Causes of failed runs in elements: laws that are not finite, and forces that jump, grow without bound or are stiff."""

import numpy as np

from udkjax.integrate.causes.element_loads import ElementLoads, TimedState, element_loads
from udkjax.integrate.causes.failed_run import FailedRun

NEARBY_TIME = 1e-9  # fraction of the span: a load changes much within this time only if it jumps
# Times after the end of the run at which non-finite numbers are looked for, as fractions of the span: the integrator may have
# evaluated them in a rejected step up to ten times as long as the last.
NOT_FINITE_TIMES = (0.0, *np.geomspace(1e-6, 0.1, 80))
LEAST_JUMP = 1e-3  # least relative change of a load over `NEARBY_TIME` at a jump; smooth loads change a million times less
JUMP_PARTS = 8  # number of parts of the way between two states; at a jump, one part has more than half of the change
GROWTH_RATIO = 1e6  # ratio of a load to its earlier value above which it grows without bound
STIFF_PRODUCT = 0.1  # least rate times step; explicit methods of any order lose stability between 1 and 10


def explain_undefined_law(run: FailedRun) -> str:
    """Name the joints, drivers and forces whose laws are not finite at the end of the run or shortly after; "" if all are."""
    t, q, v = run.states[0]
    span = float(run.ts[-1] - run.ts[0])
    states = [(t + share * span, q + share * span * v, v) for share in NOT_FINITE_TIMES]
    loads = _loads(run, states)
    for k, (time, position, _) in enumerate(states):
        psi, length, _ = run.rows.at(time, position) if run.rows.count else (np.zeros(0), np.zeros(0), None)
        bad = ~(np.isfinite(psi) & np.isfinite(length))
        owners = {run.rows.names[i][0] for i in np.flatnonzero(bad)}
        named = [f'{"driver" if name in run.mechanism.drivers else "joint"} "{name}"' for name in sorted(owners)]
        named += [f'force "{name}"' for name, size in zip(loads.names, loads.size[k], strict=True) if not np.isfinite(size)]
        if named:
            return f"{', '.join(named)} is not finite from about {time:.6g} s on: check its law at that time"
    return ""


def explain_violent_force(run: FailedRun) -> str:
    """Describe the force element that jumps at the end of the run, or has grown without bound; "" if there is none."""
    t, q, v = run.states[0]
    span, speed = float(run.ts[-1] - run.ts[0]), float(run.analysis.scales.size(v, np))
    scales = run.analysis.scales
    unit = np.tile([float(scales.length), float(scales.length), 1.0], len(q) // 3)
    turn = 1e-6 * max(speed, float(scales.rate)) * unit
    earlier, later = ((t + sign * NEARBY_TIME * span, q + sign * NEARBY_TIME * span * v, v) for sign in (-1, 1))
    slower, faster = (t, q, v - turn), (t, q, v + turn)
    loads = _loads(run, [earlier, (t, q, v), later, slower, faster, *run.states[1:][::-1][:2]])
    size, names = np.nan_to_num(loads.size, nan=0.0, posinf=1e300), loads.names
    before, now = size[5:].max(0, initial=0.0), size[1]
    slow = max(float(scales.rate), 1 / span) ** 2
    for k, name in enumerate(names):
        if now[k] > GROWTH_RATIO * max(before[k], slow):
            return f'force "{name}" grows without bound: here it is {now[k] / max(before[k], slow):.1g} times what it was'
    largest = size.max(0)
    # A load may jump with time, or with velocity.
    time_jump, speed_jump = _jumps(run, earlier, later), _jumps(run, slower, faster)
    for k, name in enumerate(names):
        if time_jump[k] > LEAST_JUMP * max(largest[k], slow):
            return f'force "{name}" jumps at {t:.6g} s: give its `breakpoints`, smooth it, or make the jump an event'
        if speed_jump[k] > LEAST_JUMP * max(largest[k], slow) and speed_jump[k] > 0.5 * largest[k]:
            return f'force "{name}" jumps with the velocity: smooth it over a small speed, as `Friction` does'
    return ""


def _jumps(run: FailedRun, first: TimedState, last: TimedState) -> np.ndarray:
    """Return the change of each element's load between two neighbouring states if it is a jump, else zero.

    A jump changes the load within one of several parts of the way; a smooth load, however steep, in all of them.
    """
    shares = np.linspace(0.0, 1.0, JUMP_PARTS + 1)
    states = [
        (first[0] + x * (last[0] - first[0]), *((1 - x) * a + x * b for a, b in zip(first[1:], last[1:], strict=True)))
        for x in shares
    ]
    changes = _loads(run, states).jump
    return np.where(np.diff(changes, axis=0).max(0) > 0.5 * changes[-1], changes[-1], 0.0)


def explain_stiff_force(run: FailedRun) -> str:
    """Describe the force element that keeps the steps of an explicit solver short; "" if there is none."""
    t, q, v = run.states[0]
    if not run.is_explicit or run.steps < 1 or not t > run.ts[0]:
        return ""
    loads = _loads(run, [(t, q, v)], run.mobility(t, q))
    step = (t - float(run.ts[0])) / run.steps
    if not loads.names:
        return ""
    damping, stiffness = loads.damping[0], loads.stiffness[0]
    k = int(np.argmax(np.maximum(damping, stiffness)))
    rate, verb = (damping[k], "damps") if damping[k] >= stiffness[k] else (stiffness[k], "swings")
    if not STIFF_PRODUCT < rate * step < 1 / STIFF_PRODUCT**2:
        return ""
    return (
        f'force "{loads.names[k]}" {verb} at a rate of {rate:.2g} 1/s, which limits an explicit solver to steps of {step:.2g} s: '
        "use an implicit one, such as solver=diffrax.Kvaerno5(), or the default, which changes to it by itself, or make it softer"
    )


def _loads(run: FailedRun, states: list, mobility: np.ndarray | None = None) -> ElementLoads:
    return element_loads(run.mechanism, float(run.analysis.scales.length), states, mobility)
