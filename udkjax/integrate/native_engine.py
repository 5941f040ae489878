"""Integration by machine code (native/): inputs, outputs and derivatives of problems."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.integrate.compiled_mechanism import CompiledMechanism, eliminates, formulation_of
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.native.loaded_code import call_concrete
from udkjax.native.module.steps import Status
from udkjax.native.operations import MarkRows
from udkjax.native.packing import ActiveNumbers
from udkjax.native.primitive import native_p
from udkjax.native.run.method_code import MethodCode
from udkjax.native.runs import RunStates
from udkjax.pinv import Auto, OneOf
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

# Rank threshold of fallback steps, relative to that of other steps. Only steps near singular configurations use it; if states are
# projected, they start on the constraint manifold. An independent row that is treated as redundant causes errors in velocities as
# large as the threshold; rounding errors are eps over its square. The best threshold is thus eps^(1/3), this share of the usual
# threshold. With one three times larger, more linkages lose energy that no tolerance reduces; one three times smaller gains
# nothing.
FALLBACK_RANK_SHARE = 0.06


def packed(problem: Problem) -> list[np.ndarray]:
    """Return the inputs of the machine code that integrates a problem of concrete numbers, by NumPy, as `run_inputs`."""
    return run_inputs(problem, _operation(problem), np)


def integrate_concrete(problem: Problem) -> IntegratorOutput:
    """Integrate a problem of concrete numbers without tracing anything; the output has NumPy arrays."""
    operation = _operation(problem)
    return integrator_output(call_concrete(operation, run_inputs(problem, operation, np), len(problem.ts)))


def integrate(problem: Problem) -> IntegratorOutput:
    """Integrate one problem; under vmap all problems together, in SIMD lanes."""
    operation = _operation(problem)
    return integrator_output(native_p.bind(*run_inputs(problem, operation), operation=operation, times=len(problem.ts)))


class RecordedRun(NamedTuple):
    """The record of a run from which reverse mode computes its derivatives, backwards from the end."""

    steps: Array  # number of accepted steps (1,)
    record: Array
    states: tuple[Array, ...]  # q and v (T, n) if T > 2, else empty


def integrate_for_vjp(problem: Problem, active: Problem) -> tuple[IntegratorOutput, RecordedRun]:
    """Integrate a problem, and return its output with the record that `vjp` needs; `vjp` calls the same compiled code.

    `active` is a tree like the problem, with True for the numbers whose derivatives are needed.
    """
    operation, n, times = _operation(problem, active, reverse=True), len(problem.q), len(problem.ts)
    empty = (np.zeros(shape) for shape in ((1, 0), (1, 0), (1, 0, n), (1, 0, n), (0, times, 2 * n), (0, 2 * n)))
    results = native_p.bind(*run_inputs(problem, operation), *empty, operation=operation, times=times)
    raw = integrator_output(results[: RunStates.results])
    return raw, RecordedRun(raw.accepted.astype(float)[None], results[-1][0], (raw.q, raw.v) if times > 2 else ())


def serves_derivatives(active: Problem) -> bool:
    """Return True if machine code has all derivatives with respect to numbers that are True in `active`, a tree like a problem.

    It has those with respect to numbers of the scene, gains of Baumgarte's stabilization, and the initial state.
    """
    supported = lambda p: (p.textbook.mechanism, p.textbook.baumgarte, p.q, p.v)  # noqa: E731
    others = eqx.tree_at(supported, active, (None,) * 4, is_leaf=lambda x: x is None)
    return not any(x is True for x in jax.tree.leaves(others))


def _numbers_of(problem: Any, change: Any = None) -> tuple[Any, Any, Any]:
    """Return the mechanism, with a row of zeros for its samples, the gains and the marks of a run; or a change of these."""
    source = problem if change is None else change
    return problem.compiled.samples.stand_in(source.textbook.mechanism), source.textbook.baumgarte, source.marks


def _active_numbers(problem: Any, active: Any) -> ActiveNumbers:
    """Return the numbers of a run with a mask of those that are True in `active`, a tree like the problem."""
    mask = problem.compiled.samples.stand_in(active.textbook.mechanism, marks=True), active.textbook.baumgarte, active.marks
    return ActiveNumbers(_numbers_of(problem), mask)


def jvp(problem: Problem, active: Any, change: Any) -> tuple[IntegratorOutput, tuple[Array, Array, Array]]:
    """Integrate a problem; also return the changes of q, v and the end along a `change` of the active numbers.

    Both `active` and `change` are trees like the problem: with True for active numbers, and with their changes.
    """
    return _integrate_along(problem, [(active, change)], _operation(problem, active))


def second_derivative(problem: Problem, active: Any, *changes: tuple[Any, Any]) -> tuple[Array, Array, Array]:
    """Return the second derivatives of q, v and the end along two `changes`, each a pair (active, change) as in `jvp`."""
    operation = _operation(problem).with_second_tangents(_active_numbers(problem, active).mask)
    return _integrate_along(problem, changes, operation)[1]


def _integrate_along(
    problem: Problem, changes: Sequence[tuple[Any, Any]], operation: RunStates
) -> tuple[IntegratorOutput, tuple[Array, Array, Array]]:
    n, samples, directions = len(problem.q), [], []
    for active, change in changes:
        tangents = _active_numbers(problem, active).tangents(_numbers_of(problem, change))
        directions += [tangents, *(np.zeros(n) if dx is None else dx for dx in (change.q, change.v))]
        samples += [problem.compiled.samples.changes(change.textbook.mechanism)] if operation.sampled else []
    *results, dys, dend = native_p.bind(
        *run_inputs(problem, operation),
        *(x[None, None] for x in (*samples, *directions)),
        operation=operation,
        times=len(problem.ts),
    )
    return integrator_output(results), (dys[0, 0, :, :n], dys[0, 0, :, n:], dend[0, 0])


def vjp(problem: Problem, active: Any, run: RecordedRun, ys: Array, end: Array) -> Problem:
    """Return the cotangents of the `active` numbers, as a tree like the problem, None for all other numbers.

    Args:
        problem: the problem.
        active: a tree like the problem, with True for active numbers.
        run: the record of the run.
        ys: cotangents of the output states (T, 2n).
        end: cotangents of the state at the end (2n,).
    """
    operation = _operation(problem, active, reverse=True)
    states: Any = run.states or [np.zeros((len(problem.ts), len(problem.q)))] * 2
    inputs = [x[None] for x in (run.steps, run.record, *states, ys, end)]
    results = native_p.bind(*run_inputs(problem, operation), *inputs, operation=operation, times=len(problem.ts))
    numbersbar, qbar, vbar = results[RunStates.results : RunStates.results + 3]
    no_cotangents = jax.tree.map(lambda m: None, active, is_leaf=lambda x: x is None)
    mechanism, baumgarte, _ = _active_numbers(problem, active).cotangents(numbersbar[0])
    if operation.sampled:
        mechanism = problem.compiled.samples.with_cotangents(
            mechanism, active.textbook.mechanism, results[RunStates.results + 3][0]
        )
    q, v = qbar[0] if active.q is True else None, vbar[0] if active.v is True else None
    differentiated = lambda p: (p.textbook.mechanism, p.textbook.baumgarte, p.q, p.v)  # noqa: E731
    return eqx.tree_at(differentiated, no_cotangents, (mechanism, baumgarte, q, v), is_leaf=lambda x: x is None)


def _operation(problem: Problem, active: Problem | None = None, reverse: bool = False) -> RunStates:
    """Return the machine code of a run, with tangents, or with cotangents if `reverse`, unless `active` is None."""
    run = problem.compiled.plan.operation
    assert run is not None  # checked by the caller
    if active is None:
        return run
    mask = _active_numbers(problem, active).mask
    if not reverse:
        return run.with_tangents(mask)
    breaks = problem.compiled.breakpoints
    return run.with_cotangents(mask, 0 if breaks is None else len(breaks), problem.points)


def run_inputs(problem: Problem, operation: RunStates, xp: ModuleType = jnp) -> list[Any]:
    """Return the inputs of an operation for the run of a problem, each with a leading axis for its one member."""
    compiled = problem.compiled
    scene = _concrete_inputs_of_run(compiled) if xp is np else _inputs_of_run(compiled, operation.code.policy)
    settings = scene.settings | {
        "rtol": problem.rtol,
        "atol": problem.atol,
        "smallest": problem.smallest,
        "first": 0.0 if problem.h is None else problem.h,
        "length": 1.0 if problem.length is None else problem.length,
        "omega": problem.rate,
        "max_steps": problem.max_steps,
        "drift_tol": problem.drift_tol,
        "max_rank": xp.where(xp.isinf(problem.drift_tol), np.inf, float(compiled.plan.max_rank)),
        "open_tol": xp.maximum(problem.drift_tol, scene.thresholds[1]),
    }
    if operation.stabilization is not None:
        settings |= operation.stabilization.settings_of(problem.stabilization, compiled.textbook.scales.rank_tol)
    numbers = [*scene.numbers, *([] if problem.marks is None else [problem.marks]), *scene.thresholds]
    return operation.pack(numbers, problem.ts, problem.q, problem.v, settings, scene.rows, scene.breaks, xp, scene.samples)


class SceneInputs(NamedTuple):
    """The inputs of machine code that follow from the equations of a mechanism alone, not from times and states."""

    numbers: list[Any]  # all numbers of the scene, and the gains
    thresholds: list[Any]  # two thresholds of pivots
    rows: Any  # the scales of the rows of Psi
    settings: dict[str, Any]  # the unit of length, and the arguments of the method and the formulation
    breaks: Any = ()  # times (s) where the motion is not smooth, in increasing order
    samples: tuple[Any, ...] = ()  # the rows of sampled quantities, if any


def scene_inputs(equations: AbstractSystem, mechanism: Mechanism, policy: RankPolicy, xp: ModuleType = jnp) -> SceneInputs:
    """Return the inputs of machine code that follow from equations.

    Args:
        equations: the equations.
        mechanism: the mechanism whose numbers are the inputs. Instead of samples it has one row for each sampled quantity, of
            zeros (`stand_in`) or of the values at a time (`Mechanism.at`).
        policy: the policy for rows of deficient rank, from which the first of the two pivot thresholds follows.
        xp: jax.numpy, or NumPy if all numbers are concrete.
    """
    textbook = equations.textbook
    method: Any = textbook.method
    rank_tol = method.rank_tol
    # Derivatives of all methods are computed by elimination, whose thresholds are relative.
    relative_tol = rank_tol if method.relative else textbook.scales.rank_tol
    safe_tol = method.branch_tol if isinstance(method, Auto) else relative_tol**2
    fallback_tol = FALLBACK_RANK_SHARE * rank_tol if eliminates(method) else rank_tol
    drop_tol = fallback_tol**2 if policy is RankPolicy.FALL_BACK else safe_tol
    method_index = xp.clip(method.number, 0, len(method.methods) - 1) if isinstance(method, OneOf) else 0.0
    settings = {"length": textbook.scales.length, "fallback_tol": fallback_tol, "method": method_index}
    formulation = formulation_of(equations)
    if formulation is not None:
        settings |= MethodCode.formulation_settings(formulation, textbook.scales)
    numbers = jax.tree.leaves((mechanism, textbook.baumgarte))
    return SceneInputs(numbers, [drop_tol, safe_tol], textbook.scales.rows, settings)


def _inputs_of_run(compiled: CompiledMechanism, policy: RankPolicy, xp: ModuleType = jnp) -> SceneInputs:
    samples = compiled.samples
    inputs = scene_inputs(compiled.equations, samples.stand_in(compiled.textbook.mechanism), policy, xp)
    return inputs._replace(breaks=samples.breakpoints(xp), samples=(samples.rows(xp),) if samples.samples else ())


@cached_by_identity
def _concrete_inputs_of_run(compiled: CompiledMechanism) -> SceneInputs:
    """Return the inputs of runs of a mechanism of concrete numbers, which are joined in one vector."""
    assert compiled.plan.operation is not None  # checked by the caller
    inputs = _inputs_of_run(compiled, compiled.plan.operation.code.policy, np)
    return inputs._replace(numbers=[numbers_as_vector(inputs.numbers)])


def mark_rows(
    compiled: CompiledMechanism,
    t: Any,
    q: Any,
    v: Any,
    length: Any,
    rate: Any,
    xp: ModuleType = jnp,
    among: Any = None,
    on: Any = None,
) -> Any:
    """Return a mark for each row of Psi: 1 if it is independent near a state, else 0. None if machine code needs no marks.

    If redundant rows share the loads of joints with friction, and marks distinguish them (`RunPlan.shares_by_marks`), a redundant
    row that holds has the mark -1. If the redundant rows are known (`RunPlan.weighs_rows`), the weights of all rows are returned
    instead of marks.

    Args:
        compiled: The mechanism.
        t: Time (s).
        q: Positions (n,).
        v: Velocities (n,).
        length: The unit of length; None: one.
        rate: The characteristic rate (1/s).
        xp: jax.numpy, or NumPy if all numbers are concrete.
        among: Mask of the rows that may be independent, by default all.
        on: Mask of the rows that hold, by default all.
    """
    if not compiled.plan.marks_rows:
        return None
    equations = compiled.textbook
    if compiled.plan.weighs_rows:
        return equations.scales.weights
    mechanism = equations.mechanism.at(t)
    operation = MarkRows(equations.programs_of_rows if among is None else equations.programs_of_marked_rows)
    tol = equations.scales.rank_tol
    settings = {"length": 1.0 if length is None else length, "omega": rate}
    numbers = [*mechanism.numbers, *([] if among is None else [xp.asarray(among, float)]), tol**2, 0.0]
    inputs = operation.pack(numbers, xp.stack([t, t]), q, v, settings, equations.scales.rows, xp=xp)
    results = call_concrete(operation, inputs, 2) if xp is np else native_p.bind(*inputs, operation=operation, times=2)
    marks = results[0][0] if among is None else results[0][0] * among
    if not compiled.plan.shares_by_marks:
        return marks
    return xp.where(marks > 0, 1.0, -1.0) * (1.0 if on is None else on)


def integrator_output(results: Sequence[Any]) -> IntegratorOutput:
    """Return the output of a run of one member from the results of its operation."""
    q, v, _, info = [x[0] for x in results]
    code, t, tried, accepted, evaluations, written, first_drifted, implicit = [info[k] for k in range(len(RunStates.info_names))]
    number = np.arange(len(q))
    reached = (number <= written) & (number < len(q) - 1) | (code == Status.DONE)
    counts = [x.astype(int) for x in (tried, accepted, evaluations, implicit)]
    return IntegratorOutput(q, v, reached, first_drifted, code.astype(int), t, info[len(RunStates.info_names) :], *counts)
