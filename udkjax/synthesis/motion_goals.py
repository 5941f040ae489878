"""Motion goals: limits on torques, loads of joints, energies, frequencies, gaps and tolerances, beside a positional goal.

Each goal measures positions of a motion with a constant rate of the driver, over the whole turn if there is one, otherwise over
the range of the positional goal's values. A measure m above `most` adds the residual weight scale (m / most - 1), a measure below
`least` adds weight scale (1 - m / least), and a measure in between adds nothing. Here, scale is the scale of the positional goal
divided by the square root of the number of samples.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations import constraints, loads
from udkjax.positions import gap_in_position
from udkjax.positions.following.drive import Driven
from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.requirements import require_count, require_function, require_number, require_numbers_by_name, require_text
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.goals import Goal, check_place, place_of
from udkjax.wording import quote, suggestion


class MotionPoint(NamedTuple):
    """A position of a motion, as motion goals measure it.

    Attributes:
        mechanism: the mechanism with the numbers of the trial.
        q: positions (bodies, 3) (m, rad).
        v: velocities (bodies, 3) (m/s, rad/s).
        a: accelerations (bodies, 3).
        rate: dq/ds, the derivative with respect to the driver's value (bodies, 3).
        bend: d^2q/ds^2 (bodies, 3).
        loads: the loads (k, m) requested by `MotionTerm.loads`.
        numbers: the free numbers.
        x: values of the free numbers in the trial (P,).
        psi: the function x (P,) -> Psi (m,) at this position.
        target: the target of the positional goal at this position, if a `RobustGoal` measures it.
        extras: further unknowns of the positional goal.
    """

    mechanism: Mechanism
    q: Float[Array, "bodies 3"]
    v: Float[Array, "bodies 3"]
    a: Float[Array, "bodies 3"]
    rate: Float[Array, "bodies 3"]
    bend: Float[Array, "bodies 3"]
    loads: Float[Array, "k m"]
    numbers: FreeNumbers
    x: Float[Array, "P"]
    psi: Callable[[Array], Array]
    target: Float[Array, "G"]
    extras: Float[Array, "E"]

    @property
    def missing(self) -> Float[Array, "n"]:
        """M a - F: the generalized forces that joints and drivers have to exert (N, N m)."""
        force = loads.force(self.mechanism, 0.0, self.q, self.v)
        return loads.mass(self.mechanism) * self.a.ravel() - force


def _float(x: Any) -> Any:
    is_array = isinstance(x, jax.Array | np.ndarray | np.generic)
    return float(x) if is_array and x.ndim == 0 and x.dtype.kind in "fiu" else x


class MotionTerm(PrintsTable):
    """A motion goal: limits on a measure of the positions of a motion, in addition to a positional goal.

    Args:
        most: upper limit of the measure, positive.
        least: lower limit of the measure, positive.
        speed: the rate of the driver (rad/s, m/s); by default that of its motion at time 0.
        weight: to exceed the limit by 100 % costs as much as to miss a place by `weight` scales of the positional goal.
        samples: number of measured positions.
    """

    most: float | None = eqx.field(static=True, converter=_float, default=None, kw_only=True)
    least: float | None = eqx.field(static=True, converter=_float, default=None, kw_only=True)
    speed: float | None = eqx.field(static=True, converter=_float, default=None, kw_only=True)
    weight: float = eqx.field(static=True, default=0.1, kw_only=True)
    samples: int = eqx.field(static=True, default=36, kw_only=True)

    def __check_init__(self):
        if self.most is None and self.least is None:
            raise ValueError("give most, least, or both: the limits of the measure")
        for name in ("most", "least", "weight"):
            if getattr(self, name) is not None:
                require_number(name, getattr(self, name), "positive")
        if self.speed is not None:
            require_number("speed", self.speed)
        require_count("samples", self.samples)

    @property
    def positional(self) -> Goal | None:
        """The positional goal whose targets this goal measures; None if it measures no targets."""
        return None

    def check(self, mechanism: Mechanism, driven: Driven, free: Sequence[str]) -> None:
        """Raise `SceneError` if the mechanism lacks the measured element; by default nothing is checked.

        Args:
            mechanism: the mechanism.
            driven: the mechanism as driven by its driver.
            free: the names of the free numbers.
        """

    def loads(self, at: MotionPoint) -> Float[Array, "k n"]:
        """Return the right-hand sides b of systems Psi_q^T y = b needed by the measure; their solutions y are `at.loads`."""
        return jnp.zeros((0, at.q.size))

    def measure(self, at: MotionPoint) -> Float[Array, ""]:
        """Return the measure of a position; every motion goal overrides this method."""
        raise NotImplementedError

    def residual(self, measure: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals of measures, and the derivatives of the residuals with respect to the measures."""
        unit, r, slope = self.weight * scale, np.zeros_like(measure), np.zeros_like(measure)
        if self.most is not None:
            above = measure > self.most
            r, slope = np.where(above, unit * (measure / self.most - 1.0), r), np.where(above, unit / self.most, slope)
        if self.least is not None:
            below = measure < self.least
            r, slope = np.where(below, unit * (1.0 - measure / self.least), r), np.where(below, -unit / self.least, slope)
        return r, slope

    def _table(self) -> PrintedTable:
        ends = [(name, f"{getattr(self, name):g}") for name in ("least", "most") if getattr(self, name) is not None]
        return PrintedTable(type(self).__name__, ends)


