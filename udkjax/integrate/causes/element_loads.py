"""Loads of single force elements at states, to find one that is NaN, grows without bound, jumps, or is stiff."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations import loads
from udkjax.programs.deferred import deferred
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.mechanism import Mechanism

TimedState = tuple[float, np.ndarray, np.ndarray]  # t (s), q and v (n,)


class ElementLoads(NamedTuple):
    """Sizes and jumps of the loads of force elements at states, and the fastest rates (1/s) of their damping and stiffness."""

    names: tuple[str, ...]
    size: np.ndarray  # (states, elements): largest acceleration of the element's bodies, in L / s^2 and rad / s^2
    jump: np.ndarray  # (states, elements): largest change of these accelerations from the first state, in the same units
    damping: np.ndarray  # (states, elements), 1/s
    stiffness: np.ndarray  # (states, elements), 1/s


def element_loads(
    mechanism: Mechanism, length: float, states: Sequence[TimedState], mobility: np.ndarray | None = None
) -> ElementLoads:
    """Return measures of the loads of each force element at several states.

    Args:
        mechanism: the mechanism.
        length: the characteristic length (m).
        states: the states.
        mobility: the projection (n, n) onto the motions that the constraints allow, in the mass metric: the rates of damping and
            stiffness are those of these motions. None: the bodies of each element move freely.
    """
    names, count = mechanism.force_names, len(mechanism.forces)
    ts, qs, vs = (np.stack([np.asarray(s[k], float) for s in states]) for k in range(3))
    shape = len(states), count
    size, jump, damping, stiffness = (np.zeros(shape) for _ in range(4))
    for kind, (load, by_q, by_v) in _evaluate(mechanism.without_origin, ts, qs, vs) if count else ():
        load, by_q, by_v = (np.asarray(x) for x in (load, by_q, by_v))  # (states, elements, 3k), (.., 3k, 3k)
        body = np.array([[b.mass, b.mass, b.inertia] for b in mechanism.bodies.values()], float)
        moving = body[kind.bodies.T].reshape(len(kind.members), -1)  # (elements, 3k)
        unit = np.tile([length, length, 1.0], moving.shape[1] // 3)
        a = load / moving / unit
        size[:, kind.members] = np.abs(a).max(-1, initial=0.0)
        jump[:, kind.members] = np.abs(a - a[:1]).max(-1, initial=0.0)
        sqrt_mass = np.sqrt(moving)
        for rates, matrix, power in ((stiffness, by_q, 0.5), (damping, by_v, 1.0)):
            scaled = np.nan_to_num(matrix / sqrt_mass[:, :, None] / sqrt_mass[:, None, :], posinf=0.0, neginf=0.0)
            if not moving.shape[1]:
                continue
            if mobility is not None:
                places = (3 * kind.bodies.T[:, :, None] + np.arange(3)).reshape(len(kind.members), -1)
                scaled = scaled @ mobility[places[:, :, None], places[:, None, :]]
                rates[:, kind.members] = np.abs(np.linalg.eigvals(scaled)).max(-1) ** power
                continue
            rates[:, kind.members] = np.linalg.norm(scaled, 2, axis=(-2, -1)) ** power
    return ElementLoads(tuple(names), size, jump, damping, stiffness)


def _evaluate(mechanism: Mechanism, ts: np.ndarray, qs: np.ndarray, vs: np.ndarray) -> list:
    """Return pairs of a kind of elements, of the same structure and with k moving bodies each, and values at all states.

    The values are the loads (states, elements, 3k), and their derivatives with respect to q and to v of these bodies, each
    (states, elements, 3k, 3k).
    """
    kinds: list = []

    def at(t: Array, q: Array, v: Array) -> list:
        found = loads.evaluate_forces(lambda e, *frames: _load(e, t, frames), mechanism, q, v)
        kinds[:] = [kind for kind, _ in found]
        return [x for _, x in found]

    states: Any = ts, qs.reshape(len(ts), -1, 3), vs.reshape(len(ts), -1, 3)
    results = deferred(jax.vmap(at))(*states)
    return list(zip(kinds, results, strict=True))


def _load(element: ForceElement, t: Array, frames: Sequence[Frame]) -> tuple[Array, Array, Array]:
    moving = [k for k, frame in enumerate(frames) if isinstance(frame.x, Array)]

    def placed(q: Array, v: Array) -> list[Frame]:
        moved_frames = list(frames)
        for k, (x, y, angle), (vx, vy, omega) in zip(moving, q.reshape(-1, 3), v.reshape(-1, 3), strict=True):
            moved_frames[k] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)
        return moved_frames

    def load(q: Array, v: Array) -> Array:
        return loads.loads_on_frames(element, t, *placed(q, v))[np.array(moving, int)].ravel()

    q = jnp.concatenate([jnp.zeros(0), *(jnp.stack(frames[k][:3]) for k in moving)])
    v = jnp.concatenate([jnp.zeros(0), *(jnp.stack(frames[k][5:]) for k in moving)])
    return load(q, v), jax.jacfwd(load, 0)(q, v), jax.jacfwd(load, 1)(q, v)
