"""The law that the drift of redundant constraints obeys, along motions that are known exactly: see wire_law.py."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk

import udkjax as udk
from udkjax.equations import prepare

LIFT = {"offset": 0.7, "amplitude": 0.35, "frequency": 6.0}  # rad, rad/s: the angle that the lift's driver prescribes
CLOSED = 1e-6  # relative: singular values of a closed mechanism below it are zero but for rounding


class Motion(NamedTuple):
    """A periodic motion of a mechanism with one coordinate s: s(t) and s'(t), of period T."""

    mechanism: udk.Mechanism
    pose: Callable  # s -> q, flat
    coordinate: Callable  # t -> (s, s')
    period: float


def linkage(degrees: float) -> Motion:
    """The paper's linkage released at rest: phi = theta + pi/2 swings, sin(phi/2) = k sn(omega t + K, k)."""
    phi, omega = np.deg2rad(degrees) + np.pi / 2, np.sqrt(3.5 * 9.81 / 3.05)
    k = np.sin(phi / 2)
    quarter = ellipk(k**2)

    def coordinate(t):
        sn, cn, dn, _ = ellipj(omega * t + quarter, k**2)
        return 2 * np.arctan2(k * sn, dn) - np.pi / 2, 2 * k * omega * cn

    make = udk.library.parallelogram
    return Motion(make(np.deg2rad(degrees)), lambda s: make(s).q0.ravel(), coordinate, 4 * quarter / omega)


def lift() -> Motion:
    """A scissor lift of two stages whose first bar is driven to and fro."""
    offset, amplitude, frequency = LIFT.values()
    make = udk.library.scissor_lift
    lift = make(angle=offset, angular_velocity=amplitude * frequency)
    driver = udk.Driver((udk.GROUND, "rising0"), "angle", udk.Sine(amplitude, frequency, offset=offset))
    mechanism = udk.Mechanism(lift.bodies, lift.joints, {"lever": driver}, gravity=lift.gravity, name="driven scissor lift")

    def coordinate(t):
        return offset + amplitude * np.sin(frequency * t), amplitude * frequency * np.cos(frequency * t)

    return Motion(mechanism, lambda s: make(angle=s).q0.ravel(), coordinate, 2 * np.pi / frequency)


class Range(NamedTuple):
    """The range of A = Psi_q at s = 0: its projector P, A^+, and dQ/ds, Q = I - P that onto the left null space."""

    P: Any
    plus: Any
    dQ: Any


def turning(motion: Motion) -> Callable[[float], Range]:
    """Return s -> the range: dQ = -(Q dA A^+) - (Q dA A^+)^T."""
    equations = prepare(motion.mechanism, udk.SVD())

    @jax.jit
    def at(s):
        q, along = jax.jvp(motion.pose, (s,), (jnp.ones_like(s),))
        A, dA = jax.jvp(lambda q: equations.jacobian(0.0, q), (q,), (along,))
        plus = jnp.linalg.pinv(A, rtol=CLOSED)
        P = A @ plus
        turned = (jnp.eye(len(A)) - P) @ dA @ plus
        return Range(P, plus, -turned - turned.T)

    return lambda s: Range(*map(np.asarray, at(jnp.asarray(s, float))))


def law(motion: Motion, turn: Callable[[float], Range], alpha: float, beta: float) -> tuple[complex, np.ndarray]:
    """Return the general law's largest Floquet multiplier of one period, and its eigenvector (Psi, p) at t = 0."""
    P = turn(motion.coordinate(0.0)[0]).P
    m = len(P)

    def rate(t, y):
        s, ds = motion.coordinate(t)
        dQ = turn(s).dQ * ds
        psi, p = y.reshape(2, m, -1)
        return np.concatenate([p - dQ @ psi, dQ @ (dQ @ psi - p) - 2 * alpha * p - beta**2 * psi]).ravel()

    values, vectors = np.linalg.eigh(P)
    both = np.kron(np.eye(2), vectors[:, values > 0.5])  # Psi and p in the range
    end = solve_ivp(rate, (0, motion.period), both.ravel(), "DOP853", rtol=1e-11, atol=1e-13).y[:, -1].reshape(2 * m, -1)
    multipliers, vectors = np.linalg.eig(both.T @ end)
    top = np.argmax(np.abs(multipliers))
    return complex(multipliers[top]), np.asarray(both @ vectors[:, top])


def scalar_law(motion: Motion, alpha: float, beta: float) -> tuple[complex, np.ndarray]:
    """Return the largest Floquet multiplier of rho'' + 2 alpha rho' + (beta^2 - s'^2) rho = 0, and its eigenvector
    (rho, rho')."""

    def rate(t, y):
        rho, speed = y.reshape(2, 2)
        return np.concatenate([speed, -2 * alpha * speed - (beta**2 - motion.coordinate(t)[1] ** 2) * rho])

    end = solve_ivp(rate, (0, motion.period), np.eye(2).ravel(), "DOP853", rtol=1e-13, atol=1e-15).y[:, -1].reshape(2, 2)
    multipliers, vectors = np.linalg.eig(end)
    top = np.argmax(np.abs(multipliers))
    return complex(multipliers[top]), np.asarray(vectors[:, top])


def opened(motion: Motion, plus: np.ndarray, psi: Any, p: Any) -> udk.State:
    """Return the state at t = 0 with the drift Psi and P Psi' = p, both in the range of Psi_q."""
    s, ds = motion.coordinate(0.0)
    q, along = jax.jvp(motion.pose, (jnp.asarray(s),), (jnp.ones(()),))
    q, v = q + jnp.asarray(plus @ psi), along * ds
    rate = prepare(motion.mechanism, udk.SVD()).violation(0.0, q, v)[1]
    return udk.State(q.reshape(-1, 3), (v + plus @ (p - rate)).reshape(-1, 3))