class MotionGoal(MotionTerm):
    """A function of a motion stays between `least` and `most`.

    Args:
        function: returns the measure of a `MotionPoint`, written with jax.numpy.
    """

    function: Callable[[MotionPoint], Float[Array, ""]] = eqx.field(static=True)

    def __check_init__(self):
        require_function("function", self.function, "of a MotionPoint")

    def measure(self, at):
        return jnp.asarray(self.function(at)).reshape(())


class TorqueGoal(MotionTerm):
    """The size of the driver's effort, its torque (N m) or force (N), stays below `most`.

    The effort is the power of inertia, weight, springs and friction, divided by the speed. Arguments: see `MotionTerm`.
    """

    def measure(self, at):
        return jnp.abs(at.rate.ravel() @ at.missing)


class LoadGoal(MotionTerm):
    """The force (N) in a joint stays below `most`; the mechanism must have no redundant joints.

    Args:
        joint: the name of the joint; in a drawing, the name of the pin. Further arguments: see `MotionTerm`.
    """

    joint: str = eqx.field(static=True)

    def __check_init__(self):
        require_text("joint", self.joint)

    def check(self, mechanism, driven, free):
        if self.joint not in mechanism.joints:
            listed = f"no joint named {quote(self.joint)}{suggestion(self.joint, mechanism.joints)}"
            raise SceneError([f"goal: {listed}"], mechanism.name)
        if driven.analysis.redundant_rows != ():
            problem = "goal: joints are redundant, so that their forces do not follow from the motion: measure another load"
            raise SceneError([problem], mechanism.name)

    def loads(self, at):
        return at.missing[None]

    def measure(self, at):
        names = constraints.row_names(at.mechanism)
        rows = jnp.stack([at.loads[0, k] for k, (name, _) in enumerate(names) if name == self.joint])
        return _length(rows)


class EnergyGoal(MotionTerm):
    """The kinetic energy (J) stays below `most`, or above `least`. Arguments: see `MotionTerm`."""

    def measure(self, at):
        return loads.kinetic_energy(at.mechanism, at.v)


class FrequencyGoal(MotionTerm):
    """The frequency (Hz) of the mechanism without its driver stays above `least` and below `most`; negative if unstable.

    With u = dq/ds, the mass is u^T M u and the stiffness -d(u^T F)/ds. Arguments: see `MotionTerm`.
    """

    def measure(self, at):
        u, mass = at.rate.ravel(), loads.mass(at.mechanism)

        def force(q: Array) -> Array:
            return loads.force(at.mechanism, 0.0, q, jnp.zeros_like(q))

        F, slope = jax.jvp(force, (at.q.ravel(),), (u,))
        square = -(at.bend.ravel() @ F + u @ slope) / (u @ (mass * u))
        return jnp.sign(square) * _root(jnp.abs(square)) / (2.0 * jnp.pi)


class GapGoal(MotionTerm):
    """The gap (m) between two links stays above `least`; overlaps are negative gaps, as in `gaps`.

    It is measured in `samples` positions; `gaps` proves the gap of a design between them.

    Args:
        one: the name of a link.
        other: the name of the other link, or "ground" if `shapes` gives its shape.
        shapes: shapes of links, as for `gaps`, if they are not drawn. Further arguments: see `MotionTerm`.
    """

    one: str = eqx.field(static=True)
    other: str = eqx.field(static=True)
    shapes: Mapping[str, Any] | None = None
    samples: int = eqx.field(static=True, default=72, kw_only=True)

    def __check_init__(self):
        for name in ("one", "other"):
            require_text(name, getattr(self, name))

    def check(self, mechanism, driven, free):
        gap_in_position(mechanism, self.shapes, (self.one, self.other), mechanism.q0)

    def measure(self, at):
        return gap_in_position(at.mechanism, self.shapes, (self.one, self.other), at.q)


class ToleranceGoal(MotionTerm):
    """The error of a point due to errors t_k of numbers, sqrt(sum_k (t_k dp/dx_k)^2) (m), stays below `most`.

    Args:
        point: point, as for a `PathGoal`.
        tolerances: tolerances of free numbers by name, in their units; the coordinates of a pin vary independently. Further
            arguments: see `MotionTerm`.
    """

    point: str = eqx.field(static=True)
    tolerances: Mapping[str, float] = eqx.field(static=True)

    def __check_init__(self):
        require_text("point", self.point)
        require_numbers_by_name("tolerances", self.tolerances)

    def check(self, mechanism, driven, free):
        problems = [
            f"goal: {quote(n)} has a tolerance and is not free{suggestion(n, free)}" for n in self.tolerances if n not in free
        ]
        if problems:
            raise SceneError(problems, mechanism.name)
        check_place(mechanism, self.point, None)

    def loads(self, at):
        return jax.jacfwd(lambda q: jnp.stack(place_of(at.mechanism, self.point, None, q.reshape(-1, 3))))(at.q.ravel())

    def measure(self, at):
        def place(x: Array) -> Array:
            return jnp.stack(place_of(at.numbers.moved(x), self.point, None, at.q))

        tolerances = [
            jnp.full(np.size(v), self.tolerances.get(n, 0.0)) for n, v in zip(at.numbers.names, at.numbers.values, strict=True)
        ]
        change = jax.jacrev(place)(at.x) - jnp.stack([jax.grad(lambda x, y=y: y @ at.psi(x))(at.x) for y in at.loads])
        return _length((change * jnp.concatenate(tolerances)).ravel())


def _root(x: Array) -> Array:
    """Return a square root with a finite derivative at zero."""
    return jnp.where(x == 0.0, 0.0, jnp.sqrt(jnp.where(x == 0.0, 1.0, x)))


def _length(x: Array) -> Array:
    return _root(x @ x)
