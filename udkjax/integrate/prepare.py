"""Preparation of all kinds of runs before their first step, with concrete or traced numbers."""

from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from udkjax.arrays import number
from udkjax.equations.laws.formulations import Formulation
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis, analysis_of, hold_pins
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.integrate.native_engine import mark_rows
from udkjax.integrate.outcome import LEAST_ATOL, increases, usable
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import Projection
from udkjax.integrate.solvers import has_method
from udkjax.integrate.stabilization import Stabilization
from udkjax.native.module.steps import SMALLEST_STEP
from udkjax.pinv import Auto, Pseudoinverse
from udkjax.positions.assembling.assembly import Closure, State, close, moves_from_guess
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.programs.undefined import whole
from udkjax.requirements import ArgumentTypeError, describe
from udkjax.scene.elements.friction import Friction
from udkjax.scene.model import RunModel
from udkjax.scene.tables.checks import numbers_are_valid
from udkjax.transforms.gradients import stop_gradients

if TYPE_CHECKING:
    import diffrax

AUTO = Auto()  # a single object: caches compare it by identity
# Defaults of `drift_tol`, relative to the scales of the rows. With projection, only rows left out as redundant can be violated by
# more than rounding errors. Without it drift is expected, up to a bound beyond which the run is useless: the paper's linkage, not
# stabilized, is 1.6 rad off the exact solution when its loops are 2e-3 open.
DRIFT_PROJECTED, DRIFT_FREE = 1e-6, 1e-3
LOOSE_TOL = 1e3  # tolerance of runs that fail before their first step
NO_DRIFT = -1.0  # `drift_tol` of such runs: only their first output is kept


class Choices(NamedTuple):
    """The choices of a run: most arguments of `simulate`, and two remarks, `held` and `kinks`, for `Solution.settings`.

    The mechanism, its analysis and initial state, the output times and the events are given separately.
    """

    rtol: Any  # numbers, which may be traced
    atol: Any
    drift_tol: Any
    dt0: Any
    method: Pseudoinverse
    stabilization: Projection | Baumgarte | Stabilization | None
    formulation: Formulation | None = None
    solver: "diffrax.AbstractSolver | None" = None
    adjoint: "diffrax.AbstractAdjoint | None" = None
    meter: "diffrax.AbstractProgressMeter | None" = None  # the progress meter
    max_steps: int = 100_000
    engine: str = "auto"
    held: str = ""  # names of pins whose angles are held (`with_held_pins`); "": none
    stepper: "diffrax.AbstractStepSizeController | None" = None  # None: the default controller
    kinks: str = ""  # a remark: whether kinks of forces are located, and in which forces not; "": there are none

    @property
    def of_mechanism(self) -> tuple[Any, ...]:
        """The arguments of `compile_mechanism` that follow the mechanism and its analysis, in order."""
        return self.method, self.stabilization, self.formulation, self.solver, self.adjoint, self.meter, self.engine, self.stepper

    @property
    def take_diffrax(self) -> bool:
        """True if diffrax integrates any mechanism with these choices: on request, or if machine code lacks one of them."""
        return self.engine in ("diffrax", "jax") or not has_method(self.solver) or bool(self._of_diffrax)

    @property
    def _of_diffrax(self) -> str:
        """A phrase for messages that names an argument only diffrax supports, such as "a progress meter"; "" if none is given."""
        if self.stepper is not None:
            return "a step size controller"
        meter = "" if self.meter is None else "a progress meter"
        return meter if self.adjoint is None else "a diffrax adjoint"

    @property
    def without_events(self) -> str:
        """A phrase for messages: an argument with which runs cannot locate events, kinks or stick-slip; "" if none is given."""
        own = "a stabilization of your own" if isinstance(self.stabilization, Stabilization) else ""
        return self._of_diffrax or own

    @property
    def integrator(self) -> str:
        """The engine of a run without machine code: "diffrax", or "jax" if the equations are plain JAX, too."""
        return "jax" if self.engine == "jax" else "diffrax"

    def arrays(self) -> "Choices":
        """Return the choices with JAX arrays instead of plain numbers, which would become constants of compiled programs."""
        dt0 = None if self.dt0 is None else number(self.dt0)
        return self._replace(rtol=number(self.rtol), atol=number(self.atol), drift_tol=number(self.drift_tol), dt0=dt0)

    def settings(self, why_not_native: str) -> tuple[tuple[str, str], ...]:
        """Return the settings of a run, for `Solution.settings`: pairs of names and values, all strings.

        The setting `stiff_solver` is the implicit method with which a run by the default solver goes on where it is stiff.

        Args:
            why_not_native: the reason why machine code does not integrate the run; "" if it does.
        """
        return (
            ("method", type(self.method).__name__),
            ("formulation", "UdwadiaKalaba" if self.formulation is None else type(self.formulation).__name__),
            ("stabilization", type(self.stabilization).__name__),
            ("solver", "Dopri8" if self.solver is None else type(self.solver).__name__),
            *([("stiff_solver", "Kvaerno5")] if self.solver is None and not why_not_native else []),
            *([("stepsize_controller", type(self.stepper).__name__)] if self.stepper is not None else []),
            ("max_steps", str(self.max_steps)),
            ("first_step", "chosen" if self.dt0 is None else "given"),
            ("engine", f"{self.integrator}: {why_not_native}" if why_not_native else "native"),
            *([("held pins", self.held)] if self.held else []),
            *([("kinks", self.kinks)] if self.kinks else []),
        )


