"""Mechanisms with friction that depends on the loads of joints, and their equations in minimal coordinates for SciPy."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import udkjax as udk

G = 9.81


def mu(s: float, coefficient: float, static: float, speed: float, viscous: float = 0.0) -> float:
    """Return the coefficient of friction of Brown and McPhee (2016)."""
    x = s / speed
    return coefficient * np.tanh(4 * x) + (static - coefficient) * x / (x * x / 4 + 0.75) ** 2 + viscous * s


def _root(function: Callable[[float], float]) -> float:
    return float(np.asarray(brentq(function, -1e4, 1e4, xtol=1e-13)))


def pendulum(**friction: Any) -> udk.Mechanism:
    """Return a pendulum of 2 kg, 0.03 kg m^2 and 0.5 m on a thick pin, from rest at the height of the pin."""
    return udk.Mechanism(
        {"bob": udk.Body(2.0, 0.03, [0.5, 0.0])},
        {"A": udk.Revolute(["ground", "bob"], [[0.0, 0.0], [-0.5, 0.0]])},
        forces={"rub": udk.Friction("A", **friction)},
    )


def pendulum_by_scipy(ts: np.ndarray, law: Callable[[float], float], radius: float) -> np.ndarray:
    """Return the angles (T,) of `pendulum`; its force on the pin contains the acceleration, which is found as a root."""
    m, length, inertia = 2.0, 0.5, 0.03 + 2.0 * 0.5**2

    def acceleration(angle: float, omega: float) -> float:
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])

        def remainder(alpha: float) -> float:
            force = m * (length * alpha * across - length * omega**2 * along + np.array([0.0, G]))
            return inertia * alpha + m * G * length * np.cos(angle) + law(radius * omega) * radius * np.hypot(*force)

        return _root(remainder)

    found = solve_ivp(lambda _, y: [y[1], acceleration(*y)], (ts[0], ts[-1]), [0.0, 0.0], "DOP853", ts, rtol=1e-10, atol=1e-11)
    return found.y[0]


def cart(coefficient: float = 0.2, length: float | None = None, **more: Any) -> udk.Mechanism:
    """Return a cart of 1.5 kg on a rail, and a pendulum of 0.8 kg and 0.4 m hanging from its centre at 60 degrees."""
    x, y = 0.4 * np.sin(np.pi / 3), -0.4 * np.cos(np.pi / 3)
    return udk.Mechanism(
        {"cart": udk.Body(1.5, 0.1, [0.0, 0.0], velocity=[0.5, 0.0]), "bob": udk.Body(0.8, 0.01, [x, y], velocity=[0.5, 0.0])},
        {
            "S": udk.Prismatic(["ground", "cart"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
            "A": udk.Revolute(["cart", "bob"], [[0.0, 0.0], [-x, -y]]),
        },
        forces={"rub": udk.Friction("S", coefficient=coefficient, length=length, **more)},
    )


def cart_by_scipy(ts: np.ndarray, law: Callable[[float], float]) -> np.ndarray:
    """Return the positions of the cart and the angles of the pendulum from the vertical (2, T) of `cart`."""
    M, m, r, inertia = 1.5, 0.8, 0.4, 0.01

    def accelerations(angle: float, speed: float, omega: float) -> np.ndarray:
        c, s = np.cos(angle), np.sin(angle)

        def given(normal: float) -> np.ndarray:
            drag = -law(speed) * abs(normal)
            A = np.array([[M + m, m * r * c], [m * r * c, inertia + m * r**2]])
            return np.linalg.solve(A, [drag + m * r * s * omega**2, -m * G * r * s])

        def remainder(normal: float) -> float:
            alpha = given(normal)[1]
            return normal - (M + m) * G - m * r * (s * alpha + c * omega**2)

        return given(_root(remainder))

    rate = lambda _, y: [y[2], y[3], *accelerations(y[1], y[2], y[3])]  # noqa: E731
    found = solve_ivp(rate, (ts[0], ts[-1]), [0.0, np.pi / 3, 0.5, 0.0], "DOP853", ts, rtol=1e-10, atol=1e-11)
    return found.y[:2]


def block(angle: float, coefficient: float, speed: float = 1e-3, uphill: float = 0.0) -> udk.Mechanism:
    """Return a block of 1 kg on an incline, with a velocity up the slope."""
    along = np.array([np.cos(angle), np.sin(angle)])
    return udk.Mechanism(
        {"block": udk.Body(1.0, 0.01, [0.0, 0.0], angle, velocity=uphill * along)},
        {"S": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], angle)},
        forces={"rub": udk.Friction("S", coefficient=coefficient, speed=speed)},
    )


def drawer(coefficient: float, reach: float = 0.2, length: float = 0.1) -> udk.Mechanism:
    """Return a drawer of 2 kg that is pulled by a driver at a distance `reach` from its guide of a `length`."""
    return udk.Mechanism(
        {"drawer": udk.Body(2.0, 0.05, [0.0, 0.0])},
        {"S": udk.Prismatic(["ground", "drawer"], [[0.0, 0.0], [0.0, 0.0]], 0.0)},
        {"pull": udk.Driver(["ground", "drawer"], "x", udk.Polynomial([0.0, 0.05, 0.3]), [[0.0, 0.0], [0.0, reach]])},
        {"rub": udk.Friction("S", coefficient=coefficient, length=length)},
        gravity=[0.0, 0.0],
    )


def rubbing(mechanism: udk.Mechanism, coefficient: float = 0.2, radius: float = 0.03, **more: Any) -> udk.Mechanism:
    """Return a mechanism without drivers, with friction in all of its revolutes, slides and slots."""
    base, forces = mechanism.without_origin, dict(mechanism.forces)
    for name, joint in base.joints.items():
        if isinstance(joint, udk.Revolute):
            forces[f"rub {name}"] = udk.Friction(name, coefficient=coefficient, radius=radius, **more)
        elif isinstance(joint, udk.Prismatic | udk.Slot):
            forces[f"rub {name}"] = udk.Friction(name, coefficient=coefficient, **more)
    return udk.Mechanism(base.bodies, base.joints, {}, forces, mechanism.gravity, mechanism.name)
