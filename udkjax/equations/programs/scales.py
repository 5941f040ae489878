"""The characteristic length, rate and mass of a mechanism: the units of all thresholds.

analysis.py defines them. One program (scale_program.py) computes them: NumPy runs it if all numbers are concrete, machine code in
a trace, and JAX on other devices.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import AnyArray
from udkjax.arrays import ArrayLibrary, float_type, library_for, number, put_arrays
from udkjax.equations.programs.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.terms.scale_program import ARM, LENGTH, MASS, RATE, ROWS, THRESHOLD
from udkjax.equations.terms.structure import concrete_numbers, join_concrete_numbers, numbers_as_vector
from udkjax.expressions.loops.array_loops import ArrayLoops
from udkjax.printing import prints_table, units
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.programs.numpy_program import evaluate_as
from udkjax.programs.varying_axes import result_type
from udkjax.scene.mechanism import Mechanism

NO_THRESHOLDS = 0.0, 0.0  # thresholds of pivots, inputs of the prologue after the scene's numbers


@prints_table
class Scales(NamedTuple):
    """The units of lengths, rates, masses and rows of Psi, and the rank threshold of D; arrays without derivatives.

    `rank_tol` is `RANK_TOL`, or less for large mass ratios. If a light body carries a heavy one, the singular values of
    D = Psi_q M^(-1/2) differ by the root of the mass ratio in any position: a ratio of 1e8 lowers the singular value of a
    constraint between them to 1e-4 of the largest. The same holds for a body with small inertia, such as a point mass at the end
    of a rod: its effective mass in a row with an arm r is 1 / (1 / m + r^2 / I).
    """

    length: Float[Array, ""]  # the characteristic length (m)
    arm: Float[Array, ""]  # the longest lever arm of a constraint (m); `length` if there is none
    rate: Float[Array, ""]  # one over the characteristic time (1/s); 0 without velocities and loads
    mass: Float[Array, ""]  # the characteristic mass (kg); NaN if any number of the mechanism is not finite
    rows: Float[Array, "m"]  # the scale of each row, in the unit of the row
    rank_tol: Float[Array, ""]  # rank tolerance of the weighted D, relative to its largest singular value

    _units = units(length="m", arm="m", rate="1/s", mass="kg")

    @property
    def weights(self) -> Float[Array, "m"]:
        """The weights that make the rows of D comparable, for a single rank tolerance: L divided by the scale of each row."""
        if isinstance(self.rows, np.ndarray) or library_for(self) is jnp:
            return self.length / self.rows
        return number(np.asarray(self.length) / np.asarray(self.rows))

    def coordinates(self, n: int) -> Any:
        """Return the units of coordinates (n,): L, L and one radian for each body."""
        if isinstance(self.length, np.ndarray):
            return np.tile([float(self.length), float(self.length), 1.0], n // 3)
        if library_for(self.length) is np:
            return number(np.tile([float(self.length), float(self.length), 1.0], n // 3))
        return jnp.tile(jnp.stack([self.length, self.length, jnp.ones_like(self.length)]), n // 3)

    def size(self, q: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
        """Return the largest component of a change of coordinates (n,): lengths divided by L, angles in rad."""
        x = xp.abs(q.reshape(-1, 3))
        return xp.maximum(x[:, :2].max(initial=0.0) / self.length, x[:, 2].max(initial=0.0))

    def violation(self, psi: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
        """Return the largest component of a violation (m,) of Psi, each row divided by its scale."""
        return xp.max(xp.abs(psi) / self.rows, initial=0.0)


class UnitScales(Scales):
    """The scales of a system whose coordinates are all of order one."""

    def coordinates(self, n: int) -> Float[Array, "n"]:
        """Return the units of coordinates (n,), all of which are one."""
        return number(np.ones(n))

    def size(self, q: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
        """Return the largest component of a change of coordinates (n,)."""
        return xp.max(xp.abs(q), initial=0.0)


@cached_by_identity
def concrete_scales(mechanism: Mechanism) -> Scales:
    """Return the scales of a mechanism with concrete numbers, by NumPy."""
    numbers = np.append(concrete_numbers(mechanism), NO_THRESHOLDS)
    found = _unpack(_evaluate(scene_programs(mechanism), numbers, np))
    with jax.ensure_compile_time_eval():  # concrete even while something else is traced
        return put_arrays(jax.tree.map(lambda x: np.asarray(x, float_type()), found))


def traced_scales(mechanism: Mechanism) -> Scales:
    """Return the scales of a mechanism with traced numbers, without derivatives."""
    numbers = join_concrete_numbers([*mechanism.at(0.0).numbers, *NO_THRESHOLDS])
    return _traced_scales(jax.lax.stop_gradient(numbers), scene_programs(mechanism))


@deferred
def _traced_scales(numbers: list[ArrayLike], programs: ScenePrograms) -> Scales:
    return _unpack(scales_p.bind(numbers_as_vector(numbers), programs=programs))


def _unpack(values: Any) -> Scales:
    return Scales(values[LENGTH], values[ARM], values[RATE], values[MASS], values[ROWS:], values[THRESHOLD])


def _evaluate(programs: ScenePrograms, numbers: AnyArray, xp: ArrayLibrary) -> AnyArray:
    """Return the array `scales` of a scene with the given numbers."""
    arrays = {name: xp.zeros(size) for name, size in (programs.scratch | programs.scales.sizes).items()}
    with np.errstate(all="ignore"):  # non-finite numbers are checked later
        return _loops(programs, xp)(arrays | {"numbers": numbers})["scales"]


@cached_by_identity
def _loops(programs: ScenePrograms, xp: ArrayLibrary) -> ArrayLoops:
    return ArrayLoops(programs.scales.program, xp, ("scales",))


# --- the scales as one JAX operation on vectors of numbers (..., numbers), which native lowers to machine code


class ScalesPrimitive(Primitive):
    """The operation that computes the array `scales` (scale_program.py) for vectors of numbers (..., numbers)."""

    def by_numpy(self, numbers: np.ndarray, programs: ScenePrograms) -> np.ndarray:
        """Return the array `scales` for each vector of `numbers`, by NumPy."""
        results = [_evaluate(programs, x, np) for x in numbers.reshape(-1, numbers.shape[-1])]
        return np.array(results, numbers.dtype).reshape(*numbers.shape[:-1], -1)

    def by_jax(self, numbers: Array, programs: ScenePrograms) -> Array:
        """Return the array `scales` for each vector of `numbers`, by JAX."""
        return jnp.vectorize(lambda x: _evaluate(programs, x, jnp), signature="(n)->(m)")(numbers)


def _batch(inputs: Any, axes: Any, programs: ScenePrograms) -> tuple[Any, int]:
    return scales_p.bind(jnp.moveaxis(inputs[0], axes[0], 0), programs=programs), 0


scales_p = ScalesPrimitive("scales")
scales_p.def_impl(lambda numbers, programs: jax.device_put(scales_p.by_numpy(np.asarray(numbers), programs)))
scales_p.def_abstract_eval(
    lambda numbers, programs: result_type((*numbers.shape[:-1], programs.scale_count), [numbers], numbers.dtype)
)
batching.primitive_batchers[scales_p] = _batch
mlir.register_lowering(scales_p, mlir.lower_fun(scales_p.by_jax, multiple_results=False))
evaluate_as(scales_p, scales_p.by_numpy)
