"""Static equilibria, stable or not: positions where loads and constraint forces balance, F = Psi_q^T lambda."""

import math
from typing import Annotated, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import NumberLike
from udkjax.argument_types import COUNT, NOT_NEGATIVE_COUNT
from udkjax.arrays import ArrayLibrary, is_traced, library_for, make_module, number, stored
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.positions.assembling.assembly import State, close
from udkjax.positions.following.branches import distinct_positions, random_positions
from udkjax.positions.following.curve import AbstractCurve, Curve, NumpyCurve
from udkjax.positions.following.drive import Driven
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_number, format_numbers, units
from udkjax.programs.control_flow import BY_JAX, BY_NUMPY, ControlFlow, sequential, solve
from udkjax.programs.undefined import whole
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import format_pose, size_of
from udkjax.scene.tables.checks import SceneError
from udkjax.scene.tables.position_only import refuse_rolling
from udkjax.statics.admissible_reactions import friction_holds_around
from udkjax.statics.linearization import Linearization, Linearizer, TracedLinearizer, linearizer, with_unit_mass
from udkjax.statics.load_scale import LoadScale
from udkjax.transforms.gradients import stop_gradients

MOST_NEWTON_STEPS = 100  # steps of limited length: ten are usual, a hundred cross any scene
FORCE_TOL = 1e-9  # tolerance of the loads along free directions, relative to the scale of forces; rounding leaves 1e-15
FORCE_ROUNDING = 32 * float(np.finfo(float).eps)  # relative to the scale of forces: no step reduces such rounding errors
NEUTRAL_STIFFNESS = 1e-10  # relative to the largest stiffness: smaller stiffnesses count as zero
SMALLEST_STIFFNESS = 1e-12  # relative to the scale of stiffnesses: smaller values are rounding errors, usually 1e-15

# The fraction of a step, the number of trials, whether the last was better, its q and the linearization at q.
Trial: TypeAlias = tuple[Array, Array, Array, Array, Linearization]
IsTrue: TypeAlias = Bool[Array, ""]  # named, since annotations of inner functions are evaluated at each call
# q, the linearization at q, the number of steps, whether the last was better, whether steps go downhill.
Settling: TypeAlias = tuple[Array, Linearization, Array, Array, Array]
REST_REQUIREMENT = "an equilibrium needs positions that the constraints determine"


class Equilibrium(PrintsTable):
    """A position of rest: `balanced` is true if the loads cancel, and `omega2` shows whether it is stable.

    Attributes:
        q: x, y (m) and angle (rad) of each body.
        balanced: whether loads and constraint forces cancel.
        bodies: the names of the bodies, in the order of q.
        left_out: the names of all `Friction` elements, which are left out of the balance of loads.
        holds_around: whether friction holds the mechanism in all positions around this one, too.
    """

    q: Float[Array, "bodies 3"]
    multipliers: Float[Array, "m"]  # lambda of F = Psi_q^T lambda (N, N m), of least norm; rows as in `analyse`
    omega2: Float[Array, "f"]  # (rad/s)^2: stiffness over mass along free directions, ascending; negative: unstable
    residual: Float[Array, ""]  # remaining loads along free directions, relative to the scale of forces
    balanced: Bool[Array, ""]
    neutral: Float[Array, ""]  # (rad/s)^2: a smaller |omega2| is rounding
    holds_around: Bool[Array, ""] = eqx.field(default_factory=lambda: np.asarray(False))
    bodies: tuple[str, ...] = eqx.field(static=True, default=())
    left_out: tuple[str, ...] = eqx.field(static=True, default=())

    _units = units(q="m, m, rad", multipliers="N or N m", omega2="(rad/s)²")

    def _table(self) -> PrintedTable:
        if np.ndim(self.balanced):
            title = f"{np.size(self.balanced)} positions, of which {int(np.sum(self.stable))} are stable"
            return fields_table(self, self._units, title)
        frequencies = ", ".join(_format_rate(float(x)) for x in np.asarray(self.omega2))
        rows = [
            ("omega²", format_numbers(self.omega2, "(rad/s)²")),
            ("frequency", frequencies or "no degree of freedom is left"),
            ("unbalanced loads", f"{format_number(self.residual, scale=1.0)} of the scale of forces"),
        ]
        if self.left_out and self.balanced and np.size(self.omega2):
            around = "with which it rests in all positions around, see holding_efforts"
            held = around if self.holds_around else "which does not hold it in positions around"
            rows.append(("left out", f"friction {', '.join(self.left_out)}, {held}"))
        poses = [format_pose(pose, size_of(self.q)) for pose in np.asarray(self.q)]
        rows += zip(self.bodies or map(str, range(len(poses))), poses, strict=True)
        return PrintedTable(f"position of rest, {self.kind}", rows)

    @property
    def state(self) -> State:
        """The `State` at rest in this position."""
        return State(self.q, np.zeros(np.shape(self.q)))

    @property
    def stable(self) -> Bool[Array, ""]:
        """True if all stiffnesses are positive: the potential energy has a minimum."""
        xp = library_for(self)
        neutral = xp.asarray(self.neutral)[..., None]
        return stored(xp.asarray(self.balanced) & xp.all(xp.asarray(self.omega2) > neutral, axis=-1))

    @property
    def indifferent(self) -> Bool[Array, ""]:
        """True if the lowest stiffness vanishes: a displaced mechanism neither moves away nor returns."""
        xp = library_for(self)
        least = xp.min(xp.asarray(self.omega2), axis=-1, initial=np.inf)
        return stored(xp.asarray(self.balanced) & (xp.abs(least) <= xp.asarray(self.neutral)))

    @property
    def kind(self) -> str:
        """Kind of one position: "stable", "indifferent", "unstable", or "not at rest: loads are not balanced"."""
        if not self.balanced:
            return "not at rest: loads are not balanced"
        return "stable" if self.stable else "indifferent" if self.indifferent else "unstable"


