"""Quantities of the equations of motion at a state, each compiled as one program: the public functions of `udkjax.equations`.

Without compilation, JAX would dispatch dozens of operations one by one. Inside the package, larger programs call the uncompiled
functions.
"""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import NumberLike
from udkjax.equations import constraints, determinacy, loads
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.constraints import BodyArray
from udkjax.equations.general import ConstrainedSystem, singular_values_of_rows
from udkjax.programs.deferred import deferred
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function of a mechanism and of numbers, once for all mechanisms of the same structure.

    The result can be transformed like the function itself. An `analysis` argument is computed before the numbers are traced.

    Args:
        function: Its first argument is the `mechanism`; all others except `analysis` are numbers or arrays.

    Returns:
        A function with the same arguments and the same result.
    """
    program, parameters = deferred(function), signature(function)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        bound = parameters.bind(*args, **kwargs)
        arguments = bound.arguments
        mechanism: Mechanism = arguments["mechanism"]
        if "analysis" in parameters.parameters and arguments.get("analysis") is None:
            arguments["analysis"] = analyse(mechanism)
        for name, value in arguments.items():
            if not isinstance(value, Mechanism | Analysis):
                arguments[name] = jnp.asarray(value, jnp.result_type(float))  # Python numbers would be static
        arguments["mechanism"] = mechanism.without_origin
        return program(*bound.args, **bound.kwargs)

    return checked(run)


psi = compiled(constraints.psi)
psi_q = compiled(constraints.psi_q)
psi_dot = compiled(constraints.psi_dot)
gamma = compiled(constraints.gamma)
force = compiled(loads.force)
mass = compiled(loads.mass)
kinetic_energy = compiled(loads.kinetic_energy)
potential_energy = compiled(loads.potential_energy)
_singular_values = compiled(determinacy.singular_values)


@checked
def singular_values(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike,
    q: BodyArray,
    analysis: Analysis | None = None,
    v: Float[ArrayLike, "n"] | None = None,
) -> Float[Array, "k"]:
    """Return the singular values of the scaled Jacobian J = diag(1 / rows) Psi_q diag(L, L, 1, ...), largest first.

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
    return singular_values_of_rows(mechanism.traced(q.size), t, q, jnp.zeros_like(q) if v is None else jnp.asarray(v, q.dtype))


uniqueness = compiled(determinacy.uniqueness)
