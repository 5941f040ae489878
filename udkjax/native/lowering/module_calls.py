"""Calls of a module's functions from functions of a user that are lowered: a primitive of JAX, and its rule.

Arguments and results are arrays at fixed places in the memory of the module.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend import core
from jaxtyping import Array as JaxArray

from udkjax.native.language.ir import DOUBLE
from udkjax.native.lowering.arrays import Array, Stored
from udkjax.native.lowering.lowering import Lowering
from udkjax.native.lowering.varying import parts_of, without_constants


class ModuleCall(NamedTuple):
    """A call of functions of a module, one after another.

    All functions but the last are preparations, which depend on the `first` arguments alone: if the call before had the same
    preparations and the same first arguments, they are left out (`simplified`).
    """

    functions: tuple[str, ...]
    arguments: tuple[str, ...]  # names of their places
    results: tuple[tuple[str, tuple[int, ...]], ...]  # names of their places, and shapes
    first: int = 0

    def __call__(self, *arguments: Any) -> list[JaxArray]:
        """Return the results as traced arrays; this is called in functions that JAX traces."""
        return call_p.bind(*(jnp.asarray(x, float) for x in arguments), call=self)


call_p = core.Primitive("a function of the module")
call_p.multiple_results = True
call_p.def_abstract_eval(lambda *_, call: [ShapedArray(shape, jnp.dtype(float)) for _, shape in call.results])


def module_call(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Lower a call: store the arguments at their places, call the functions, and return copies of the results."""
    f, call = to.f, equation.params["call"]

    def place(name: str, shape: Sequence[int]) -> Stored:
        return Stored(f.given[name], shape, DOUBLE, True)

    for name, x in zip(call.arguments, inputs, strict=True):
        to.fill(place(name, x.shape), x)
    for function in call.functions:
        f.call(function, f.given["work"])
    return [to.copied(place(name, shape)) for name, shape in call.results]


def simplified(closed: Any) -> Any:
    """Return a jaxpr without repeated calls of a module, without unused equations, and without repeated preparations of calls."""
    jaxpr, same, known, equations = closed.jaxpr, {}, {}, []
    for e in jaxpr.eqns:
        e = e.replace(invars=[a if isinstance(a, core.Literal) else same.get(a, a) for a in e.invars])
        if e.primitive is call_p:
            key = e.params["call"], tuple(map(id, e.invars))
            if key in known:
                same.update(zip(e.outvars, known[key], strict=True))
                continue
            known[key] = e.outvars
        equations.append(e)
    outvars = [a if isinstance(a, core.Literal) else same.get(a, a) for a in jaxpr.outvars]
    used, kept = {id(a) for a in outvars}, []
    for e in reversed(equations):
        if any(id(a) in used for a in e.outvars):
            used.update(map(id, e.invars))
            kept.append(e)
    return closed.replace(jaxpr=jaxpr.replace(eqns=_prepared_once(kept[::-1]), outvars=outvars))


def _prepared_once(equations: Sequence[Any]) -> list[Any]:
    """Return equations in which no call of a module repeats the preparations of the call before it.

    No equation may be removed afterwards: a later call may need its preparations.
    """
    found, prepared = [], None
    for e in equations:
        if e.primitive is call_p and len((call := e.params["call"]).functions) > 1:
            now = call.functions[:-1], tuple(map(id, e.invars[: call.first]))
            if now == prepared:
                e = e.replace(params={"call": call._replace(functions=call.functions[-1:])})
            prepared = now
        elif _has_calls(e):
            prepared = None
        found.append(e)
    return found


def _has_calls(equation: Any) -> bool:
    """Return whether the jaxprs within an equation, of loops and branches, call functions of a module."""
    inner = (e for part in parts_of(equation) for e in without_constants(part).eqns)
    return any(e.primitive is call_p or _has_calls(e) for e in inner)