def _format_rate(omega2: float) -> str:
    omega = math.sqrt(abs(omega2))
    return f"{omega:.6g} rad/s ({omega / (2 * math.pi):.6g} Hz)" if omega2 >= 0 else f"exp({omega:.6g} t)"


def _require_weights(mechanism: Mechanism) -> None:
    if mechanism.massless and not (mechanism.is_concrete and np.all(np.asarray(mechanism.gravity) == 0.0)):
        mechanism.require_masses("equilibria", "give the scene gravity = [0, 0]")


@checked
def equilibrium(
    mechanism: Mechanism,
    state: State | None = None,
    t: NumberLike = 0.0,
    stable: bool = False,
    analysis: Analysis | None = None,
) -> Equilibrium:
    """Return a position of rest near a given position: N^T F = 0 on Psi = 0, where N spans the free directions.

    Friction is left out, and named in `left_out`. Where loaded joints with friction resist every motion, as `holds_around` says,
    the mechanism rests in all positions around as well: by statics alone, whatever its masses. `holding_efforts` has the bounds.

    Newton's method with K = -F_q + (lambda^T Psi)_qq; steps are limited in length, and halved until the unbalanced loads
    decrease. Where no step decreases them, the search goes on downhill, to a stable equilibrium. Pure, jittable and batched by
    `vmap` (`balanced` marks the members at rest); differentiable with respect to every number of the mechanism, where the
    stiffness is not singular.

    Args:
        mechanism: its drivers hold the values of time t.
        state: state to search from; by default the initial guess.
        t: time (s) of drivers and loads.
        stable: search downhill only, for a stable equilibrium; otherwise for any equilibrium nearby.
        analysis: the mechanism's `Analysis`; needed where all numbers are traced.

    Returns:
        An `Equilibrium`.

    Raises:
        ValueError: all numbers are traced, so that the number of degrees of freedom is unknown.
    """
    _require_weights(mechanism)
    refuse_rolling(mechanism, REST_REQUIREMENT)
    analysis = analyse(mechanism) if analysis is None else analysis
    free = degrees_of_freedom(analysis)
    t = np.asarray(t, float) if mechanism.is_concrete and not is_traced(t) else number(t)
    q = close(mechanism, t, state, analysis=analysis).state.q
    return solve(_equilibrium, mechanism.without_origin, analysis, t, library_for(q).ravel(q), free, stable)


@checked
@concrete_only()
def equilibria(
    mechanism: Mechanism,
    starts: Annotated[int, COUNT] = 64,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    t: NumberLike = 0.0,
    state: State | None = None,
) -> list[Equilibrium]:
    """Return the different equilibria found from several positions: the given position and random positions.

    Random positions turn every body by a random angle, and are then closed: any branch may be reached. From each, one search goes
    to the nearest equilibrium, stable or not, and one downhill, as with `equilibrium(..., stable=True)`. The search is not
    exhaustive.

    Args:
        mechanism: a mechanism of concrete numbers; its drivers hold the values of time t.
        starts: number of positions to search from.
        seed: seed of the random positions.
        t: time (s) of drivers and loads.
        state: the first position; by default the initial guess.

    Returns:
        A list of `Equilibrium`, the most stable first: by their lowest omega^2, descending.
    """
    _require_weights(mechanism)
    refuse_rolling(mechanism, REST_REQUIREMENT)
    analysis = analyse(mechanism)
    guesses = random_positions(mechanism, starts, seed, state)

    def found(stable: bool) -> Equilibrium:
        return jax.vmap(lambda q: equilibrium(mechanism, State(q, jnp.zeros_like(q)), t, stable, analysis))(guesses)

    batch = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), found(stable=False), found(stable=True))
    different = [jax.tree.map(lambda x, k=k: x[k], batch) for k in distinct_positions(batch.q, batch.balanced, analysis.scales)]
    return sorted(different, key=lambda e: -float(jnp.min(e.omega2, initial=jnp.inf)))


