"""Vibration about a position of rest: frequencies, damping and mode shapes of the linearized mechanism."""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from udkjax.annotations import NumberLike
from udkjax.arrays import ArrayLibrary, is_traced, library_for, number, stored
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.positions.assembling.assembly import State
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_numbers, units
from udkjax.programs.control_flow import ControlFlow, solve
from udkjax.scene.arguments import checked
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.position_only import refuse_rolling
from udkjax.statics.equilibrium import degrees_of_freedom, equilibrium
from udkjax.statics.linearization import linearizer, solver_of_mass, with_unit_mass
from udkjax.transforms.gradients import stop_gradients


class Modes(PrintsTable):
    """Small motions about a position of rest: q = q0 + shape exp(s t), or without damping q0 + shape cos(omega t).

    Attributes:
        q: the position about which the mechanism vibrates (bodies, 3).
        bodies: the names of the bodies, in the order of q.
        left_out: the names of friction that has no linearization at rest: it depends on loads, or sticks.
    """

    omega2: Float[Array, "f"]  # (rad/s)^2 without damping, ascending; negative: grows as exp(sqrt(-omega2) t)
    shapes: Float[Array, "f bodies 3"]  # of omega2, with shape^T M shape = 1 kg m^2
    s: Complex[Array, "2f"]  # 1/s, with damping, by imaginary part and then by real part
    damped_shapes: Complex[Array, "2f bodies 3"]  # of s, of unit length
    q: Float[Array, "bodies 3"]
    residual: Float[Array, ""]  # N/sqrt(kg): remaining loads along free directions, zero at rest
    bodies: tuple[str, ...] = eqx.field(static=True, default=())
    left_out: tuple[str, ...] = eqx.field(static=True, default=())

    _units = units(omega2="(rad/s)²", s="1/s", q="m, m, rad", residual="N/sqrt(kg)")

    def _table(self) -> PrintedTable:
        if np.ndim(self.omega2) > 1:
            return fields_table(self, self._units, f"modes of {np.shape(self.omega2)[0]} members")
        rows = [] if len(self.omega2) else [("frequency", "no degree of freedom is left")]
        for k, x in enumerate(np.asarray(self.omega2)):
            omega, turns = math.sqrt(abs(float(x))), np.abs(np.asarray(self.shapes)[k, :, 2])
            kind = f"{omega:.6g} rad/s, {omega / (2 * math.pi):.6g} Hz" if x >= 0 else f"grows as exp({omega:.6g} t)"
            largest = int(np.argmax(turns))
            rows.append((f"mode {k + 1}", f"{kind}; mostly {self.bodies[largest] if self.bodies else f'body {largest}'}"))
        if self.left_out:
            rows.append(("left out", f"friction {', '.join(self.left_out)}: it would hold small motions"))
        rows += [("s, damped", format_numbers(self.s, "1/s")), ("damping", format_numbers(self.damping))]
        return PrintedTable("modes about a position of rest", rows)

    @property
    def frequencies(self) -> Float[Array, "f"]:
        """omega (rad/s) without damping; NaN where the mechanism moves away."""
        xp = library_for(self.omega2)
        with np.errstate(invalid="ignore"):
            return stored(xp.sqrt(xp.asarray(self.omega2)))

    @property
    def damping(self) -> Float[Array, "2f"]:
        """-Re s / |s| for each s: 0 undamped, 1 without oscillation, negative if the motion grows."""
        xp = library_for(self.s)
        s = xp.asarray(self.s)
        size = xp.abs(s)
        return stored(-s.real / xp.where(size > 0, size, 1.0))


@checked
def modes(mechanism: Mechanism, state: State | None = None, t: NumberLike = 0.0, analysis: Analysis | None = None) -> Modes:
    """Return the modes about a position of rest: (s^2 N^T M N + s N^T C N + N^T K N) eta = 0, shape = N eta.

    C = -F_v, and K = -F_q + (lambda^T Psi)_qq includes preload, gravity and the constraints' curvature. K is symmetric if the
    loads have a potential; a load that turns with a body has none. `s` and `damped_shapes` use all of K and include flutter;
    `omega2` and `shapes` use the symmetric part of K.

    Pure, jittable and batched by `vmap`; eigenvalues and `shapes` have exact derivatives with respect to every number of the
    mechanism, where they are simple (those of `equilibrium` include the change of position); `damped_shapes` have no
    derivatives.

    Friction that depends on loads, or sticks, has no linearization at rest: it is left out, and named in `left_out`.

    Args:
        mechanism: its drivers hold the values of time t.
        state: state at rest; by default the equilibrium near the initial guess.
        t: time (s) of drivers and loads.
        analysis: the mechanism's `Analysis`; needed where all numbers are traced.

    Returns:
        The `Modes` of the f degrees of freedom.
    """
    mechanism.require_masses("frequencies")
    refuse_rolling(mechanism, "modes need positions that the constraints determine")
    analysis = analyse(mechanism) if analysis is None else analysis
    free = degrees_of_freedom(analysis)
    t = np.asarray(t, float) if mechanism.is_concrete and not is_traced(t) else number(t)
    state = equilibrium(mechanism, None, t, analysis=analysis).state if state is None else state
    found = solve(_modes, mechanism.without_origin, analysis, t, library_for(state.q).ravel(state.q), free)
    rubbing = [name for name, x in mechanism.forces.items() if isinstance(x, Friction) and (x.rubs or x.sticks)]
    return replace(found, left_out=tuple(rubbing))


def _modes(mechanism: Mechanism, analysis: Analysis, t: Any, q: Any, free: int, by: ControlFlow) -> Modes:
    xp, at, position = by.xp, linearizer(mechanism, analysis, free, by).linearize(t, q), q.reshape(-1, 3)
    if not free:
        no_shapes = xp.zeros((0, *position.shape))
        return Modes(xp.zeros(0), no_shapes, xp.zeros(0, complex), no_shapes + 0j, position, xp.zeros(()), mechanism.body_names)
    N = solver_of_mass(at, by)(at.directions.T).T  # N^T M N = 1
    C, K = with_unit_mass(at, by)
    omega2, eta = xp.linalg.eigh(0.5 * (K + K.T))
    shapes = (N @ eta).T.reshape(free, -1, 3)
    # In units of the fastest mode: at other scales the eigenvalues are less accurate.
    unit = stop_gradients(xp.sqrt(xp.max(xp.abs(K), initial=0.0)))
    unit = xp.where(unit > 0, unit, 1.0)
    companion = xp.block([[xp.zeros_like(K), xp.eye(free)], [-K / unit**2, -C / unit]])
    s = xp.asarray(xp.linalg.eigvals(companion), complex)
    values, vectors = xp.linalg.eig(stop_gradients(companion))
    damped = (stop_gradients(N) @ vectors[:free, _order(values, xp)]).T
    damped = xp.asarray(damped / xp.linalg.norm(damped, axis=1, keepdims=True), complex)
    return Modes(
        omega2,
        shapes,
        unit * s[_order(s, xp)],
        damped.reshape(2 * free, -1, 3),
        position,
        xp.max(xp.abs(at.force), initial=0.0),
        mechanism.body_names,
    )


def _order(s: Complex[Array, "k"], xp: ArrayLibrary) -> Int[Array, "k"]:
    return xp.lexsort((s.real, s.imag))
