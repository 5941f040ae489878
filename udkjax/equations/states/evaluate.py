"""Quantities of the equations of motion at a state: the public functions of `udkjax.equations`.

If all numbers are concrete, NumPy computes a quantity on the scene's programs (state_arrays.py). With traced numbers each
quantity is compiled as one program: without compilation, JAX would dispatch dozens of operations one by one. Inside the package,
larger programs call the uncompiled functions.
"""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import Annotated, Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import NumberLike, Time, Vector
from udkjax.argument_types import COORDINATES_OF_BODIES
from udkjax.equations.rows import determinacy
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.states.state_arrays import StateArrays, by_numpy, state_arrays
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.equations.terms import constraints, loads
from udkjax.equations.terms.constraints import BodyArray
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(function: Callable[Arguments, Result], numeric: Callable[..., Any] | None = None) -> Callable[Arguments, Result]:
    """Return a compiled version of a function of a mechanism and of numbers, for all mechanisms of the same structure.

    It can be transformed like the function itself. An `analysis` argument is computed before the numbers are traced.

    Args:
        function: Its first argument is the `mechanism`; all others except `analysis` are numbers or arrays.
        numeric: The same function of `StateArrays` and the other arguments by name, for concrete numbers: t (1,), q and v
            (1, n), `rank_tol` a float.

    Returns:
        A function with the same arguments and the same result.
    """
    program, parameters = deferred(defined(function)), signature(function)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        bound = parameters.bind(*args, **kwargs)
        arguments = bound.arguments
        mechanism: Mechanism = arguments["mechanism"]
        if "analysis" in parameters.parameters and arguments.get("analysis") is None:
            arguments["analysis"] = analyse(mechanism)
        arguments["mechanism"] = mechanism.without_origin
        if numeric is not None and by_numpy(mechanism, list(arguments.values())):
            bound.apply_defaults()
            given = {name: _for_numpy(name, value) for name, value in bound.arguments.items() if name != "mechanism"}
            return jax.device_put(numeric(state_arrays(mechanism.without_origin), **given))
        for name, value in arguments.items():
            if name not in ("mechanism", "analysis"):
                arguments[name] = jnp.asarray(value, jnp.result_type(float))  # Python numbers would be static
        return program(*bound.args, **bound.kwargs)

    return checked(run)


def _for_numpy(name: str, value: Any) -> Any:
    if isinstance(value, Analysis):
        return value
    return np.asarray(value, float).reshape((1, -1) if name in ("q", "v") else (1,))


def _uniqueness(s: StateArrays, t: Any, q: Any, analysis: Analysis, rank_tol: Any) -> determinacy.Uniqueness:
    N, rank = s.left_null_space(t, q, analysis, float(rank_tol[0]))
    share = np.linalg.norm(N[0], axis=1)
    return determinacy.Uniqueness(share <= determinacy.UNIQUE_TOL, share, rank[0])


psi = compiled(constraints.psi, lambda s, t, q: s.psi(t, q)[0])
psi_q = compiled(constraints.psi_q, lambda s, t, q: s.jacobian(t, q)[0])
psi_dot = compiled(constraints.psi_dot, lambda s, t, q, v: s.psi_dot(t, q, v)[0])
gamma = compiled(constraints.gamma)
force = compiled(loads.force, lambda s, t, q, v: s.force(t, q, v)[0])
mass = compiled(loads.mass, lambda s: s.mass)
kinetic_energy = compiled(loads.kinetic_energy, lambda s, v: 0.5 * np.sum(s.mass * v**2))
potential_energy = compiled(loads.potential_energy, lambda s, t, q, v: s.energy(t, q, v)[0, 1])
_singular_values = compiled(determinacy.singular_values, lambda s, t, q, analysis: s.singular_values(t, q, analysis)[0])


@checked
def singular_values(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike,
    q: BodyArray,
    analysis: Analysis | None = None,
    v: Annotated[Float[ArrayLike, "n"], COORDINATES_OF_BODIES] | None = None,
) -> Float[Array, "k"]:
    """Return the singular values of the scaled Jacobian J = diag(1 / rows) Psi_q diag(L, L, 1, ...), largest first.

    Derivatives take L and the sizes of the rows, which are those of `analysis`, as constants.

    Args:
        mechanism: The mechanism, or a `ConstrainedSystem`, whose J is (Psi_q; phi_v).
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        analysis: The mechanism's `Analysis`, for its scales; by default computed here.
        v: Velocities (n,) of a `ConstrainedSystem`, on which phi_v may depend; by default zero.

    Returns:
        min(m, n) singular values, dimensionless.
    """
    if isinstance(mechanism, Mechanism):
        return _singular_values(mechanism, t, q, analysis)
    t, q = (jnp.asarray(x, jnp.result_type(float)) for x in (t, q))
    return _values_of_rows(mechanism.traced(q.size), t, q, jnp.zeros_like(q) if v is None else jnp.asarray(v, q.dtype))


@deferred
def _values_of_rows(model: Any, t: Time, q: Vector, v: Vector) -> Float[Array, "k"]:
    equations: Any = equations_of(model)
    return jnp.linalg.svd(equations.jacobian(t, q, v), compute_uv=False)


uniqueness = compiled(determinacy.uniqueness, _uniqueness)
