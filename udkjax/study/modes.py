"""Vibration about a position of rest: frequencies, damping and mode shapes of the linearized mechanism."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from udkjax.annotations import Scalar
from udkjax.equations.analysis import Analysis, analyse
from udkjax.integrate.assembly import State
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.scene.arguments import checked
from udkjax.scene.fields import library_for, number, stored
from udkjax.scene.mechanism import Mechanism
from udkjax.study.equilibrium import degrees_of_freedom, equilibrium
from udkjax.study.linearization import linearize


class Modes(PrintsTable):
    """Small motions about a position of rest: q = q0 + shape exp(s t), or without damping q0 + shape cos(omega t).

    Attributes:
        q: the position about which the mechanism vibrates (bodies, 3).
        bodies: the names of the bodies, in the order of q.
    """

    omega2: Float[Array, "f"]  # (rad/s)^2 without damping, ascending; negative: it moves away as exp(sqrt(-omega2) t)
    shapes: Float[Array, "f bodies 3"]  # of omega2, with shape^T M shape = 1 kg m^2
    s: Complex[Array, "2f"]  # 1/s, with damping, by imaginary part and then by real part
    damped_shapes: Complex[Array, "2f bodies 3"]  # of s, of unit length
    q: Float[Array, "bodies 3"]
    residual: Float[Array, ""]  # N/sqrt(kg): what is left of the loads along free directions: zero at rest
    bodies: tuple[str, ...] = eqx.field(static=True, default=())

    _units = units(omega2="(rad/s)²", s="1/s", q="m, m, rad", residual="N/sqrt(kg)")

    def _table(self) -> PrintedTable:
        if np.ndim(self.omega2) > 1:
            return fields_table(self, self._units, f"modes of {np.shape(self.omega2)[0]} members")
        rows = []
        for k, x in enumerate(np.asarray(self.omega2)):
            omega, turns = math.sqrt(abs(float(x))), np.abs(np.asarray(self.shapes)[k, :, 2])
            kind = f"{omega:.6g} rad/s, {omega / (2 * math.pi):.6g} Hz" if x >= 0 else f"grows as exp({omega:.6g} t)"
            most = int(np.argmax(turns))
            rows.append((f"mode {k + 1}", f"{kind}; mostly {self.bodies[most] if self.bodies else f'body {most}'}"))
        rows += [("s, damped", format_numbers(self.s, "1/s")), ("damping", format_numbers(self.damping))]
        return PrintedTable("modes about a position of rest", rows)

    @property
    def frequencies(self) -> Float[Array, "f"]:
        """omega (rad/s) without damping; not a number where it moves away."""
        xp = library_for(self.omega2)
        with np.errstate(invalid="ignore"):
            return stored(xp.sqrt(xp.asarray(self.omega2)))

    @property
    def damping(self) -> Float[Array, "2f"]:
        """-Re s / |s| of each s: 0 undamped, 1 without oscillation, negative where it grows."""
        xp = library_for(self.s)
        s = xp.asarray(self.s)
        size = xp.abs(s)
        return stored(-s.real / xp.where(size > 0, size, 1.0))


@checked
def modes(mechanism: Mechanism, state: State | None = None, t: Scalar = 0.0, analysis: Analysis | None = None) -> Modes:
    """Return the modes about a position of rest: (s^2 N^T M N + s N^T C N + N^T K N) eta = 0, shape = N eta.

    C = -F_v and K = -F_q + (lambda^T Psi)_qq: preload, gravity and the constraints' curvature are in it. Pure, jittable and
    batched by `vmap`; eigenvalues and `shapes` have exact derivatives by every number of the mechanism, where they are simple
    (those of `equilibrium` carry on how the position changes); `damped_shapes` have none.

    Args:
        mechanism: its drivers hold the values of time t.
        state: where it rests; by default the equilibrium next to its initial guess.
        t: time (s) of drivers and loads.
        analysis: that of `analyse`; needed where all numbers are traced.

    Returns:
        `Modes`, of the f degrees of freedom.
    """
    analysis = analyse(mechanism) if analysis is None else analysis
    free, t = degrees_of_freedom(analysis), number(t)
    state = equilibrium(mechanism, None, t, analysis=analysis).state if state is None else state
    return _modes(mechanism.without_origin, analysis, free, t, number(library_for(state.q).ravel(state.q)))


@eqx.filter_jit
def _modes(mechanism: Mechanism, analysis: Analysis, free: int, t: Float[Array, ""], q: Float[Array, "n"]) -> Modes:
    at = linearize(mechanism, analysis, free, t, q)
    if not free:
        none = jnp.zeros((0, *q.reshape(-1, 3).shape))
        return Modes(jnp.zeros(0), none, jnp.zeros(0, complex), none + 0j, q.reshape(-1, 3), jnp.zeros(()), mechanism.body_names)
    L = jnp.linalg.cholesky(at.mass)
    solve = jax.scipy.linalg.solve_triangular
    N = solve(L, at.directions.T, lower=True).T  # of which N^T M N is one
    C, K = (solve(L, solve(L, A, lower=True).T, lower=True).T for A in (at.damping, at.stiffness))
    omega2, eta = jnp.linalg.eigh(0.5 * (K + K.T))
    shapes = (N @ eta).T.reshape(free, -1, 3)
    # In units of the fastest: what is far from one costs an eigenvalue its digits.
    unit = jax.lax.stop_gradient(jnp.sqrt(jnp.max(jnp.abs(K), initial=0.0)))
    unit = jnp.where(unit > 0, unit, 1.0)
    companion = jnp.block([[jnp.zeros_like(K), jnp.eye(free)], [-K / unit**2, -C / unit]])
    s = _sort(jnp.linalg.eigvals(companion))
    values, vectors = jnp.linalg.eig(jax.lax.stop_gradient(companion))
    damped = (jax.lax.stop_gradient(N) @ vectors[:free, _order(values)]).T
    damped = damped / jnp.linalg.norm(damped, axis=1, keepdims=True)
    return Modes(
        omega2,
        shapes,
        unit * s,
        damped.reshape(2 * free, -1, 3),
        q.reshape(-1, 3),
        jnp.max(jnp.abs(at.force), initial=0.0),
        mechanism.body_names,
    )


def _order(s: Complex[Array, "k"]) -> Int[Array, "k"]:
    return jnp.lexsort((s.real, s.imag))


def _sort(s: Complex[Array, "k"]) -> Complex[Array, "k"]:
    return s[_order(s)]
