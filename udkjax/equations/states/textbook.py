"""The equations of motion of a mechanism in textbook form (udwadia_kalaba.py): any pseudoinverse, derivatives of any order."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.annotations import Time, Vector
from udkjax.equations.friction import rubbing
from udkjax.equations.friction.loose_friction import LooseFriction, loose_friction
from udkjax.equations.friction.sticking_state import StickingState
from udkjax.equations.laws import udwadia_kalaba as uk
from udkjax.equations.laws.abstract_system import ConstrainedRows, TangentPart
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.scales import Scales
from udkjax.equations.programs.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.states.scene_changes import KnownState
from udkjax.equations.terms import constraints, loads
from udkjax.equations.terms.scene_layout import LoadShares
from udkjax.pinv import Auto, Elimination, Plus, Pseudoinverse
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism


class TextbookEquations(ConstrainedRows):
    """The equations of motion of one mechanism by one pseudoinverse.

    Coordinates and velocities are flat vectors (3 bodies,): x, y, angle of each body in turn. Rows are weighted by
    `Scales.weights`.
    """

    mechanism: Mechanism
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    scales: Scales
    redundant: tuple[int, ...] | None = eqx.field(static=True)  # rows that elimination leaves out; None: unknown
    only_switched: bool = eqx.field(static=True, default=False)  # whether unknown ones are those that are switched off
    soft: Float[Array, "m"] | None = None  # compliances of the rows, by which they share redundant forces; None: by least norm
    sticking: Bool[Array, "F"] | None = None  # the joints that are known to stick; None: the law decides

    def size(self, dq: Vector) -> Float[Array, ""]:
        """Return the largest component of a change of coordinates: displacements in characteristic lengths, angles in rad."""
        return self.scales.size(dq)

    def violation_size(self, psi: Float[Array, "m"]) -> Float[Array, ""]:
        """Return the largest violation of any row of Psi, each divided by the row's scale."""
        return self.scales.violation(psi)

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        """Return a = a_F + M^(-1/2) D^+ b."""
        return self._accelerations(t, q, v, self._friction(t, q, v))

    def multipliers(self, t: Time, q: Vector, v: Vector) -> Float[Array, "m"]:
        """Return lambda = -(D^+)^T D^+ b."""
        if self.sticks:
            return self._sticking_state.loads(t, q, v).multipliers
        given = self.mechanism, t, q, v, self.method, self.baumgarte, self.scales.weights
        if self.rubs or self.soft is not None:
            return rubbing.settled_multipliers(*given, self.soft)
        return uk.multipliers(*given)

    def motion(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Float[Array, "m"]]:
        """Return a (n,) and lambda (m,) of one solution, with the friction that depends on lambda."""
        if self.sticks:
            multipliers, friction, _ = self._sticking_state.loads(t, q, v)
        else:
            multipliers = self.multipliers(t, q, v)
            friction = rubbing.rubbing_loads(self.mechanism, t, q, v, multipliers) if self.rubs else None
        return self._accelerations(t, q, v, friction), multipliers

    def _accelerations(self, t: Time, q: Vector, v: Vector, friction: Vector | None) -> Vector:
        return uk.accelerations(self.mechanism, t, q, v, self.method, self.baumgarte, self.weights, friction)

    def _friction(self, t: Time, q: Vector, v: Vector) -> Vector | None:
        """Return the loads of friction that depends on the loads of joints; None if there is none."""
        if self.sticks:
            return self._sticking_state.loads(t, q, v).friction
        if not self.rubs:
            return None
        return rubbing.rubbing_loads(self.mechanism, t, q, v, self.multipliers(t, q, v))

    def friction_loads(self, t: Time, q: Vector, v: Vector) -> dict[str, Vector]:
        """Return the loads of each friction (n,), by its name."""
        if self.sticks:
            return self._sticking_state.loads(t, q, v).by_name
        return rubbing.loads_of_friction(self.mechanism, t, q, v, self.multipliers(t, q, v))

    @property
    def _sticking_state(self) -> StickingState:
        return StickingState(
            self.mechanism, self.method, self.baumgarte, self.scales.weights, self.scales, self.soft, self.sticking
        )

    @property
    def sticks(self) -> bool:
        """True if any friction of the mechanism is set-valued."""
        return Friction.may_stick(self.mechanism._forces)

    def with_compliances(self, soft: Float[Array, "m"] | None) -> "TextbookEquations":
        """Return the equations in which redundant forces are shared by the compliances of rows; None: by least norm."""
        return replace(self, soft=soft)

    def known(self, state: KnownState) -> "TextbookEquations":
        """Return the equations for the constraints that hold at a state of a motion, and the joints that are known to stick."""
        return replace(self, mechanism=state.put_in(self.mechanism), sticking=state.sticking)

    def rubbing_powers(self, t: Time, q: Vector, v: Vector, multipliers: Float[Array, "m"]) -> dict[str, Array]:
        """Return the power (W) of the friction that depends on the loads of joints, by joint."""
        drags = rubbing.single_rubbing_loads(self.mechanism, t, q, v, multipliers)
        return {joint: v @ drag for joint, drag in drags.items()}

    def rubbing_terms(self, q: Vector, v: Vector, multipliers: Float[Array, "m"]) -> dict[str, Float[Array, "3"]]:
        """Return the speed of sliding s (m/s), mu(s) and the load (N) of each friction that depends on a load, by joint."""
        return rubbing.terms_of_rubbing(self.mechanism, q, v, multipliers)

    def loose_friction(self, t: Time, q: Vector, N: Float[Array, "m k"]) -> LooseFriction:
        """Find the joints with friction whose loads are not unique: see `loose_friction`."""
        return loose_friction(self.mechanism, t, q, N, self.scales)

    @property
    def rubbing_joints(self) -> list[str]:
        """The joints whose friction depends on their load."""
        return rubbing.rubbing_names(self.mechanism)

    @property
    def rubs(self) -> bool:
        """True if friction depends on the loads of joints."""
        return bool(self.rubbing_joints)

    def rank(self, t: Time, q: Vector, v: Vector | None = None) -> Int[Array, ""]:
        """Return the rank of D at a position, by the threshold of the pseudoinverse."""
        return uk.pseudoinverse(self.method, uk.D(self.mechanism, t, q, self.scales.weights)).rank

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v projected onto Psi = 0 and Psi_dot = 0, by the smallest change in the metric of M."""
        return _project(self, t, q, v)

    def correct(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v after a Newton step in position and a Newton step in velocity.

        For a state on the manifold the result has the derivatives of a projection.
        """
        return uk.project(self.mechanism, t, q, v, self.method, self.weights, steps=1)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        """Return (I - M^(-1/2) D^+ D M^(1/2)) times dq and dv, the tangent parts of small changes at q."""
        mechanism, w = self.mechanism, self.weights
        if constraints.rolling_rows(mechanism).any():
            changes = (dq, True), (dv, False)
            return TangentPart(*(uk.tangent_part(mechanism, t, q, x, self.method, w, is_dq) for x, is_dq in changes))
        tangent = jax.vmap(lambda change: uk.tangent_part(mechanism, t, q, change, self.method, w))  # with one D^+ for both
        return TangentPart(*tangent(jnp.stack([dq, dv])))

    def violation(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Return Psi (m,) and Psi_dot (m,) of all rows."""
        return constraints.psi(self.mechanism, t, q), constraints.psi_dot(self.mechanism, t, q, v)

    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Return whether all terms of the equation are finite."""
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in self.matrices(t, q, v)]))

    def matrices(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """Return M, F, Psi_q and gamma - 2 alpha Psi_dot - beta^2 Psi, for all rows."""
        mechanism, A = self.mechanism, constraints.psi_q(self.mechanism, t, q)
        c = uk.b(mechanism, t, q, v, self.baumgarte) + A @ uk.a_F(mechanism, t, q, v)
        F, friction = loads.force(mechanism, t, q, v), self._friction(t, q, v)
        return jnp.diag(loads.mass(mechanism)), F if friction is None else F + friction, A, c

    def jacobian(self, t: Time, q: Vector, v: Vector | None = None) -> Float[Array, "m n"]:
        """Return Psi_q of all rows."""
        return constraints.psi_q(self.mechanism, t, q)

    def weighted_rows(self, t: Time, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return D and Psi, their rows weighted, and M^(-1/2), of all rows."""
        w = self._weights_of_positions(self.scales.weights)
        return uk.D(self.mechanism, t, q, w), w * constraints.psi(self.mechanism, t, q), uk.inverse_sqrt_mass(self.mechanism)

    def weighted_rates(self, t: Time, q: Vector, v: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """Return D and Psi_dot, their rows weighted, and M^(-1/2), of all rows."""
        w = self.row_weights
        rate = w * constraints.psi_dot(self.mechanism, t, q, v)
        return uk.D(self.mechanism, t, q, w), rate, uk.inverse_sqrt_mass(self.mechanism)

    def _weights_of_positions(self, w: Float[Array, "m"]) -> Float[Array, "m"]:
        """Return the weights w with zeros for the rows that restrict velocities alone, which are then left out."""
        rolling = constraints.rolling_rows(self.mechanism)
        return jnp.where(rolling, 0.0, w) if rolling.any() else w

    def energy(self, t: Time, q: Vector, v: Vector) -> tuple[Array, Array]:
        return loads.kinetic_energy(self.mechanism, v), loads.potential_energy(self.mechanism, t, q, v)

    def linearized_position(self, t: Time, q: Vector) -> tuple[Plus | uk.ZeroPseudoinverse, Float[Array, "m"], Vector]:
        """Return D^+ by the method, Psi, both with weighted rows, and M^(-1/2)."""
        mechanism, w = self.mechanism, self.weights
        return (
            uk.pseudoinverse(self.method, uk.D(mechanism, t, q, w)),
            uk.weigh(w, constraints.psi(mechanism, t, q)),
            uk.inverse_sqrt_mass(mechanism),
        )

    def linearized_velocity(self, t: Time, q: Vector, v: Vector) -> tuple[Plus | uk.ZeroPseudoinverse, Float[Array, "m"], Vector]:
        """Return D^+ by the method, Psi_dot, both with weighted rows, and M^(-1/2)."""
        mechanism, w = self.mechanism, self.weights
        rate = uk.weigh(w, constraints.psi_dot(mechanism, t, q, v))
        return uk.pseudoinverse(self.method, uk.D(mechanism, t, q, w)), rate, uk.inverse_sqrt_mass(mechanism)

    @property
    def weights(self) -> Float[Array, "m"]:
        """The weights of the rows; redundant rows have weight zero if the method is `Elimination`.

        Elimination could not tell their small pivots from rounding errors.
        """
        if not isinstance(self.method, Elimination) or not self.redundant:
            return self.scales.weights
        return self.scales.weights.at[np.array(self.redundant)].set(0.0)

    @property
    def programs(self) -> ScenePrograms:
        """The programs of the scene: if redundant rows are unknown, `Elimination` drops them, and others need marks of rows."""
        redundant = () if self.redundant is None and isinstance(self.method, Elimination) else self.redundant
        shares = LoadShares.NONE
        if self.rubs and redundant != () and not self.only_switched:
            shares = LoadShares.MARKED if redundant is None else LoadShares.KNOWN
        return scene_programs(self.mechanism, redundant, self.baumgarte is not None, RankPolicy.of(self.method), sharing=shares)

    @property
    def programs_of_marked_rows(self) -> ScenePrograms:
        return scene_programs(self.mechanism.at(0.0), None, policy=RankPolicy.FALL_BACK)

    @property
    def programs_of_rows(self) -> ScenePrograms:
        return scene_programs(self.mechanism).with_all_rows

    @property
    def row_names(self) -> list[tuple[str, int]]:
        """For each row of Psi, the name of its constraint, and its index among the rows of this constraint."""
        return constraints.row_names(self.mechanism)

    @property
    def constrained(self) -> bool:
        return bool(self.mechanism.constraints)

    @property
    def stabilized(self) -> bool:
        return self.baumgarte is not None

    @property
    def restricts_velocities(self) -> bool:
        return bool(constraints.rolling_rows(self.mechanism).any())

    @property
    def row_weights(self) -> Float[Array, "m"]:
        return self.scales.weights

    @property
    def rank_tol(self) -> Float[Array, ""]:
        return self.scales.rank_tol


def prepare(
    mechanism: Mechanism,
    method: Pseudoinverse | None = None,
    baumgarte: Baumgarte | None = None,
    analysis: Analysis | None = None,
) -> TextbookEquations:
    """Return the equations of motion of a mechanism, by a pseudoinverse.

    Args:
        mechanism: The scene; its numbers may be traced.
        method: The pseudoinverse, by default `Auto`, with the `rank_tol` of the scales.
        baumgarte: Gains of Baumgarte stabilization; None: no stabilization.
        analysis: The mechanism's `Analysis`; by default computed here.

    Returns:
        The equations, ready to be evaluated at states (n,).

    Raises:
        ValueError: `Elimination` with an absolute threshold.
    """
    analysis = analyse(mechanism) if analysis is None else analysis
    mechanism = mechanism.without_origin
    chosen = Auto() if method is None else method
    tol = analysis.scales.rank_tol if chosen.rank_tol is None else chosen.rank_tol
    chosen = eqx.tree_at(lambda m: m.rank_tol, chosen, tol, is_leaf=lambda x: x is None)
    if isinstance(chosen, Elimination) and not chosen.relative:
        raise ValueError("the rank_tol of Elimination must be relative here: it is compared with the remaining part of each row")
    return TextbookEquations(
        mechanism=mechanism,
        method=chosen,
        baumgarte=baumgarte,
        scales=analysis.scales,
        redundant=analysis.redundant_rows,
        only_switched=analysis.only_switched,
    )


# A projection is differentiated at its result, where all residuals vanish.


@jax.custom_jvp
def _project(equations: TextbookEquations, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    return uk.project(equations.mechanism, t, q, v, equations.method, equations.weights)


@_project.defjvp
def _(primals, tangents):
    equations, t, *_ = primals
    return jax.jvp(_at_projection, (equations, t, *_project(*primals)), tangents)


@jax.custom_jvp
def _at_projection(equations: TextbookEquations, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """Return a state on the manifold unchanged, with the derivatives of `project` at its result."""
    del equations, t
    return q, v


@_at_projection.defjvp
def _(primals, tangents):
    _, _, q, v = primals
    return (q, v), jax.jvp(TextbookEquations.correct, primals, tangents)[1]