def degrees_of_freedom(analysis: Analysis) -> int:
    """Return the number of degrees of freedom; raise `SceneError` if it is unknown."""
    free = analysis.degrees_of_freedom
    if free is None:
        raise SceneError(
            [
                "the number of degrees of freedom is unknown: the initial guess cannot be closed, or not moved as the "
                "drivers ask (see udkjax check); or all numbers are traced: give analysis=udkjax.analyse(mechanism)"
            ]
        )
    return free


def _rest_curve(mechanism: Mechanism, analysis: Analysis, by: ControlFlow) -> AbstractCurve:
    """Return the positions of the mechanism as a curve whose value is time: `correct` closes positions at a fixed time."""
    return (Curve if by is BY_JAX else NumpyCurve).of(Driven(mechanism, analysis, "", -1, 1.0))


def _omega2(at: Linearization, by: ControlFlow) -> Float[Array, "f"]:
    """Return omega^2 of the undamped linearization, (rad/s)^2, ascending."""
    xp, K = by.xp, with_unit_mass(at, by)[1]
    return xp.linalg.eigvalsh(0.5 * (K + K.T)) if len(K) > 1 else K.ravel()


def _equilibrium(
    mechanism: Mechanism, analysis: Analysis, t: Any, start: Any, free: int, stable: bool, by: ControlFlow
) -> Equilibrium:
    curve, near = _rest_curve(mechanism, analysis, by), linearizer(mechanism, analysis, free, by)
    if by is BY_NUMPY:
        q = _settle(curve, near, t, start, free, stable)
    else:
        q = sequential(_settle, *stop_gradients((curve, near, t, start)), free, stable)
        assert isinstance(curve, Curve)
        (q,) = whole(_rest_position(curve, analysis, t, q, free))
    xp, scale, at = by.xp, near.scale(t, q), near.linearize(t, q)
    unbalanced = _length(at.force, xp) / xp.where(scale.force > 0, scale.force, 1.0)
    balanced = curve.is_closed(xp.concatenate([q, xp.reshape(xp.asarray(t), 1)]) / curve.units) & (unbalanced <= FORCE_TOL)
    neutral, friction = SMALLEST_STIFFNESS * scale.stiffness, Friction.names_in(mechanism.forces)
    holds_around = balanced & friction_holds_around(mechanism, analysis, t, q, free) if friction else balanced & False
    return make_module(
        Equilibrium,
        q=q.reshape(-1, 3),
        multipliers=at.multipliers,
        omega2=_omega2(at, by),
        residual=unbalanced,
        balanced=balanced,
        neutral=neutral,
        bodies=mechanism.body_names,
        holds_around=holds_around,
        left_out=friction,
    )


