"""Accuracy of a run: constraint violation, energy change and, for a parallelogram, the error against the exact solution."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.quantities import energy, violation
from udkjax.integrate import Solution
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism

N_SAMPLES = 5  # times at which drivers and potentials are checked for change


class Accuracy(NamedTuple):
    """Errors of a run: maxima over the output times that it reached."""

    violation: float  # largest violation of a constraint (m or rad)
    energy_change: float  # largest change of the total energy since the start (J); NaN if a link has no mass
    kinetic_energy: float  # J; NaN if a link has no mass
    error: float | None  # largest difference of a coordinate from the exact solution (m or rad); None if that is unknown
    work: float | None  # work of drivers, dampers, loads and impacts up to the end (J); None if energy is conserved
    length: float  # characteristic length, m


def accuracy(mechanism: Mechanism, solution: Solution) -> Accuracy:
    """Return the accuracy of a run, or of the part that a failed run completed.

    Args:
        mechanism: mechanism that was simulated.
        solution: a single run, not a batch.

    Returns:
        An `Accuracy`: the largest violation, energies and error.
    """
    exact = exact_coordinates(mechanism, solution.ts, solution.q[0], solution.v[0])
    error = None if exact is None else float(np.nanmax(np.abs(np.asarray(solution.q) - exact)))
    change, kinetic, work = (np.nan, np.nan, None) if mechanism.massless else _energies(mechanism, solution)
    return Accuracy(
        violation=float(np.nanmax(largest_violation(violation(mechanism, solution)))),
        energy_change=change,
        kinetic_energy=kinetic,
        error=error,
        work=work,
        length=float(analyse(mechanism).length),
    )


def _energies(mechanism: Mechanism, solution: Solution) -> tuple[float, float, float | None]:
    """Return the largest change of the total energy, the largest kinetic energy, and the work done up to the end (J).

    The work is that of drivers, dampers, loads and impacts; None if energy is conserved.
    """
    parts = energy(mechanism, solution)
    total = np.asarray(parts.total)
    good = total[np.isfinite(total)]
    works = solution.events is not None or not conserves_energy(mechanism, np.asarray(solution.ts))
    work = float(good[-1] - good[0]) if works else None
    return float(np.nanmax(np.abs(total - total[0]))), float(np.nanmax(np.asarray(parts.kinetic))), work


def conserves_energy(mechanism: Mechanism, ts: Float[ArrayLike, "T"]) -> bool:
    """Return True if only numerical errors can change the total energy of a mechanism during `ts` (s).

    This requires drivers at rest, and forces whose potentials do not depend on time; both are checked at a few times between the
    first and the last of `ts`. A potential with sampled numbers (`Held`) is constant if all its samples are equal.
    """
    from udkjax.integrate.events.law.conditions import frames_of  # imports the code of events, which other studies do not need

    frames = frames_of(mechanism.body_names, mechanism.q0.ravel(), mechanism.v0.ravel())
    ts = np.asarray(ts)  # in NumPy, since the minimum of a JAX array would compile a program
    times = np.linspace(np.min(ts), np.max(ts), N_SAMPLES)
    for element in mechanism.forces.values():
        attached = [frames[name] for name in mechanism.frames_of(element)]
        if isinstance(element, Friction) or element.loads(times[0], *attached) is not None:
            return False
        if element.potential(times[0], *attached) is None:
            continue
        held = [x.values for x in vars(element).values() if isinstance(x, Held)]
        if any(np.ptp(np.asarray(values), axis=0).any() for values in held):
            return False
        if any(jax.grad(lambda t, e=element, s=attached: 1.0 * e.potential(t, *s))(t) for t in times):
            return False
    return not any(jax.grad(lambda t, d=driver: 1.0 * d.motion(t))(t) for driver in mechanism.drivers.values() for t in times)


def largest_violation(violated: Float[ArrayLike, "T m"]) -> Float[np.ndarray, " T"]:
    """Return the largest violation of any constraint at each time (m or rad), from the result of `udkjax.violation`."""
    return np.abs(np.asarray(violated)).max(axis=1, initial=0.0)


class Parallelogram(NamedTuple):
    """A parallelogram linkage in its initial configuration, in ground axes.

    Equal and parallel links, pinned to the ground and to a coupler at the same spacing, rotate together, and the coupler only
    translates. With c_i the centre of mass of link i relative to its ground pivot, p the arm from the pivot to the coupler's pin,
    and R(theta) the rotation since the start, the energies are

        T = J theta'^2 / 2,     J = sum(I_i + m_i |c_i|^2) + m_c |p|^2
        V = -g . R(theta) w,    w = sum(m_i c_i) + m_c p

    so J phi'' = -|g| |w| sin(phi), where phi is the angle from g to R w. This is a pendulum, solved by Jacobi's elliptic
    functions. The linkage of de Falco, Pennestri and Vita (2005), section 6, is a parallelogram: with theta the angle of its
    links, 3.05 theta'' = -3.5 g cos(theta).
    """

    links: list[int]  # body indices
    coupler: int
    pivots: Float[np.ndarray, "links 2"]  # m
    centres: Float[np.ndarray, "links 2"]  # c_i, m
    arm: Float[np.ndarray, "2"]  # p, m


def exact_coordinates(mech: Mechanism, ts, q0, v0, tol: float = 1e-8) -> Float[np.ndarray, "T bodies 3"] | None:
    """Return the exact x, y (m) and angle (rad) of all bodies at the times `ts` (s); None if this is not a parallelogram.

    The motion starts at `ts[0]` from `q0`, `v0`, both (bodies, 3). Links count as equal and parallel if they differ by at most
    `tol` times their length, since assembly closes the loops only up to rounding errors.
    """
    ts, q0, v0 = (np.asarray(array, float) for array in (ts, q0, v0))
    linkage = parallelogram(mech, q0, tol)
    if linkage is None:
        return None
    links, coupler, pivots, centres, arm = linkage
    angle, omega = as_pendulum(mech, linkage)
    turn = pendulum(ts - ts[0], angle, v0[links[0], 2], omega)

    q = np.repeat(q0[None], len(ts), axis=0)
    for link, pivot, centre in zip(links, pivots, centres, strict=True):
        q[:, link, :2] = pivot + _rotate(centre, turn)
        q[:, link, 2] += turn
    q[:, coupler, :2] += _rotate(arm, turn) - arm
    return q


def as_pendulum(mech: Mechanism, linkage: Parallelogram) -> tuple[float, float]:
    """Return phi (rad), the angle from the hanging position, and omega (rad/s), the angular frequency of small oscillations."""
    bodies, gravity = list(mech.bodies.values()), np.asarray(mech.gravity, float)
    masses = np.array([float(bodies[link].mass) for link in linkage.links])
    load, arm = float(bodies[linkage.coupler].mass), linkage.arm
    inertia = sum(float(bodies[link].inertia) for link in linkage.links)
    inertia += masses @ (linkage.centres**2).sum(1) + load * arm @ arm
    moment = masses @ linkage.centres + load * arm
    angle = np.arctan2(moment[1], moment[0]) - np.arctan2(gravity[1], gravity[0])
    return float(np.remainder(angle + np.pi, 2 * np.pi) - np.pi), float(np.sqrt(np.hypot(*gravity) * np.hypot(*moment) / inertia))


def pendulum(ts, angle: float, rate: float, omega: float) -> Float[np.ndarray, " T"]:
    """Return the change of phi (rad) after `ts` (s): the solution of phi'' = -omega^2 sin(phi) from `angle` and `rate` (rad/s).

    Oscillation (k <= 1): sin(phi / 2) = k sn(omega t + u, k). Rotation (k > 1): phi / 2 = am(k omega t + u, 1 / k). The first
    amplitude is computed by atan2, since asin would lose half of the digits at a release from rest.
    """
    from scipy.special import ellipj, ellipkinc  # importing SciPy takes longer than a run

    if omega == 0:
        return rate * ts
    angle = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    half, speed = np.sin(angle / 2), rate / (2 * omega)
    k = np.hypot(half, speed)
    if k <= 1:
        start = ellipkinc(np.arctan2(half, speed), k**2)
        if np.isinf(start):  # upside down, at rest
            return np.zeros_like(ts)
        sn, _, dn, _ = ellipj(omega * ts + start, k**2)
        return 2 * np.arctan2(k * sn, dn) - angle
    u = np.copysign(k, rate) * omega * ts + ellipkinc(angle / 2, 1 / k**2)
    return 2 * ellipj(u, 1 / k**2)[3] - angle


def parallelogram(mech: Mechanism, q0, tol: float) -> Parallelogram | None:
    """Return the `Parallelogram` in the configuration `q0`, (bodies, 3), if the mechanism is one that moves under gravity alone.

    Otherwise, return None. Links count as equal and parallel if they differ by at most `tol` times their length.
    """
    if mech.drivers or mech.forces or not all(type(joint) is Revolute for joint in mech.joints.values()):
        return None
    pins = [dict(zip(joint.bodies, np.asarray(joint.points), strict=True)) for joint in mech.joints.values()]
    below = {body: pin for pin in pins if GROUND in pin for body in pin if body != GROUND}
    above = [pin for pin in pins if GROUND not in pin]
    shared = set(mech.bodies).intersection(*above)
    if len(shared) != 1 or len(pins) != 2 * len(below) or len(below) + 1 != len(mech.bodies):
        return None
    (coupler,) = shared
    above = {body: pin for pin in above for body in pin if body != coupler}
    if set(above) != set(below):
        return None

    index = {name: number for number, name in enumerate(mech.bodies)}
    angle = {name: q0[number, 2] for name, number in index.items()}
    pivots = np.array([pin[GROUND] for pin in below.values()])
    arms = np.array([_rotate(above[link][link] - below[link][link], angle[link]) for link in below])
    spacing = np.array([_rotate(above[link][coupler], angle[coupler]) for link in below]) - pivots
    if np.abs(arms - arms[0]).max() + np.abs(spacing - spacing[0]).max() > tol * np.hypot(*arms[0]):
        return None
    centres = np.array([_rotate(-below[link][link], angle[link]) for link in below])
    return Parallelogram([index[link] for link in below], index[coupler], pivots, centres, arms[0])


def _rotate(vector, angle):
    x, y = vector
    return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=-1)
