"""The reactions by which friction can hold a mechanism at rest, and the largest and smallest effort among them.

A body at rest is in equilibrium: with friction phi_k along the sliding of joint k and an effort f along a coordinate c,

    Psi_q^T lambda = F + C^T f + W^T phi,        |phi_k| <= L_k(lambda),        C = c_q,

where L is the constant torque, plus the static coefficient times the load of the joint. The row of c is among those of Psi, and
its multiplier is -f. Masses enter by weights only: lambda = lambda_0 + A phi + N s, where N s are internal loads, which cancel.

L is a norm of loads, and lies above its tangents. So for tangents at any lambda, the phi and s that meet their inequalities are a
convex set of admissible ones, over which a linear program finds the largest f. New tangents at its solution allow a larger f, and
so on until nothing changes, as in Newton's method. All states on the way are admissible, and so are those between them: friction
can hold the mechanism by every effort from that without friction to the bound. The set of all admissible states is not convex,
and a search may end at a smaller bound where a load reverses: further searches begin where the friction of each joint is largest.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Time
from udkjax.complementarity.linear_program import maximize
from udkjax.equations import constraints, determinacy, loads
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.friction.directed_friction import DirectedFriction
from udkjax.equations.rows.analysis import Analysis
from udkjax.pinv import SVD
from udkjax.programs.deferred import deferred
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.load_scale import load_sizes
from udkjax.transforms.gradients import stop_gradients

UNBALANCED_TOL = 1e-9  # loads along motions other than the coordinate's, relative to all loads; rounding leaves 1e-15
LOADED_TOL = 1e-12  # friction of a joint, relative to all loads; rounding leaves 1e-15
MOST_TANGENTS = 50  # three to six are usual
LAST_CHANGE = 1e-13  # of the bound, relative, by the last tangents
# Relative to all loads: friction at which the first tangents are taken, so that forces of unloaded joints have a direction, too.
STEP_ASIDE = 1e-6
PRELOAD = 10.0  # internal loads of a second start, relative to all loads; any that are larger than the others


class Reactions(NamedTuple):
    """Equilibria of a position: multipliers and effort, affine in the friction x and the internal loads s.

    x_k is phi_k times the unit of displacement of joint k: a work per radian or characteristic length.
    """

    multipliers: Float[Array, "m"]  # lambda_0 (N, N m), without friction
    by_friction: Float[Array, "m K"]  # change of lambda by x
    internal: Float[Array, "m s"]  # change of lambda by s
    units: Float[Array, "K"]  # one radian, or the characteristic length
    row: int  # of the coordinate in Psi
    scale: Float[Array, ""]  # size of the loads, as work per radian or characteristic length

    @property
    def without_internal(self) -> "Reactions":
        """The same equilibria, but with the internal loads of least norm only: s has no entries."""
        return self._replace(internal=self.internal[:, :0])

    def at(self, z: Float[Array, "N"]) -> Float[Array, "m"]:
        """Return the multipliers lambda for the vector z of the friction x in each joint (K,), then the internal loads s."""
        count = len(self.units)
        return self.multipliers + self.by_friction @ z[:count] + self.internal @ z[count:]

    def effort(self, z: Float[Array, "N"]) -> Float[Array, ""]:
        """Return the effort f (N, N m) along the coordinate, for z as in `at`."""
        return -self.at(z)[self.row]


class Balance(NamedTuple):
    """The motion that constraints admit, and loads that they do not balance, as work per radian or characteristic length."""

    motion: Float[Array, ""]  # the part of a unit speed along the coordinate that constraints admit: 1 where it moves
    force: Float[Array, ""]  # its size for F
    friction: Float[Array, "n K"]  # for a unit of friction in each joint


def reactions_at(
    mechanism: Mechanism, analysis: Analysis, t: Time, q: Float[Array, "n"], row: int = 0
) -> tuple[Reactions, "Balance"]:
    """Return the equilibria of a position at rest, and the parts of the loads that the constraints do not balance.

    Args:
        mechanism: the mechanism, with a driver for the coordinate.
        analysis: its `Analysis`.
        t: time (s) of drivers and loads.
        q: a closed position (n,).
        row: the row of the coordinate in Psi.
    """
    directed, scales = DirectedFriction.put_in(mechanism, every=True), analysis.scales
    still, units = jnp.zeros_like(q), analysis.coordinate_units
    J = determinacy.scaled_jacobian(mechanism, t, q, analysis)
    identity = jnp.eye(len(J))
    plus = uk.pseudoinverse(SVD(determinacy.STATIC_RANK_TOL), J) @ identity
    joint_units = directed.units(scales.length)
    slides = jax.jacfwd(lambda v: directed.sliding_speeds(q, v))(still) / joint_units[:, None]
    force, friction = units * loads.force(directed.mechanism, t, q, still), units[:, None] * slides.T
    scale = jax.lax.stop_gradient(jnp.linalg.norm(units * load_sizes(mechanism, t, q, still)))

    def unbalanced(work: Array) -> Array:
        return work - J.T @ (plus.T @ work)

    left = unbalanced(friction)
    takes_part = jnp.linalg.norm(left, axis=0) <= UNBALANCED_TOL * jnp.linalg.norm(friction, axis=0)
    found = Reactions(
        multipliers=(plus.T @ force) / analysis.row_units,
        by_friction=jnp.where(takes_part, plus.T @ friction, 0.0) / analysis.row_units[:, None],
        internal=(identity - J @ plus) / analysis.row_units[:, None],
        units=joint_units,
        row=row,
        scale=scale,
    )
    return found, Balance(J[row] @ plus[:, row] if len(J) else jnp.ones(()), jnp.linalg.norm(unbalanced(force)), left)


def limits(mechanism: Mechanism, reactions: Reactions, z: Float[Array, "N"]) -> Float[Array, "K"]:
    """Return the largest friction L of each joint, in the units of x, for z as in `Reactions.at`."""
    rows: dict[str, list[int]] = {}
    for k, (owner, _) in enumerate(constraints.row_names(mechanism)):
        rows.setdefault(owner, []).append(k)
    multipliers, found = reactions.at(z), []
    for friction in mechanism.forces.values():
        if isinstance(friction, Friction):
            own = [multipliers[k] for k in rows[friction.joint]]
            found.append(jnp.asarray(friction.largest_force(mechanism.joints[friction.joint], own)))
    return reactions.units * jnp.stack(found)


class _TangentSearch(NamedTuple):
    z: Array
    y: Array
    slope: Array  # of the limits
    count: Array
    idle: Array  # linear programs since the last change
    goes_on: Array
    solved: Array
    endless: Array


def largest_effort(mechanism: Mechanism, reactions: Reactions, sign: float) -> Float[Array, ""]:
    """Return the largest `sign` times f among the admissible reactions; infinity if it is unbounded.

    Searches begin without friction; with internal loads, which press on each joint that they reach if they are large enough; and
    where the friction of one joint is as large as it can be, for each joint and sign.

    The derivative is that of the linear program: its multipliers times those of the inequalities (envelope theorem).
    """
    scene, fixed = stop_gradients((mechanism, reactions))
    K = len(reactions.units)
    if not K:
        return sign * reactions.effort(jnp.zeros(reactions.internal.shape[1]))
    origin = jnp.zeros(K + reactions.internal.shape[1])
    c, sides = sign * jax.grad(fixed.effort)(origin), jnp.eye(K, len(origin))

    constant = limits(scene, fixed._replace(multipliers=0 * fixed.multipliers), origin)  # of joints without load

    def again(c: Array, search: _TangentSearch) -> _TangentSearch:
        """Move z to the solution of the linear program linearized there; unloaded joints change the sign of their slope."""
        z, base = search.z, jnp.where(search.count == 0, search.z + aside, search.z)
        slope = jax.jacfwd(lambda z: limits(scene, fixed, z))(base)
        available = limits(scene, fixed, base) + slope @ (z - base)
        is_unloaded = (available - constant <= LOADED_TOL * fixed.scale) & (search.count > 0)
        slope = jnp.where(is_unloaded[:, None], -search.slope, slope)
        rows = jnp.concatenate([sides - slope, -sides - slope])
        left = jnp.concatenate([available - z[:K], available + z[:K]])
        found = maximize(c, rows, left, jnp.concatenate([sides + jnp.abs(slope)] * 2))
        z = z + found.x
        changes = jnp.abs(c @ found.x) > LAST_CHANGE * (jnp.abs(c) @ jnp.abs(z))
        idle = jnp.where(changes, 0, search.idle + 1)
        goes_on = found.solved & (idle < 2) & (search.count < MOST_TANGENTS)
        return _TangentSearch(z, found.y, slope, search.count + 1, idle, goes_on, found.solved & ~goes_on, found.endless)

    size = jnp.where(fixed.scale > 0, fixed.scale, 1.0)
    aside = origin.at[:K].set(STEP_ASIDE * size * jnp.sign(c[:K]))
    loaded = origin.at[K:].set(PRELOAD * size * np.random.default_rng(0).standard_normal(len(origin) - K))

    def search(z: Array, c: Array) -> _TangentSearch:
        """Return the end of a search for the largest c z from an admissible state."""
        counts, marks = [jnp.asarray(0)] * 2, [jnp.asarray(x) for x in (True, False, False)]
        start = _TangentSearch(z, jnp.zeros(2 * K), 0 * sides, *counts, *marks)
        return jax.lax.while_loop(lambda search: search.goes_on, partial(again, c), start)

    def value(found: _TangentSearch) -> Array:
        z, forward, backward = found.z, found.y[:K], found.y[K:]
        bound = sign * reactions.effort(z) + (forward + backward) @ limits(mechanism, reactions, z) - (forward - backward) @ z[:K]
        return jnp.where(found.endless, jnp.inf, jnp.where(found.solved, bound, jnp.nan))

    starts = jnp.stack([origin] if len(origin) == K else [origin, loaded])
    extreme = jax.vmap(search, (None, 0))(origin, jnp.concatenate([sides, -sides]))
    is_end = extreme.solved & ~extreme.endless
    starts = jnp.concatenate([starts, jnp.where(is_end[:, None], extreme.z, 0.0)])
    return jnp.max(jax.vmap(value)(jax.vmap(search, (0, None))(starts, c)))


@deferred
def friction_holds_around(mechanism: Mechanism, analysis: Analysis, t: Time, q: Float[Array, "n"], free: int) -> Bool[Array, ""]:
    """Return True if friction holds the mechanism in all positions around a position of rest q, at time t (s).

    Loads change little around q, so that little friction balances them. Friction holds the mechanism if the joints that carry
    loads, or have a constant torque, resist motions in all of its `free` degrees of freedom.
    """
    reactions, balance = reactions_at(mechanism, analysis, t, q)
    if not free:
        return jnp.asarray(False)
    available = limits(mechanism, reactions, jnp.zeros(len(reactions.units) + reactions.internal.shape[1]))
    resists = jnp.where(available > LOADED_TOL * reactions.scale, balance.friction, 0.0)
    sigma = jnp.linalg.svd(jnp.pad(resists, ((0, 0), (0, free))), compute_uv=False)
    return sigma[free - 1] > determinacy.STATIC_RANK_TOL