def _settle(
    curve: AbstractCurve, near: Linearizer, t: Float[Array, ""], q: Float[Array, "n"], free: int, stable: bool
) -> Float[Array, "n"]:
    """Return the position after Newton steps from q, which end when a step does not improve the position.

    Unbalanced loads may have a minimum where they do not vanish: from there, steps go downhill. With `stable`, all steps do.
    """
    if not free:
        return q
    by, xp, scale = curve.by, curve.by.xp, near.scale(t, q)
    units, value = _step_units(curve.units[:-1], q, xp), xp.reshape(xp.asarray(t), 1)

    def is_unsettled(state: Settling) -> IsTrue:
        _, current, k, better, _ = state
        return better & (k < MOST_NEWTON_STEPS) & (_length(current.force, xp) > FORCE_ROUNDING * scale.force)

    def body(state: Settling) -> Settling:
        q, current, k, _, downhill = state
        newton, descent = (lambda goal=goal: _towards_rest(current, scale, goal, curve) for goal in (False, True))
        step = current.directions @ (descent() if stable else by.cond(downhill, descent, newton))
        step = step * CLOSURE.shortening(abs(step / units).max(), xp)
        size = _length(current.force, xp)

        def trial(state: Trial) -> Trial:
            share, j, *_ = state
            X, closed = curve.correct(xp.concatenate([q + share * step, value]) / curve.units, fixed=True)
            new = (X * curve.units)[:-1]
            trial = near.linearize(t, new)
            # A position is better if the loads do work (by the trapezoidal rule), or the unbalanced loads decrease.
            work = 0.5 * (current.loads + trial.loads) @ (new - q)
            better = (downhill & (work > 0)) | (_length(trial.force, xp) < size)
            return 0.5 * share, j + 1, closed & better, new, trial

        def worse(state: Trial) -> IsTrue:
            return (state[1] < CLOSURE.halvings) & ~state[2]

        first = xp.ones(()), xp.asarray(0), xp.asarray(False), q, current
        _, _, better, new, following = by.while_loop(worse, trial, first)
        new, following = by.cond(better, lambda: (new, following), lambda: (q, current))
        is_stuck = ~better & ~downhill & (size > FORCE_TOL * scale.force)
        return new, following, k + 1, better | is_stuck, downhill | is_stuck

    start = q, near.linearize(t, q), xp.asarray(0), xp.asarray(True), xp.asarray(stable)
    return by.while_loop(is_unsettled, body, start)[0]


def _length(force: Float[Array, "f"], xp: ArrayLibrary) -> Float[Array, ""]:
    return xp.sqrt(force @ force)  # in a third of the time of a norm


def _step_units(units: Float[Array, "n"], q: Float[Array, "n"], xp: ArrayLibrary) -> Float[Array, "n"]:
    """Return the units of steps: radians, and for lengths the extent of the mechanism, if that is longer than its bodies.

    A body at the end of a long chain moves by many lengths of a link while all links turn by a small angle.
    """
    places = q.reshape(-1, 3)[:, :2]
    extent = (places.max(0) - places.min(0)).max()
    lengths, angles = units.reshape(-1, 3)[:, :2], units.reshape(-1, 3)[:, 2:]
    return xp.concatenate([xp.maximum(lengths, extent), angles], axis=1).ravel()


def _towards_rest(linearization: Linearization, scale: LoadScale, stable: bool, curve: AbstractCurve) -> Float[Array, "f"]:
    """Return a step eta along the directions of the linearization: Newton's step or, if `stable`, one that goes downhill."""
    xp, rounding = curve.by.xp, SMALLEST_STIFFNESS * scale.stiffness
    if xp is np and len(linearization.force) == 1:  # in a fifth of the time of decompositions
        stiffness = linearization.stiffness[0, 0]
        least = max(abs(stiffness), rounding) if stable else stiffness if abs(stiffness) > rounding else np.inf
        return linearization.force / (least if least else 1.0)
    if not stable:
        resists = abs(linearization.stiffness).max() > rounding
        return curve.plus(xp.where(resists, linearization.stiffness, 0.0), NEUTRAL_STIFFNESS) @ linearization.force
    values, vectors = xp.linalg.eigh(0.5 * (linearization.stiffness + linearization.stiffness.T))
    values = xp.abs(values)
    values = xp.maximum(values, xp.maximum(NEUTRAL_STIFFNESS * xp.max(values), rounding))
    return vectors @ (vectors.T @ linearization.force / xp.where(values > 0, values, 1.0))


@eqx.filter_custom_jvp
def _rest_position(curve: Curve, analysis: Analysis, t: Float[Array, ""], q: Float[Array, "n"], free: int) -> Float[Array, "n"]:
    """Return the position of rest q, with the derivatives of one Newton step from q."""
    return q


@_rest_position.def_jvp
def _(primals, tangents):
    curve, analysis, t, _, free = primals
    q = _rest_position(*primals)

    def newton(curve: Curve, t: Float[Array, ""]) -> Float[Array, "n"]:
        X = jnp.append(q, t) / curve.units
        E = curve.slopes(X).at[:, -1].set(0.0)
        closed = ((X - curve.plus(E) @ curve.residual(X)) * curve.units)[:-1]
        if not free:
            return closed
        near = TracedLinearizer(curve.mechanism, analysis, free)
        linear, scale = near.linearize(t, closed), near.scale(t, q)
        return closed + linear.directions @ _towards_rest(linear, scale, False, curve)

    given = (curve, t)
    none = jax.tree.map(jnp.zeros_like, eqx.filter(given, eqx.is_inexact_array))
    moving = eqx.combine((tangents[0], tangents[2]), none)
    return q, eqx.filter_jvp(newton, given, moving)[1]