def with_held_pins(
    mechanism: Any, events: Any, analysis: Analysis | None, choices: Choices
) -> tuple[Any, Analysis | None, Choices]:
    """Return the mechanism, analysis and choices of a run in which pins that cannot turn are held.

    Constraints may prevent a pin from turning to second order only: the angle of such a pin is held by a further constraint. The
    returned analysis is then None, since the mechanism has to be analysed again, and the choices name the pins. All three are
    returned unchanged if there is no such pin, or if an event removes a constraint.
    """
    if events is not None:
        from udkjax.integrate.events.law.event import listed_events  # other runs do not need the modules of events

        if any(getattr(getattr(event, "action", None), "removed", None) for event in listed_events(events)):
            return mechanism, analysis, choices
    holding = hold_pins(mechanism)
    if holding is None:
        return mechanism, analysis, choices
    return holding.mechanism, None, choices._replace(held=", ".join(pin.name for pin in holding.pins))


@cached_by_identity
def may_stick(mechanism: RunModel) -> bool:
    """Return True if a joint of the model has set-valued friction."""
    return Friction.may_stick(mechanism.forces.values())


def with_kinks(system: Any, choices: Choices) -> tuple[Choices, bool]:
    """Return the choices with a remark on jumps and kinks of forces, and True if the run locates any of these."""
    if not _may_have_kinks(system):
        return choices, False
    from udkjax.integrate.events.law.kinks import kinks_of  # most runs do not need it

    found, without = kinks_of(system), choices.without_events
    return choices._replace(kinks=found.remark(f"with {without}" if without else "")), found.are_held and not without


@cached_by_identity
def _may_have_kinks(system: Any) -> bool:
    return system.may_have_kinks


class Beginning(NamedTuple):
    """The analysis of a model and the closure of its initial guess, before a run."""

    analysis: Analysis | None
    closure: Closure | None  # closure of the initial guess; None if the state is given
    is_open: bool  # whether the closure is known to be open
    moves: str  # a warning if assembly moves bodies far from the guess; else ""


def begin(mechanism: Any, t: Any, analysis: Analysis | None, state: State | None, closure: Closure | None) -> Beginning:
    """Analyse a model, and assemble its initial guess at the time t (s); a given analysis, state or closure is kept instead."""
    analysis = analysis_of(mechanism) if analysis is None else analysis
    Analysis.require_masses(mechanism, "free motions")
    moves = ""
    if state is None and closure is None:
        closure = close(mechanism, t, analysis=analysis)
        moves = moves_from_guess(mechanism, t, closure) if mechanism.is_concrete else ""
    is_open = closure is not None and not isinstance(closure.is_closed, Tracer) and not closure.is_closed
    return Beginning(analysis, closure, is_open, moves)


begin_concrete = cached_by_identity(begin)


class PreparedRun(NamedTuple):
    """A run before its first step, and the facts about its arguments that determine its `Result`."""

    problem: Problem
    ts: Float[Array, "T"]  # output times, as given
    state_shape: tuple[int, ...]  # shape of q and v in the solution
    is_usable: Bool[Array, ""]  # whether all numbers are valid for `simulate`
    is_closed: Bool[Array, ""]  # whether the initial state is closed; True for a given state
    has_missed_rows: Bool[Array, ""]  # whether rows left out as redundant are independent in the closed state


