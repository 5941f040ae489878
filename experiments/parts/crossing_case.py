"""A model of the table of functions by models with its runs, and the comparison of two ways to the same numbers."""

from collections.abc import Callable
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.crossing_models import Model

TS = np.linspace(0.0, 0.2, 5)
EXACT: Any = {"rtol": 1e-10, "atol": 1e-10}
STEP = 1e-4  # of differences, relative to a number


class WrongError(Exception):
    """Two ways to one number differ."""


class Accelerated(NamedTuple):
    """A motion with its accelerations."""

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    a: jax.Array


class Case:
    """A model with a run of it, and a twin: the same model, read from its own text or made of its elements."""

    def __init__(self, name: str, model: Model):
        self.name, self.model, self.events = name, model.build(), model.events()

    @cached_property
    def state(self) -> udk.State:
        return udk.assemble(self.model)

    @cached_property
    def run(self) -> udk.Solution:
        return udk.simulate(self.model, TS, self.state, events=self.events, throw=False, **EXACT)

    @cached_property
    def alone(self) -> udk.Solution:
        """A run without events."""
        return self.run if self.events is None else udk.simulate(self.model, TS, self.state, **EXACT)

    @cached_property
    def accelerated(self) -> Accelerated:
        """The run without events, with its accelerations."""
        a = [udk.accelerations(self.model, *at) for at in zip(TS, self.alone.q, self.alone.v, strict=True)]
        return Accelerated(jnp.asarray(TS), self.alone.q, self.alone.v, jnp.stack(a).reshape(self.alone.q.shape))

    @cached_property
    def reached(self) -> int:
        """The number of outputs that the run has reached."""
        return int(np.isfinite(np.asarray(self.run.q)).reshape(len(TS), -1).all(1).sum())

    @cached_property
    def is_system(self) -> bool:
        return isinstance(self.model, udk.ConstrainedSystem)

    @cached_property
    def twin(self) -> tuple[Any, str]:
        m = self.model
        if self.is_system:
            return m.with_parameters(m.parameters()), "a copy"
        if m.drawing is not None:
            return udk.Mechanism(m.bodies, m.joints, m.drivers, m.forces, m.gravity, m.name), "its elements alone"
        try:
            return udk.loads(udk.dumps(m)), "its saved text"
        except udk.SceneError:  # an element of one's own
            return udk.Mechanism(m.bodies, m.joints, m.drivers, m.forces, m.gravity, m.name), "its elements alone"

    @cached_property
    def number(self) -> str:
        """A number of the model: a mass, or what determines one."""
        return next(k for k in self.model.parameters() if k.rpartition(".")[2] in ("mass", "density", "weight", "inertia"))

    @cached_property
    def length(self) -> str | None:
        """A point of the model by which its positions can be changed: its loops still close."""
        if self.is_system:
            return "length"
        for name, x in self.model.independent_parameters().items():
            if (name.startswith("pin.") and name.count(".") == 1) or (name.endswith(".points") and name.startswith("joint.")):
                try:
                    closed = udk.assemble(self.model.with_parameters({name: 1.0001 * np.asarray(x)})).q
                except udk.AssemblyError:
                    continue
                if np.abs(closed - self.state.q).max() > 1e-9:
                    return name
        return None

    def changed(self, x: Any) -> Any:
        """Return the model whose number and length are greater by the fractions x and x/10."""
        numbers = {self.number: x} | ({} if self.length is None else {self.length: 0.1 * x})
        return self.model.with_parameters({k: self.model.parameters()[k] * (1.0 + y) for k, y in numbers.items()})

    @property
    def driver(self) -> Any:
        """A driver, or a coordinate that can drive the model; a system has neither."""
        if self.is_system:
            return "q[0]"
        if self.model.driver_names:
            return self.model.driver_names[0]
        return f"body.{self.model.body_names[0]}.angle"

    @cached_property
    def held(self) -> dict[str, Any] | None:
        """Coordinates to be held, so that all positions follow from the driver."""
        if self.is_system or self.model.driver_names:
            return None
        angles = [f"body.{name}.angle" for name in self.model.body_names]
        for others in combinations(angles[1:], max(udk.check(self.model).degrees_of_freedom - 1, 0)):
            held = {name: float(np.asarray(self.state.q)[angles.index(name), 2]) for name in others}
            try:
                udk.kinematics(self.model, angles[0], self.values(1), held=held)
            except udk.SceneError:
                continue
            return held or None
        return None

    @property
    def rate(self) -> float:
        return 1.0 if self.is_system or not self.model.driver_names else float(np.diff(self.values(2))[0]) / 0.05

    def values(self, count: int = 4) -> np.ndarray:
        """Values of the driver near the start."""
        if self.is_system:
            return float(np.asarray(self.state.q)[0]) + np.linspace(0.0, 0.05, count)
        if self.model.driver_names:
            motion = self.model.drivers[self.model.driver_names[0]].motion
            with jax.ensure_compile_time_eval():  # within `jit`, too
                return np.array([float(motion(t)) for t in np.linspace(0.0, 0.05, count)])
        return float(np.asarray(self.state.q)[0, 2]) + np.linspace(0.0, 0.05, count)

    @cached_property
    def output(self) -> str:
        """The angle that turns most while the first body, or the driven one, moves."""
        if self.is_system:
            return "q[0]"
        rates = np.abs(np.asarray(self.kinematics(self.model, 1, rate=1.0).v)[0, :, 2])
        rates[0] *= 1e-3  # often the driver itself
        return f"body.{self.model.body_names[int(np.argmax(rates))]}.angle"

    def kinematics(self, m: Any, count: int = 4, **more: Any) -> udk.Kinematics:
        return udk.kinematics(m, self.driver, self.values(count), held=self.held, **more)


