"""Positions of a driven mechanism by machine code (native/closing/marching.py), and the number of correct ones."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from udkjax.annotations import NumberLike, NumericArray
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.analysis import Analysis
from udkjax.native.loaded_code import MemberCalls
from udkjax.native.position_operations import March
from udkjax.native.primitive import native_p
from udkjax.native.unsupported import unsupported
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.held import row_size, with_row
from udkjax.scene.mechanism import Mechanism

MOST_KNOTS = 100  # largest number of knots of spline motions: compiling their programs takes 10 ms per knot
DEPENDENT_ROW_TOL = 1e-10  # remainder of a dependent row, relative to its square; a march ends long before


class MarchResult(NamedTuple):
    """Positions at the values of a driver, with two derivatives; the first `trusted` of them are closed and on one smooth curve.

    `side` is the sign of det Psi_q at each value: 1 if Psi_q is not square or the independent rows are unknown, and zero where
    the sign has changed more than once since the value before. `first_side` is the sign at the start. All positions after the
    trusted ones are the last position that was followed, at the value `reached`.
    """

    q: Float[Array, "T n"]
    dq: Float[Array, "T n"]
    ddq: Float[Array, "T n"]
    side: Float[Array, "T"]
    first_side: Float[Array, ""]
    trusted: Int[Array, ""]
    reached: Float[Array, ""]


def can_march(mechanism: Mechanism, analysis: Analysis) -> bool:
    """Return True if machine code can follow positions of the mechanism: it supports all elements, and JAX uses float64."""
    return jax.config.jax_enable_x64 and _is_supported(mechanism, analysis)


@cached_by_identity  # also for traced numbers, on which the answer does not depend
def _is_supported(mechanism: Mechanism, analysis: Analysis) -> bool:
    knots = sum(len(x.times) for (section, *_), x in mechanism.samples.items() if section == "_drivers")
    return knots <= MOST_KNOTS and not unsupported(_operation(mechanism, analysis).code)


def march(
    mechanism: Mechanism, analysis: Analysis, unit: NumberLike, s: NumberLike, q: NumericArray, values: NumericArray
) -> MarchResult:
    """Return the positions at the values, followed from the closed position q at the value s; they have no derivative rules.

    The value of the driver replaces time; `unit` is its unit (`Driven.unit`).
    """
    inputs = _inputs(_numbers(mechanism, analysis), analysis, unit, s, q, values, jnp)
    return _march(native_p.bind(*inputs, operation=_operation(mechanism, analysis), times=1 + np.size(values)), jnp)


def march_at_once(
    mechanism: Mechanism, analysis: Analysis, unit: NumberLike, s: NumberLike, q: NumericArray, values: NumericArray
) -> MarchResult:
    """Return the results of `march` for concrete numbers, as NumPy arrays; JAX traces and compiles nothing."""
    prepared, analysis = _numbers_of_concrete(mechanism, analysis)
    inputs = _inputs(prepared, analysis, unit, s, q, values, np)
    return _march(prepared.calls.of_one(*inputs, times=1 + len(values)), np)


def _by_numpy(x: PyTree) -> PyTree:
    return np.asarray(x) if eqx.is_array(x) else x


def _march(outputs: Sequence, xp: ModuleType) -> MarchResult:
    q, dq, ddq, side = (x[0, 1:] for x in outputs[:4])
    trusted, reached = (x[0, 0] for x in outputs[4:6])
    return MarchResult(q, dq, ddq, side, outputs[3][0, 0], xp.maximum(trusted.astype(int) - 1, 0), reached)


class _Prepared(NamedTuple):
    """The operation of a mechanism, its first input (the numbers of the scene, and two thresholds of pivots), and calls of it."""

    operation: March
    numbers: list[Any]
    calls: MemberCalls


def _numbers(mechanism: Mechanism, analysis: Analysis) -> _Prepared:
    numbers = _of_unit_masses(_without_loads(mechanism), analysis.scales.length).numbers
    operation = _operation(mechanism, analysis)
    return _Prepared(operation, [*numbers, DEPENDENT_ROW_TOL, 0.0], _calls(operation))


@cached_by_identity
def _calls(operation: March) -> MemberCalls:
    return MemberCalls(operation)


@cached_by_identity
def _numbers_of_concrete(mechanism: Mechanism, analysis: Analysis) -> tuple[_Prepared, Analysis]:
    """Return the operation and the numbers of a concrete mechanism, and its analysis with NumPy arrays."""
    analysis, scene, operation = jax.tree.map(_by_numpy, analysis), _without_loads(mechanism), _operation(mechanism, analysis)
    numbers = np.concatenate([np.ravel(x) for x in scene.numbers])
    programs = scene_programs(scene, analysis.redundant_rows or (), in_pieces=False)
    numbers = programs.with_unit_masses(numbers, float(analysis.scales.length))
    return _Prepared(operation, [np.append(numbers, [DEPENDENT_ROW_TOL, 0.0])], _calls(operation)), analysis


def _inputs(
    prepared: _Prepared,
    analysis: Analysis,
    unit: NumberLike,
    s: NumberLike,
    q: NumericArray,
    values: NumericArray,
    xp: ModuleType,
) -> list:
    scales = analysis.scales
    ts, settings = xp.append(s, values), {"length": scales.length, "omega": unit}
    at_rest = xp.zeros(analysis.coordinates)
    return prepared.operation.pack(prepared.numbers, ts, q, at_rest, settings, scales.rows, xp=xp)


def _without_loads(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with all sampled loads replaced by zero: positions do not depend on them."""
    loads = {key: x for key, x in mechanism.samples.items() if key[0] == "_forces"}
    return mechanism.with_samples({key: with_row(x, np.zeros(row_size(x))) for key, x in loads.items()})


def _of_unit_masses(mechanism: Mechanism, length: NumberLike) -> Mechanism:
    """Return the mechanism with bodies of 1 kg and the characteristic length as radius of gyration."""
    bodies = lambda m: [x for b in m.bodies.values() for x in (b.mass, b.inertia)]  # noqa: E731
    unit_mass = jnp.ones_like(length)
    return eqx.tree_at(bodies, mechanism, [unit_mass, length**2] * len(mechanism.body_names))


def _operation(mechanism: Mechanism, analysis: Analysis) -> March:
    return March(scene_programs(_without_loads(mechanism), analysis.redundant_rows or (), in_pieces=False))
