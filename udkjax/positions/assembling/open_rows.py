"""Open constraints of a state, and the reason why a mechanism cannot be closed."""

from collections.abc import Sequence

import numpy as np

from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.rows.redundancy import holders_of_driver, kinematic_rows
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import MOST_LISTED


def name_open_rows(names: Sequence[str], residual: np.ndarray, scales: np.ndarray, tol: float) -> str:
    """Return a list, as text, of the constraints whose residuals exceed `tol` times their scales, with these, the largest first.

    `names` has the constraint of each row.
    """
    worst: dict[str, tuple[float, float]] = {}  # residual over the row's scale, and residual
    for name, size, unit in zip(names, np.abs(residual), scales, strict=True):
        if not size / unit <= tol:  # also NaN
            worst[name] = max(worst.get(name, (0.0, 0.0)), (float(np.nan_to_num(size / unit, nan=np.inf)), float(size)))
    listed = sorted(worst, key=lambda name: -worst[name][0])
    text = ", ".join(f'"{name}" ({worst[name][1]:.2g})' for name in listed[:MOST_LISTED])
    return text + (", ..." if len(listed) > MOST_LISTED else "")


def name_not_finite(mechanism: Mechanism, x: np.ndarray, labels: Sequence[str] = COORDINATES) -> str:
    """Return the names of the non-finite entries of q or v (n,), as one string."""
    bad = [(body, label) for body in mechanism.body_names for label in labels]
    named = [f'{label} of "{body}"' for (body, label), value in zip(bad, x, strict=True) if not np.isfinite(value)]
    return ", ".join(named[:MOST_LISTED]) + (", ..." if len(named) > MOST_LISTED else "")


def explain_open(
    mechanism: Mechanism,
    t: float,
    guess: np.ndarray,
    names: Sequence[str],
    psi: np.ndarray,
    psi_dot: np.ndarray,
    scales: np.ndarray,
) -> str:
    """Return a message with the joints that an assembly at time t (s) has left open, and the cause: drivers, joints or the guess.

    Args:
        mechanism: the mechanism.
        t: time (s).
        guess: the initial positions (n,).
        names: the constraint of each row.
        psi: residual Psi (m,), in m or rad.
        psi_dot: residual Psi_dot (m,), in m/s or rad/s.
        scales: scales of the rows.
    """
    is_open = bool(np.max(np.abs(psi) / scales) > CLOSURE.tol) or not np.all(np.isfinite(psi))
    residual = psi if is_open else psi_dot
    sizes = np.nan_to_num(np.abs(residual) / scales, nan=np.inf)
    text = name_open_rows(names, residual, scales, CLOSURE.tol * float(min(sizes.max(), 1e300)))
    if not is_open:
        drivers = [name for name in dict.fromkeys(names) if name in mechanism.drivers and f'"{name}"' in text]
        if len(drivers) > 1 and set(drivers) & (holders_of_driver(mechanism, drivers[0]) or set()) - {drivers[0]}:
            return f"drivers {' and '.join(map(_quote, drivers))} contradict each other: remove one, or change its motion."
        who = f"driver{'s' * (len(drivers) > 1)} {' and '.join(map(_quote, drivers))} ask{'s' * (len(drivers) < 2)} for"
        return (
            f"no velocities satisfy all constraints in this position; open (m/s, rad/s): {text}. "
            f"{who if drivers else 'They ask for'} a motion that the others forbid here: change it, or start in another position."
        )
    wrong = name_not_finite(mechanism, guess)
    if wrong:
        return f"the initial guess is not finite: {wrong}."
    cause = f"the mechanism cannot be closed near its initial guess; open (m, rad): {text}. "
    closed = _close_without_drivers(mechanism, guess) if mechanism.drivers else None
    if closed is None:
        return cause + (
            "Check the points and lengths of these joints, or bring the initial positions and angles closer to a closed state."
        )
    left = np.asarray(kinematic_rows(mechanism).at(t, closed)[0])  # with the joints closed, only drivers are open
    demands = []
    for name, driver in mechanism.drivers.items():
        off = float(left[list(names).index(name)])
        if abs(off) > CLOSURE.tol * float(scales[list(names).index(name)]):
            value, unit = float(driver.motion(t)), "rad" if driver.coordinate == "angle" else "m"
            demands.append(f'driver "{name}" asks for {value:.6g} {unit} at {t:.6g} s, and is at {value + off:.6g} {unit}')
    return f"{cause}Without drivers it closes: {'; '.join(demands)}. Change the drivers' motion, or bring the guess closer to it."


def _close_without_drivers(mechanism: Mechanism, guess: np.ndarray) -> np.ndarray | None:
    """Return a position that closes the joints without the drivers; None if none is found."""
    rows = kinematic_rows(Mechanism(dict(mechanism.bodies), dict(mechanism.joints), gravity=mechanism.gravity))
    if not rows.count:
        return guess
    found = rows.close(0.0, guess)
    return None if found is None else found.q


def _quote(name: str) -> str:
    return f'"{name}"'
