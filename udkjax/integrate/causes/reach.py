"""The reach of drivers: the value beyond which constraints cannot be closed, and the cause.

The position is followed in small steps of time from the last good state until one cannot be closed; that step is then bisected.
Rows with impossible demands are in the left null space of D. At a dead point, rows are dependent in that position only; rows of
drivers that contradict each other, or the joints, are dependent in every position.
"""

from typing import NamedTuple

import numpy as np

from udkjax.equations.rows.redundancy import holders_of_driver
from udkjax.integrate.causes.failed_run import FailedRun
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism

REACH_STEPS = 32  # number of steps from the last good state to the time of the failure
REACH_HALVINGS = 34  # bisections of the failing step: to 2e-12 of the time to the failure
DEAD_POINT_TOL = 1e-2  # relative to the largest singular value of D: smaller ones belong to the dead point, found to 1e-5 or so
INVOLVED_SHARE = 1e-3  # relative to the largest row of a combination: smaller rows are not involved
IN_LINE_TOL = 1e-3  # (rad)
STATES_TRIED = 4  # states to start from
SAME_BRANCH_DISTANCE = 1.0  # in rad and characteristic lengths: larger changes lead to another branch


class Reach(NamedTuple):
    """The last position at which the constraints close, and those constraints whose demands beyond it are impossible."""

    t: float  # (s)
    q: np.ndarray  # (n,)
    owners: frozenset[str]  # constraints whose rows contradict each other


def explain_reach(run: FailedRun, until: float) -> str:
    """Describe the demands of drivers up to the time `until` (s) that the mechanism cannot meet; "" if it can meet all."""
    mechanism = run.mechanism
    if not mechanism.drivers:
        return ""
    reach = _find_reach(run, until)
    if reach is None:
        return ""
    names = [name for name in mechanism.driver_names if name in reach.owners]
    if not names:
        return ""
    opposed = holders_of_driver(mechanism, names[-1]) is not None
    demands = " and ".join(f'driver "{name}" asks for {_value(mechanism, name, until)}' for name in names)
    where = f"at {until:.6g} s"
    if opposed and len(names) > 1:
        listed = " and ".join(f'"{name}"' for name in names)
        return f"drivers {listed} contradict each other: {demands} {where}; remove one, or change its motion"
    if opposed:
        return f"{demands} {where}, where the joints leave its coordinate no motion; remove the driver, or free the coordinate"
    reached = " and ".join(_value(mechanism, name, reach.t) for name in names)
    point = dead_point(mechanism, reach, names)
    return f"{demands} {where}; the linkage reaches {reached}, at {reach.t:.6g} s ({point})"


def _find_reach(run: FailedRun, until: float) -> Reach | None:
    """Return the last position at which the constraints close before the time `until` (s).

    Return None if they close up to this time, or at none of the last states of the run.
    """
    rows, size = run.rows, run.rows.scales.size
    first = next((p for p in (rows.close(t, q) for t, q, _ in run.states[:STATES_TRIED] if t < until) if p is not None), None)
    if first is None:
        return None
    t, q, before = first.t, first.q, None

    def close(at: float) -> np.ndarray | None:
        guess = q if before is None else q + (q - before[1]) * (at - t) / (t - before[0])
        for start in (guess, q):
            p = rows.close(at, start)
            if p is not None and size(p.q - q, np) < SAME_BRANCH_DISTANCE:
                return p.q
        return None

    high = None
    for at in np.linspace(t, until, REACH_STEPS + 1)[1:]:
        closure = close(float(at))
        if closure is None:
            high = float(at)
            break
        before, (t, q) = (t, q), (float(at), closure)
    if high is None:
        return None
    before = None  # extrapolation misleads near a dead point
    for _ in range(REACH_HALVINGS):
        middle = 0.5 * (t + high)
        closure = close(middle) if t < middle < high else None
        if closure is None:
            high = middle
        else:
            t, q = middle, closure
    return Reach(t, q, _demanding(run, t, q, until))


def _demanding(run: FailedRun, t: float, q: np.ndarray, until: float) -> frozenset[str]:
    """Return the names of the constraints whose demands at the time `until`, seen from q at t, are outside the range of D."""
    rows = run.rows
    psi, length, D = rows.at(t, q)
    u, sigma, _ = np.linalg.svd(rows.dense(D))
    null = np.ones(len(u), bool)
    null[: len(sigma)] = sigma <= DEAD_POINT_TOL * sigma[0]
    N = u[:, null]
    demand = N @ (N.T @ ((rows.at(until, q)[0] - psi) / length))
    involved = np.abs(demand) > INVOLVED_SHARE * np.abs(demand).max(initial=0.0)
    return frozenset(name for (name, _), is_involved in zip(rows.names, involved, strict=True) if is_involved)


def dead_point(mechanism: Mechanism, found: Reach, drivers: list[str]) -> str:
    """Describe a dead point: links with pins in line, or the joints involved."""
    index = {name: k for k, name in enumerate(mechanism.body_names)}
    frames = found.q.reshape(-1, 3)
    driven = {GROUND, *(body for name in drivers for body in mechanism.drivers[name].bodies)}

    def position_of(name: str) -> np.ndarray:
        joint = mechanism.joints[name]
        body, point = next((b, np.asarray(p, float)) for b, p in zip(joint.bodies, joint.points, strict=True) if b in index)
        x, y, angle = frames[index[body]]
        c, s = np.cos(angle), np.sin(angle)
        return np.array([x + c * point[0] - s * point[1], y + s * point[0] + c * point[1]])

    pins = {name for name in found.owners & set(mechanism.joints) if isinstance(mechanism.joints[name], Revolute)}
    links = {body: [p for p in mechanism.joints if p in pins and body in mechanism.joints[p].bodies] for body in index}
    links = {body: ends for body, ends in links.items() if len(ends) == 2 and body not in driven}
    lines: list[list[str]] = []
    for link, (a, b) in links.items():
        for other, ends in links.items():
            shared = {a, b} & set(ends)
            if link >= other or len(shared) != 1:
                continue
            (middle,) = shared
            chain = [*({a, b} - shared), middle, *(set(ends) - shared)]
            u, w = position_of(chain[1]) - position_of(chain[0]), position_of(chain[2]) - position_of(chain[1])
            if abs(u[0] * w[1] - u[1] * w[0]) <= IN_LINE_TOL * np.linalg.norm(u) * np.linalg.norm(w):
                lines.append(chain if index[link] < index[other] else chain[::-1])
    if lines:
        return "dead point: " + " and ".join(f"pins {', '.join(line)} in line" for line in lines)
    joints = [name for name in mechanism.joints if name in found.owners]
    return f"a dead point of {', '.join(joints)}" if joints else "a dead point"


def _value(mechanism: Mechanism, name: str, t: float) -> str:
    """Return the value of a driver at a time (s) as text: as its drawing counts it if there is one, else in rad or m."""
    driver = mechanism.drivers[name]
    value = float(driver.motion(t))
    if mechanism.drawing is not None:
        from udkjax.positions.answers.counting import Count  # imports drawings, which a run without one need not

        return Count.of(mechanism, name).text(value)
    return f"{value:.6g} {'rad' if driver.coordinate == 'angle' else 'm'}"
