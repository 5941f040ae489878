"""Preparation of a mechanism for runs: its equations, and its machine code or the reason why it has none."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.equations.laws.formulations import Formulation
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.equations.terms.elements import has_pieces
from udkjax.integrate.projection import Projection
from udkjax.integrate.solvers import has_method, is_explicit, method_of
from udkjax.integrate.stabilization import Stabilization, overridden
from udkjax.native.language.program import UnsupportedError
from udkjax.native.operations import Accelerate
from udkjax.native.packing import SampleRows
from udkjax.native.run.method_code import MethodCode
from udkjax.native.runs import RunStates
from udkjax.native.unsupported import unsupported
from udkjax.pinv import Auto, Elimination, Pseudoinverse
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.rolling import rolling_joints

if TYPE_CHECKING:
    import diffrax


@dataclass(frozen=True)
class RunPlan:
    """The static part of a run: it depends on the structure of the mechanism and on the choices, but not on numbers."""

    solver: "diffrax.AbstractSolver | None"  # None: the default
    projected: bool  # whether each step is projected onto the constraints
    operation: RunStates | None  # the machine code that integrates the mechanism
    evaluation: Accelerate | None  # the machine code that evaluates its equations for diffrax; None: `TextbookEquations` in JAX
    why_not_native: str  # the reason why machine code does not integrate; "" if it does
    used_row_count: int = 0  # the number of rows that the method uses
    max_rank: int = 0  # the number of rows not known to be redundant: a larger rank is due to rounding or violated rows
    orders_by_diffrax: float = (
        np.inf
    )  # the highest order of derivatives that are right with diffrax, which does not locate pieces

    @cached_property
    def is_native(self) -> bool:
        """True if machine code integrates the run."""
        return not self.why_not_native

    @property
    def differentiates(self) -> bool:
        """True if machine code computes the derivatives of the run; diffrax computes those with a user-defined stabilization."""
        return self.is_native and self.operation is not None and self.operation.stabilization is None

    @cached_property
    def has_timed_pieces(self) -> bool:
        """True if the smooth piece of an element depends on time, too: machine code then has no second derivatives of a run."""
        code = self.operation.code if self.operation else None
        return code is not None and code.piece_count > 0 and "t" in code.of("pieces").arrays

    @cached_property
    def marks_rows(self) -> bool:
        """True if machine code needs marks of the independent rows of Psi, or weights of all rows, as input."""
        operation = self.operation or self.evaluation
        return operation is not None and operation.code.marks_rows

    @cached_property
    def shares_by_marks(self) -> bool:
        """True if redundant rows share the loads of joints with friction, and are distinguished by their marks."""
        operation = self.operation or self.evaluation
        return operation is not None and operation.code.shares_by_marks

    @cached_property
    def weighs_rows(self) -> bool:
        """True if known redundant rows share the loads of joints with friction: the weights of rows then replace their marks."""
        operation = self.operation or self.evaluation
        return operation is not None and operation.code.weighs_rows


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class CompiledMechanism:
    """A mechanism prepared once for runs with any times, states and tolerances.

    The arrays of the equations and the breakpoints may be traced or batched.
    """

    equations: AbstractSystem
    breakpoints: Float[Array, "k"] | None  # the times where the motion is not smooth, in any order; None: always smooth
    plan: RunPlan = field(metadata={"static": True})

    @property
    def samples(self) -> SampleRows:
        """The sampled numbers of the mechanism as rows, one for each interval between breakpoints."""
        return SampleRows(self.textbook.mechanism, self.breakpoints)

    @cached_property
    def textbook(self) -> Any:
        """The equations of the mechanism or user-defined system itself, without a formulation that may wrap them."""
        return self.equations.textbook


def compile_mechanism(
    system: Any,
    analysis: Analysis | None,
    method: Pseudoinverse,
    stabilization: Projection | Baumgarte | Stabilization | None,
    formulation: Formulation | None = None,
    solver: "diffrax.AbstractSolver | None" = None,
    adjoint: "diffrax.AbstractAdjoint | None" = None,
    meter: "diffrax.AbstractProgressMeter | None" = None,
    engine: str = "auto",
    stepper: Any = None,
) -> CompiledMechanism:
    """Prepare a mechanism, or a user-defined system, for runs.

    The arguments are those of `simulate`; `meter` is the progress meter, and `stepper` the step size controller.

    Raises:
        ValueError: machine code was requested but cannot integrate the system.
    """
    baumgarte = stabilization if isinstance(stabilization, Baumgarte) else None
    equations = equations_of(system, method, baumgarte, formulation, analysis)
    projects = isinstance(stabilization, Projection) or equations.solves_constraints
    projected, breakpoints = equations.constrained and projects, system.breakpoints
    own = stabilization if isinstance(stabilization, Stabilization) else None
    operation, evaluation, rows, max_rank = None, None, 0, 0
    if engine in ("diffrax", "jax"):
        why = "it was asked for"
    else:
        why = _reason_for_diffrax(equations, solver, adjoint, meter, stepper)
        if own is not None and not why:
            why = _reason_for_stabilization(equations, solver, own)
    if not why:
        operation = _run_operation(equations, solver, projected, breakpoints)
        textbook = equations.textbook
        max_rank = len(textbook.scales.rows) - len(textbook.redundant or ())
        rows = max_rank if eliminates(textbook.method) else len(textbook.scales.rows)
        why = _reason_for_programs(operation)
        if own is not None and not why:
            operation, why = _stabilized(operation, own)
    if engine != "jax" and (why or own is not None):
        evaluation = evaluation_of(equations)
    if engine == "native" and why:
        raise ValueError(f'engine="native" cannot: {why}. engine="auto" uses diffrax instead')
    orders = _orders_by_diffrax(system, projected)
    plan = RunPlan(solver, projected, None if why else operation, evaluation, why, rows, max_rank, orders)
    return CompiledMechanism(equations, breakpoints, plan)


def _orders_by_diffrax(system: Any, projected: bool) -> float:
    """Return the highest order of derivatives that diffrax, which steps across the ends of smooth pieces, computes right.

    At the ends of pieces derivatives of the second order jump. With projection, those jumps are right that follow from the
    constraints alone.
    """
    if not _is_piecewise(system):
        return np.inf
    return 2 if projected and not any(map(has_pieces, system.forces.values())) else 1


def _is_piecewise(system: Any) -> bool:
    """Return True if a constraint or a force of a mechanism is only piecewise smooth in the state."""
    return any(map(has_pieces, (*system.constraints.values(), *system.forces.values())))


@cached_by_identity
def compile_concrete(system: Any, *choices: Any) -> CompiledMechanism:
    """Return a compiled system of concrete numbers, whose arrays are NumPy's: with JAX's, each operation would compile a program.

    The `choices` are the arguments of `compile_mechanism` after the system.
    """
    compiled = compile_mechanism(system.without_origin, *choices)
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, compiled)


def _reason_for_diffrax(
    equations: AbstractSystem,
    solver: "diffrax.AbstractSolver | None",
    adjoint: "diffrax.AbstractAdjoint | None",
    meter: "diffrax.AbstractProgressMeter | None",
    stepper: Any,
) -> str:
    """Return the reason why machine code cannot integrate equations of this kind, whatever the scene; "" if it can."""
    if adjoint is not None:
        return f"{type(adjoint).__name__} is an adjoint of diffrax"
    if meter is not None:
        return "a progress meter is diffrax's"
    if stepper is not None:
        return f"{type(stepper).__name__} is a step size controller of diffrax"
    if not has_method(solver):
        return f"{type(solver).__name__} is not a Runge-Kutta method with one tableau, explicit or singly diagonally implicit"
    if equations.solves_constraints and not is_explicit(solver):
        return f"it partitions coordinates with explicit methods only, and {type(solver).__name__} is implicit"
    if equations.solves_constraints and rolling_joints(getattr(equations.textbook, "mechanism", None)):
        return "it does not partition the coordinates of mechanisms with rolling joints"
    return _reason_for_equations(equations)


def _reason_for_stabilization(equations: AbstractSystem, solver: Any, stabilization: Stabilization) -> str:
    """Return the reason why machine code cannot integrate equations with any user-defined stabilization; "" if it can."""
    name = type(stabilization).__name__
    if equations.solves_constraints:
        return f"it partitions coordinates without {name}"
    return "" if is_explicit(solver) else f"it knows {name} with explicit methods only, and {type(solver).__name__} is implicit"


def _stabilized(operation: RunStates, stabilization: Stabilization) -> tuple[RunStates, str]:
    """Return the operation with a user-defined stabilization, and "".

    If the stabilization has no machine code, return the operation unchanged, and the reason."""
    try:
        return operation.stabilized(stabilization, overridden(stabilization)), ""
    except UnsupportedError as unknown:
        return operation, f"it does not know {unknown}"


def _reason_for_equations(equations: AbstractSystem) -> str:
    """Return the reason why machine code cannot evaluate equations of this kind, whatever the scene; "" if it can."""
    plain, formulation = equations.textbook, formulation_of(equations)
    if plain.programs is None and jax.config.jax_enable_x64:
        return f"it does not know {type(plain).__name__}"
    if isinstance(plain, TextbookEquations) and plain.rubs:
        if formulation is not None or not eliminates(plain.method):
            return "it computes friction that depends on the loads of joints by elimination only"
        if plain.redundant is None and isinstance(plain.method, Elimination) and not plain.only_switched:
            return "friction depends on the loads of joints, and rows that Elimination drops share these"
    return reason_for_plain(plain.method, formulation)


def reason_for_plain(method: Pseudoinverse, formulation: Formulation | None = None) -> str:
    """Return the reason why machine code cannot evaluate equations by this method and formulation in any scene; "" if it can."""
    try:
        MethodCode.of(method, formulation)
    except UnsupportedError as unknown:
        return f"it does not know {unknown}"
    if not jax.config.jax_enable_x64:
        return "it computes in float64, which is off in JAX"
    return ""


def _reason_for_programs(operation: RunStates | Accelerate) -> str:
    """Return the reason why the programs of an operation cannot be written as machine code; "" if they can."""
    code, formulation = operation.code, operation.formulation
    if code.excess:
        return code.excess
    if formulation is not None and formulation.needs_diagonal_mass and code.couples:
        return "it does not know a formulation of your own for a mass matrix that is not diagonal"
    missing = unsupported(code)
    return f"{code.owner} uses {missing}, which is not arithmetic on numbers" if missing else ""


def formulation_of(equations: AbstractSystem) -> Formulation | None:
    """Return the formulation by which equations are solved; None for the Udwadia-Kalaba equation."""
    return getattr(equations, "formulation", None)  # a field of the equations that formulations wrap


def eliminates(method: Pseudoinverse) -> bool:
    """Return True if a method solves the equations by elimination, and leaves out redundant rows."""
    return isinstance(method, Auto | Elimination)


def _run_operation(equations: AbstractSystem, solver: Any, projected: bool, breakpoints: Float[Array, "k"] | None) -> RunStates:
    textbook = equations.textbook
    mechanism = textbook.mechanism
    return RunStates(
        code=textbook.programs,
        method=method_of(solver),
        projected=projected,
        breaks=breakpoints is not None or _is_piecewise(mechanism) or textbook.programs.piece_count > 0,
        sampled=SampleRows(mechanism, breakpoints).places(mechanism),
        **_method_code(equations)._asdict(),
        changes=solver is None and not equations.solves_constraints,
    )


def _method_code(equations: AbstractSystem) -> MethodCode:
    """Return the `MethodCode` of the method and the formulation of equations."""
    return MethodCode.of(equations.textbook.method, formulation_of(equations))


def evaluation_of(equations: AbstractSystem) -> Accelerate | None:
    """Return the operation that evaluates equations at single states; None if there is no machine code for them."""
    if not equations.constrained or equations.solves_constraints or _reason_for_equations(equations):
        return None
    inner = equations.textbook
    operation = Accelerate(inner.programs, *_method_code(equations))
    return None if _reason_for_programs(operation) else operation
