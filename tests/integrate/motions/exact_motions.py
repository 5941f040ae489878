"""Scenes with a known motion, for every engine: free flight, a spring, a motor, and impacts."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk

G = 9.81


class ExactMotion(NamedTuple):
    """A scene, output times, and the positions (T, 3) of its only body at these times."""

    mechanism: udk.Mechanism
    ts: np.ndarray  # s
    exact: Callable[[np.ndarray], np.ndarray]
    events: Sequence[udk.Event | udk.Contact] = ()
    event_times: Sequence[float] = ()  # s
    atol: float = 1e-8  # m, rad: of a run whose tolerances are 1e-10


class Table(eqx.Module):
    """The height of the ball above a shaking table."""

    amplitude: jax.Array

    def __call__(self, t, at):
        return at["ball"].y - self.amplitude * jnp.sin(15.0 * t)


def _poses(x, y, angle):
    return np.stack(np.broadcast_arrays(x, y, angle), -1)


def _thrown() -> ExactMotion:
    body = udk.Body(0.7, 0.02, (0.1, 0.2), 0.3, (1.5, 4.0), -2.0)
    exact = lambda t: _poses(0.1 + 1.5 * t, 0.2 + 4.0 * t - G / 2 * t**2, 0.3 - 2.0 * t)  # noqa: E731
    return ExactMotion(udk.Mechanism({"ball": body}), np.linspace(0.0, 1.0, 11), exact)


def _at_a_spring() -> ExactMotion:
    """A rod on a torsion spring and its damper, without gravity: I angle'' + c angle' + k angle = 0."""
    inertia, k, c, length = 0.02 + 0.7 * 0.4**2, 3.0, 0.05, 0.4
    rod = udk.Body(0.7, 0.02, (length, 0.0), 0.0, (0.0, length * 2.0), 2.0)
    pin = udk.Revolute(("ground", "rod"), [(0.0, 0.0), (-length, 0.0)])
    spring = udk.TorsionSpring(("ground", "rod"), k, c)
    decay = c / (2 * inertia)
    rate = np.sqrt(k / inertia - decay**2)

    def exact(t):
        angle = 2.0 / rate * np.exp(-decay * t) * np.sin(rate * t)
        return _poses(length * np.cos(angle), length * np.sin(angle), angle)

    return ExactMotion(udk.Mechanism({"rod": rod}, {"pin": pin}, {}, [spring], (0.0, 0.0)), np.linspace(0.0, 2.0, 11), exact)


def _by_a_motor() -> ExactMotion:
    """A crank that a motor accelerates: angle = 0.2 + t + t^2."""
    rod = udk.Body(0.7, 0.02, 0.4 * np.array([np.cos(0.2), np.sin(0.2)]), 0.2)
    pin = udk.Revolute(("ground", "rod"), [(0.0, 0.0), (-0.4, 0.0)])
    motor = udk.Driver(("ground", "rod"), "angle", udk.Polynomial([0.2, 1.0, 1.0]))

    def exact(t):
        angle = 0.2 + t + t**2
        return _poses(0.4 * np.cos(angle), 0.4 * np.sin(angle), angle)

    return ExactMotion(udk.Mechanism({"rod": rod}, {"pin": pin}, {"motor": motor}), np.linspace(0.0, 2.0, 11), exact)


def _on_a_skate() -> ExactMotion:
    """A skate on a slope along x, turning at omega: with a = g / (2 omega^2), it moves on a cycloid of height a."""
    omega, slope = 3.0, 2.0
    skate = udk.Body(0.7, 0.02, (0.0, 0.0), 0.0, (0.0, 0.0), omega)
    edge = udk.KnifeEdge(("ground", "skate"), (0.0, 0.0), 0.0)

    def exact(t):
        a = slope / (2 * omega**2)
        return _poses(a * np.sin(omega * t) ** 2, a * (omega * t - np.sin(2 * omega * t) / 2), omega * t)

    mechanism = udk.Mechanism({"skate": skate}, {"edge": edge}, gravity=(slope, 0.0))
    return ExactMotion(mechanism, np.linspace(0.0, 2.0, 11), exact)


def _bouncing(restitution: float) -> ExactMotion:
    """A ball that falls from 1 m above the floor: two flights after the first impact, or at rest on the floor."""
    ball = udk.Body(1.0, 0.1, (0.0, 1.0), 0.0, (0.3, 0.0))
    impacts = np.sqrt(2 / G) * np.cumsum([1.0, 2 * restitution, 2 * restitution**2][: 3 if restitution else 1])
    ends = 0.9 * impacts[-1] if restitution else 1.0

    def exact(t):
        number = np.searchsorted(impacts, t)
        after = t - np.append(0.0, impacts)[number]
        speed = np.sqrt(2 * G) * restitution**number
        y = np.where(number > 0, speed * after - G / 2 * after**2 * (restitution > 0), 1.0 - G / 2 * t**2)
        return _poses(0.3 * t, y, 0.0)

    floor = udk.Contact("ball", restitution=restitution, name="floor")
    within = impacts[impacts < ends].tolist()
    return ExactMotion(udk.Mechanism({"ball": ball}), np.linspace(0.0, ends, 8), exact, [floor], within)


def _thrown_by_a_table() -> ExactMotion:
    """A ball on a table that moves as a sin(15 t). It leaves the table when the table's acceleration is -g."""
    a, w = 0.1, 15.0
    parts = float(np.arcsin(G / (a * w**2)) / w)
    ball = udk.Body(1.0, 0.1, (0.0, 0.0), 0.0, (0.0, a * w))

    def exact(t):
        later = t - parts
        flight = a * np.sin(w * parts) + a * w * np.cos(w * parts) * later - G / 2 * later**2
        return _poses(0.0, np.where(later > 0, flight, a * np.sin(w * t)), 0.0)

    table = udk.Event(Table(jnp.asarray(a)), udk.Impact(0.0), name="table")
    return ExactMotion(udk.Mechanism({"ball": ball}), np.linspace(0.0, 0.2, 8), exact, [table], [0.0, parts], 1e-7)


EXACT = {
    "thrown": _thrown(),
    "at a spring": _at_a_spring(),
    "by a motor": _by_a_motor(),
    "on a skate": _on_a_skate(),
    "bouncing": _bouncing(0.8),
    "landing": _bouncing(0.0),
    "thrown by a table": _thrown_by_a_table(),
}