def prepare_run(
    compiled: CompiledMechanism,
    analysis: Analysis | None,
    ts: Any,
    state: State | None,
    closure: Closure | None,
    choices: Choices,
    xp: ModuleType = jnp,
) -> PreparedRun:
    """Return the problem to integrate, with the facts about its arguments that `outcome` needs.

    Args:
        compiled: The mechanism.
        analysis: The `Analysis` of the mechanism; None for a user-defined system.
        ts: Output times (s).
        state: The initial state; None: the state of `closure`.
        closure: The assembled initial guess.
        choices: All other arguments of `simulate`.
        xp: jax.numpy, or NumPy if all numbers are concrete (`checked` has checked them).

    Returns:
        The run. If its numbers are invalid or its initial state is open, it gets loose tolerances, so that it does not delay
        other members of a batch.
    """
    start = (_concrete_start if xp is np else _start)(compiled, analysis, state, closure)
    rtol, atol, good, given_ts = choices.rtol, choices.atol, xp.asarray(True), ts
    if xp is jnp:
        numbers: Any = (start.q, start.v, rtol, atol, choices.drift_tol, choices.dt0)
        good = usable(*stop_gradients(numbers)) | ~start.is_closed
        if analysis is not None:
            good = good & stop_gradients(jnp.asarray(numbers_are_valid(compiled.textbook.mechanism.elements)))
            good = good & jnp.isfinite(compiled.textbook.scales.mass)
    if isinstance(ts, Tracer):
        in_order = increases(stop_gradients(ts))
        good, ts = good & in_order, jnp.where(in_order, ts, jnp.arange(len(ts)))
    if xp is jnp:
        q, v = whole(start.q, start.v)
        start = start._replace(q=q, v=v)
    runs, length, rate = good & start.is_closed, start.length, start.rate
    if analysis is not None:
        rate = xp.maximum(rate, 1 / (ts[-1] - ts[0]))
    if xp is jnp:
        length, rate = stop_gradients((length, rate))
    problem = Problem(
        compiled=compiled,
        ts=ts,
        q=start.q,
        v=start.v,
        rtol=xp.where(runs, rtol, LOOSE_TOL),
        atol=xp.where(runs, xp.maximum(atol, LEAST_ATOL), LOOSE_TOL),
        smallest=SMALLEST_STEP * np.finfo(float).eps * xp.maximum(xp.abs(ts[0]), xp.abs(ts[-1])),
        h=choices.dt0,
        length=length,
        rate=rate,
        max_steps=choices.max_steps,
        stepper=choices.stepper,
        stabilization=choices.stabilization if isinstance(choices.stabilization, Stabilization) else None,
        drift_tol=xp.where(runs & ~start.has_missed_rows, choices.drift_tol, NO_DRIFT),
        marks=mark_rows(compiled, ts[0], start.q, start.v, length, rate, xp) if compiled.plan.marks_rows else None,
    )
    return PreparedRun(problem, given_ts, start.shape, good, start.is_closed, start.has_missed_rows)


class RunStart(NamedTuple):
    """The initial state of a run, and the units of its tolerances."""

    q: Float[Array, "n"]
    v: Float[Array, "n"]
    shape: tuple[int, ...]  # shape of the given coordinates
    is_closed: Bool[Array, ""]  # as in `PreparedRun`
    has_missed_rows: Bool[Array, ""]  # as in `PreparedRun`
    length: Any  # unit of `atol` (m); None: coordinates are of order one
    rate: Any  # characteristic rate of the system and the initial velocities (1/s)


def _start(
    compiled: CompiledMechanism, analysis: Analysis | None, state: State | None, closure: Closure | None, xp: ModuleType = jnp
) -> RunStart:
    missed, closed, length, rate = xp.asarray(False), xp.asarray(True), None, xp.ones(())
    if closure is not None:
        state, closed = closure.state, xp.asarray(closure.is_closed)
        if compiled.plan.is_native:
            missed = closed & (xp.asarray(closure.rank) > compiled.plan.used_row_count)
    assert state is not None  # a state or a closure is given
    q, v = xp.ravel(xp.asarray(state.q)), xp.ravel(xp.asarray(state.v))
    if analysis is not None:
        scales = compiled.textbook.scales
        length, rate = scales.length, xp.maximum(scales.rate, scales.size(v, xp))
    return RunStart(q, v, np.shape(state.q), closed, missed, length, rate)


@cached_by_identity
def _concrete_start(
    compiled: CompiledMechanism, analysis: Analysis | None, state: State | None, closure: Closure | None
) -> RunStart:
    """Return the start of a run with concrete numbers, by NumPy."""
    return _start(compiled, analysis, state, closure, np)


def jax_adjoint(adjoint: Any) -> Any:
    """Return the adjoint of diffrax for a run; None for `ForwardMode`, since runs have forward derivatives by default."""
    import diffrax

    return None if type(adjoint) is diffrax.ForwardMode else adjoint


def progress_meter(progress: Any) -> "diffrax.AbstractProgressMeter | None":
    """Return the progress meter for an argument `progress`: True, False or a meter of diffrax; None if none is to be shown."""
    if progress is False:
        return None
    import diffrax

    if not isinstance(progress, bool | diffrax.AbstractProgressMeter):
        raise ArgumentTypeError(f"progress must be True, False or a diffrax progress meter, {describe(progress)}")
    meter: Any = diffrax.TextProgressMeter() if progress is True else progress
    return None if isinstance(meter, diffrax.NoProgressMeter) else meter
