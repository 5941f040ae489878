"""The fast form: straight-line programs for elimination, with derivatives by programs of their own (derivative.py).

A first derivative goes by the factors that the value was found with, forward or reverse; where `Auto` may branch, and for every
derivative beyond the first, it is that of the textbook.
"""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from udkjax.equations.code import scalars, stacked
from udkjax.equations.linear import Linear, applied, by_plain_form, moving_of, numbers_moving_of, those, those_numbers
from udkjax.equations.motion import FAR as NEWTON_FAR
from udkjax.equations.motion import STEPS, Closed, Tangential, Vector
from udkjax.pinv import SVD
from udkjax.straightline import along

if TYPE_CHECKING:
    from udkjax.equations.programs import Equations

# Of the characteristic length, and rad: a Newton step that moves q by less leaves rounding errors of Psi_dot.
FAR = 1e-13


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def accelerations(program: str, equations: "Equations", t: Any, q: Vector, v: Vector) -> Vector:
    """a, by the program of this name."""
    *a, safe = equations.run(program, t, q, v)
    return _checked(equations, safe, stacked(a), t, q, v)


def project(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """By Newton steps in position and velocity at once."""
    q, v, _ = closed(equations, t, q, v, STEPS)
    return q, v


def closed(equations: "Equations", t: Any, q: Vector, v: Vector, steps: int) -> Closed:
    """By at most so many steps."""
    found, (safe, moving) = _projected(steps, equations, t, q, v)
    q, v = (jnp.where(safe, x, jnp.nan) for x in found)
    return Closed(q, v, moving)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _projected(steps: int, equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Any, Any]:
    """q and v, numbers in any case; whether they can be trusted, and whether they still moved.

    A Newton step takes the given v to where Psi_dot = 0 at the q that it starts from, so the last must not move q. There are at
    most so many `steps`. Derivatives are taken where q and v are then.
    """
    program, far = equations.code.program("nearer"), FAR * equations.scales.length

    # On scalars until all is done: vectors that a loop carries have the batch first under vmap, where the programs have it last.

    def nearer(state: Any) -> Any:
        k, q, _, _, safe = state
        *found, still = equations.call(program, t, *q, *vs)
        q1, v1 = found[: len(q)], found[len(q) :]
        return k + 1, q1, v1, _largest_change(equations, q1, q), safe & still

    def more(state: Any) -> Any:
        return (state[0] < steps) & ~(state[3] <= far)

    vs = scalars([v])
    start = 0, scalars([q]), vs, jnp.inf, jnp.array(True)
    _, *found, change, safe = jax.lax.while_loop(more, nearer, start)
    found, moving = [stacked(x) for x in found], ~(change <= far)
    if equations.branches:
        found = jax.lax.cond(safe, lambda: tuple(found), lambda: equations.by(SVD).project(t, q, v))
        return found, (jnp.array(True), moving & safe)
    return tuple(found), (safe if equations.refuses else jnp.array(True), moving)


def arrived(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector, Vector]:
    """q and v on the manifold, and the accelerations there: by Newton steps in position, and one program of all the rest."""
    found, _, (_, safe) = _arrived(equations, t, q, v, ())
    q, v, a = (jnp.where(safe, x, jnp.nan) for x in found) if equations.refuses else found
    return q, v, a


def finished(
    equations: "Equations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector
) -> tuple[Vector, Vector, Vector, Tangential]:
    """`arrived`, and what projection leaves of small changes there, by the same program."""
    found, (dq, dv), (distance, safe) = _arrived(equations, t, q, v, (dq, dv))
    q, v, a = (jnp.where(safe, x, jnp.nan) for x in found) if equations.refuses else found
    return q, v, a, Tangential(dq, dv, distance)


@jax.custom_jvp
def _arrived(equations: "Equations", t: Any, q: Vector, v: Vector, changes: tuple[Vector, ...]) -> tuple[Any, Any, Any]:
    """q, v and a, numbers in any case; what is left of changes; how far the end is from singular, whether to be trusted."""
    program, far = equations.code.program("closer"), NEWTON_FAR * equations.scales.length

    def closer(state: Any) -> Any:
        k, q, _, safe = state
        *found, still = equations.call(program, t, *q, *vs)
        return k + 1, found, _largest_change(equations, found, q), safe & still

    vs = scalars([v])
    start = 0, scalars([q]), jnp.inf, jnp.array(True)
    _, found, _, safe = jax.lax.while_loop(lambda s: (s[0] < STEPS) & ~(s[2] <= far), closer, start)
    q = stacked(found)
    *found, still = equations.call(equations.code.program("finish" if changes else "arrival"), t, q, v, *changes)
    distance = found.pop() if changes else jnp.inf  # who asks for no changes does not ask how far, either
    v, a, *left = (stacked(found[k : k + len(q)]) for k in range(0, len(found), len(q)))
    return (q, v, a), tuple(left), (distance, safe & still)


def _largest_change(equations: "Equations", new: Sequence[Array], old: Sequence[Array]) -> Array:
    """Of any coordinate (m), angles times the characteristic length."""
    changes = [jnp.abs(x - y) for x, y in zip(new, old, strict=True)]
    lengths = _largest([x for k, x in enumerate(changes) if k % 3 < 2])
    return jnp.maximum(lengths, equations.scales.length * _largest(changes[2::3]))


def _largest(numbers: list[Array]) -> Array:
    """By halves, so that few wait for others."""
    while len(numbers) > 1:
        pairs = zip(numbers[::2], numbers[1::2], strict=False)
        numbers = [*(jnp.maximum(a, b) for a, b in pairs), *numbers[len(numbers) // 2 * 2 :]]
    return numbers[0]


def tangential(equations: "Equations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
    """What projection at q leaves of small changes: for estimates of errors, which nobody differentiates, nor do they branch."""
    *changes, distance = equations.call(equations.code.program("tangential"), t, q, v, dq, dv)
    return Tangential(stacked(changes[: len(q)]), stacked(changes[len(q) :]), distance)


def _checked(equations: "Equations", safe: Bool[Array, ""], a: Vector, t: Any, q: Vector, v: Vector) -> Vector:
    """Take what elimination gave where its pivots are safe, or their rows dropped; else do as the policy says."""
    if equations.branches:
        return jax.lax.cond(safe, lambda: a, lambda: equations.by(SVD).accelerations(t, q, v))
    return jnp.where(safe, a, jnp.nan) if equations.refuses else a


# --- derivatives


@partial(accelerations.defjvp, symbolic_zeros=True)
def _(program, primals, tangents):
    moving = moving_of(tangents)
    if not any(moving):
        return accelerations(program, *primals), jnp.zeros_like(primals[2])
    if primals[0].branches:
        return accelerations(program, *primals), by_plain_form("accelerations", primals, tangents)[0]
    (a,), (da,) = _along("accelerations", program, primals, tangents)
    return a, da


@partial(_projected.defjvp, symbolic_zeros=True)
def _(steps, primals, tangents):
    equations, t, _, _ = primals
    (q, v), judged = _projected(steps, *primals)
    dq, dv = _correction(equations, t, q, v, tangents)
    return ((q, v), judged), ((dq, dv), tuple(np.zeros(jnp.shape(x), jax.dtypes.float0) for x in judged))


@partial(_arrived.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    equations, t, *_ = primals
    tangents = tangents[:4]
    found = _arrived(*primals)
    (q, v, a), *rest = found
    dq, dv = _correction(equations, t, q, v, tangents)
    da = jnp.zeros_like(a)
    if any(moving_of(tangents)):
        _, (da,) = _along("accelerations", "accelerations", (equations, t, q, v), (*tangents[:2], dq, dv))
    none = jax.tree.map(lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0) if x.dtype == bool else jnp.zeros_like(x), rest)
    return found, ((dq, dv, da), *none)


@jax.custom_jvp
def as_projected(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """A state on the manifold, with the derivatives of a projection that returns it."""
    del equations, t
    return q, v


@partial(as_projected.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    equations, t, q, v = primals
    dq, dv = _correction(equations, t, q, v, tangents)
    return (q, v), (dq, dv)


def _correction(equations: "Equations", t: Any, q: Vector, v: Vector, tangents: Any) -> Sequence[Array]:
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    primals = equations, t, q, v
    if not any(moving_of(tangents)):
        return jnp.zeros_like(q), jnp.zeros_like(v)
    if equations.branches:
        return by_plain_form("projection", primals, tangents)
    return _along("projection", "projection", primals, tangents)[1]


def _along(name: str, program: str, primals: Any, tangents: Any) -> tuple[list[Array], ...]:
    """The accelerations by a program, or nothing where `name` is "projection", and the tangents of what has that name."""
    moving, moved = moving_of(tangents), numbers_moving_of(tangents)
    direction = those(tangents, moving), those_numbers(tangents, moved)

    def in_parts(primals: Any, *directions: Any) -> tuple[list[Array], ...]:
        if name == "accelerations":
            a, kept = _evaluated(program, moving, *primals)
            value = [a]
        else:
            equations, *state = jax.lax.stop_gradient(primals)
            value, kept = [], equations.call(equations.code.derivative(name, moving).evaluation(program), *state)
        linear = Linear.at(name, primals, moving, moved, kept)
        return value, *(applied(linear, *direction) for direction in directions)

    def at_once(primals: Any, *directions: Any) -> tuple[list[Array], ...]:
        equations, *state = primals
        program_along = equations.code.derivative(name, moving).along(program, len(directions))
        outputs = equations.call(program_along, *state, *(x for direction, _ in directions for x in direction))
        n, value = len(state[1]), []
        if name == "accelerations":
            *a, safe = outputs[: n + 1]
            value, outputs = [_checked(equations, safe, stacked(a), *state)], outputs[n + 1 :]
        changes = [stacked(outputs[k : k + n]) for k in range(0, len(outputs), n)]
        each = len(changes) // len(directions)
        return value, *(changes[k : k + each] for k in range(0, len(changes), each))

    if primals[0].loop is None:
        return in_parts(primals, direction)
    primals[0].loop.differentiated()
    return along(in_parts, at_once, primals, direction, primals[0].code.derivative(name, moving).few(program))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _evaluated(program: str, moving: tuple[bool, ...], equations: "Equations", t: Any, q: Vector, v: Vector) -> Any:
    """a, and what its derivative needs to know of the state."""
    outputs = equations.call(equations.code.derivative("accelerations", moving).evaluation(program), t, q, v)
    n = len(q)
    return _checked(equations, outputs[n], stacked(outputs[:n]), t, q, v), outputs[n + 1 :]


@_evaluated.defjvp
def _(program, moving, primals, tangents):
    """What is known of the state is a function of it: a further derivative is taken of the state instead."""
    a, tangent = jax.jvp(partial(accelerations, program), primals, tangents)
    kept = _evaluated(program, moving, *primals)[1]
    return (a, kept), (tangent, [jnp.zeros_like(k) for k in kept])