def arrays(tree: Any) -> list[np.ndarray]:
    return [np.asarray(x, float) for x in jax.tree.leaves(tree) if np.asarray(x).dtype.kind in "fiub"]


def agree(found: Any, wanted: Any, by: str, tol: float = 1e-7) -> str:
    """Return `by` if two trees of numbers agree, relative to the largest of each array."""
    found, wanted = arrays(found), arrays(wanted)
    if len(found) != len(wanted):
        raise WrongError(f"{len(found)} arrays, by {by} {len(wanted)}")
    for a, b in zip(found, wanted, strict=True):
        if a.shape != b.shape or (np.isfinite(a) != np.isfinite(b)).any():
            raise WrongError(f"shape {a.shape} or numbers that are not finite, by {by} {b.shape}")
        finite = np.isfinite(a)
        error, size = np.abs(a[finite] - b[finite]).max(initial=0.0), 1e-3 + np.abs(b)[finite].max(initial=0.0)
        if error > tol * size:
            raise WrongError(f"differs by {error:.3g} of {size:.3g} from {by}")
    return by


def claim(is_true: Any, otherwise: str) -> None:
    """Raise `WrongError` unless something is true."""
    if not is_true:
        raise WrongError(otherwise)


Function = Callable[[Case, Any], Any]
Row = Callable[[Case], str]


def by_twin(function: Function, tol: float = 1e-7) -> Row:
    """Return the row of a function of a model, compared with the same of its twin."""

    def row(case: Case) -> str:
        twin, by = case.twin
        return agree(function(case, case.model), function(case, twin), by, tol)

    return row


def by_jit(function: Function) -> Row:
    """Return the row of a function of a model within `jit`, compared with an eager call."""
    return lambda case: agree(jax.jit(lambda m: function(case, m))(case.model), function(case, case.model), "an eager call")


def transformed(function: Function, tol: float = 1e-7, slope_tol: float = 1e-4) -> Row:
    """Return the row of a function under `jit`, `vmap` and both modes of derivatives, by a mass and a length of the model.

    Values are compared with eager calls, derivatives with their differences, and reverse mode with forward mode.
    """

    def row(case: Case) -> str:
        def numbers(x: Any) -> list[Any]:
            leaves = jax.tree.leaves(function(case, case.changed(x)))
            return [jnp.asarray(y) for y in leaves if jnp.issubdtype(jnp.asarray(y).dtype, jnp.floating)]

        def total(x: Any) -> Any:
            return sum(jnp.sum(jnp.sin(y / s)) for y, s in zip(numbers(x), sizes, strict=True))

        xs = jnp.array([0.0, 1e-3])
        eager = [numbers(x) for x in (*xs, -STEP, STEP)]
        if not eager[0]:
            return "no numbers, as eager calls"
        sizes = [float(jnp.abs(y).max(initial=0.0)) + 1e-3 for y in eager[0]]
        found, slopes = jax.jit(jax.vmap(lambda x: jax.jvp(numbers, (x,), (1.0,))))(xs)
        for k in (0, 1):
            agree([y[k] for y in found], eager[k], "eager calls (jit, vmap)", tol)
        wanted = [(b - a) / (2 * STEP) for a, b in zip(*eager[2:], strict=True)]
        # A relative change of 1 for a relative change of 1 is the scale of derivatives: less is rounding of the differences.
        forward = [1.0 + y[0] / s for y, s in zip(slopes, sizes, strict=True)]
        agree(forward, [1.0 + y / s for y, s in zip(wanted, sizes, strict=True)], "differences (jvp)", slope_tol)
        agree(jax.grad(total)(0.0), jax.jvp(total, (0.0,), (1.0,))[1], "forward mode (grad)", 1e-6)
        return "eager calls and differences"

    return row
