"""A function of scalars as one fusion of XLA: what it computes on the way stays in the processor's registers.

By itself XLA fuses each result with a copy of all that it is made of, or, where barriers forbid that, writes every number between
them to a place of its own, whose address it looks up first. A single run waits for that: as fusions its programs have two thirds
of the instructions, and a step takes three quarters of the time.

XLA takes a fusion that it has not made itself where it compiles a whole loop into one function on the CPU, and ends the process
anywhere else. So a fusion is asked for together with the `Loop` that it is in. Batches, derivatives, other devices and versions
of JAX that were not tried take the function as it is, with its barriers.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters.mlir import ir

from udkjax.straightline.barrier import cut, cut_p
from udkjax.straightline.trigonometry import sincos_of_one, sincos_p

KNOWN = ((0, 12),)  # versions of JAX that were tried
FLAGS = ("while_loop_byte_threshold", "disable_hlo_passes", "optimization_level")  # with one of them loops may be taken apart
LARGEST = 4000  # operations: none with more was tried; with 3,600 (ten four-bars) compiling takes a thirtieth longer, a run 0.7
# Operations of which XLA makes arithmetic, each by itself; others may call functions of a library.
SIMPLE = frozenset(
    """abs add and ceil clamp convert_element_type copy cos div eq exp expm1 floor ge gt integer_pow le log log1p lt max min mul
    ne neg not or pow rsqrt select_n sign sin sqrt square stop_gradient sub tan tanh""".split()
)


class Loop:
    """A loop that XLA compiles into one function, unless something in it turns out to forbid that before it is compiled.

    XLA must not know how often it goes round, or may write the rounds one after the other instead.
    """

    def __init__(self) -> None:
        self.whole = True


def together(function: Callable[..., list[Any]], examples: Sequence[Any]) -> Callable[..., list[Any]]:
    """`function(*numbers)`, traced for numbers like `examples`, to be called with the loop that it is in first."""
    jaxpr = jax.make_jaxpr(function)(*examples)
    parts = Parts(jaxpr)

    def call(loop: Loop, *xs: Any) -> list[Any]:
        loop.whole &= parts.simple  # what else there is may keep XLA from making one function of the loop
        return together_p.bind(*xs, parts=parts, loop=loop)

    return call


class Parts:
    """What a function of scalars computes, and what it only hands on."""

    def __init__(self, jaxpr: Any):
        self.whole, inner = jaxpr_as_fun(jaxpr), jaxpr.jaxpr
        self.given, self.results, self.operations, self.avals = inner.invars, inner.outvars, inner.eqns, jaxpr.out_avals
        made = {x for eqn in inner.eqns for x in eqn.outvars}
        taken = dict.fromkeys(x for eqn in inner.eqns for x in eqn.invars if not isinstance(x, Literal))
        self.takes = [x for x in taken if x not in made]
        self.gives = [x for x in dict.fromkeys(x for x in inner.outvars if not isinstance(x, Literal)) if x in made]
        names = {eqn.primitive.name for eqn in inner.eqns}
        scalar = not any(x.aval.shape for eqn in inner.eqns for x in [*eqn.invars, *eqn.outvars])
        self.simple = names <= SIMPLE | {cut_p.name, sincos_p.name} and scalar and not inner.constvars
        self.is_one_fusion = bool(self.gives) and self.simple and len(inner.eqns) <= LARGEST

    def inside(self, *xs: Any) -> list[Any]:
        """What it computes, without barriers, and sine and cosine of one angle at a time."""
        known = dict(zip(self.takes, xs, strict=True))
        for eqn in self.operations:
            values = [x.val if isinstance(x, Literal) else known[x] for x in eqn.invars]
            if eqn.primitive is cut_p:
                found = values
            elif eqn.primitive is sincos_p:
                found = [y for x in values for y in sincos_of_one(x)]
            else:
                found = eqn.primitive.bind(*values, **eqn.params)
            known.update(zip(eqn.outvars, found if eqn.primitive.multiple_results else [found], strict=True))
        return [known[x] for x in self.gives]

    def around(self, *xs: Any) -> list[Any]:
        """All results, of the arguments and of what `inside` computes, as a fusion, to which XLA must add nothing of its own."""
        known = dict(zip(self.given, xs, strict=True))
        known.update(zip(self.gives, fusion_p.bind(*cut([known[x] for x in self.takes]), parts=self), strict=True))
        return [x.val if isinstance(x, Literal) else known[x] for x in self.results]


def _batched(xs: Sequence[Any], axes: Sequence[int | None], parts: Parts, loop: Loop) -> tuple[list[Any], list[int]]:
    found = jax.vmap(parts.whole, in_axes=tuple(axes))(*xs)
    return found, [0] * len(found)


def _derivative(primals: Sequence[Any], tangents: Sequence[Any], parts: Parts, loop: Loop) -> tuple[list[Any], list[Any]]:
    return differentiated(parts.whole, primals, tangents)


def differentiated(whole: Callable[..., Any], primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """What a primitive and its derivative return, where it computes what `whole` does."""
    moving = [not isinstance(dx, ad.Zero) for dx in tangents]

    def function(*some: Any) -> list[Any]:
        rest = iter(some)
        return whole(*[next(rest) if m else x for x, m in zip(primals, moving, strict=True)])

    some, changes = ([x for x, m in zip(xs, moving, strict=True) if m] for xs in (primals, tangents))
    found, slopes = jax.jvp(function, some, changes)
    none = [dx.dtype == jax.dtypes.float0 for dx in slopes]
    return found, [ad.Zero(jax.typeof(x).to_tangent_aval()) if n else dx for x, dx, n in zip(found, slopes, none, strict=True)]


together_p = Primitive("together")
together_p.multiple_results = True
together_p.def_impl(lambda *xs, parts, loop: parts.whole(*xs))
together_p.def_abstract_eval(lambda *xs, parts, loop: parts.avals)
batching.primitive_batchers[together_p] = _batched
ad.primitive_jvps[together_p] = _derivative


def _lowered(ctx: mlir.LoweringRuleContext, *values: Any, parts: Parts, loop: Loop) -> Any:
    return mlir.lower_fun(parts.whole)(ctx, *values)


def _lowered_on_cpu(ctx: mlir.LoweringRuleContext, *values: Any, parts: Parts, loop: Loop) -> Any:
    flagged = any(flag in os.environ.get("XLA_FLAGS", "") for flag in FLAGS) or jax.config.read("jax_disable_most_optimizations")
    exported = ctx.module_context.lowering_parameters.for_export
    known = jax.__version_info__[:2] in KNOWN
    fused = known and loop.whole and parts.is_one_fusion and not flagged and not exported
    return mlir.lower_fun(parts.around if fused else parts.whole)(ctx, *values)


mlir.register_lowering(together_p, _lowered)
mlir.register_lowering(together_p, _lowered_on_cpu, platform="cpu")

# An operation of XLA's own dialect. XLA lays arrays out later, but not those in a fusion that it finds: there are scalars, which
# need no layout where a loop is one function, and no result is one of the arguments, which have got one.
fusion_p = Primitive("fusion")
fusion_p.multiple_results = True
fusion_p.def_abstract_eval(lambda *xs, parts: [x.aval for x in parts.gives])


def _fused(ctx: mlir.LoweringRuleContext, *values: Any, parts: Parts) -> Any:
    from jaxlib.mlir.dialects import mhlo

    types = [ir.RankedTensorType.get(x.shape, mlir.dtype_to_ir_type(np.dtype(x.dtype))) for x in ctx.avals_out]
    fusion = mhlo.FusionOp(types, values, fusion_kind=ir.Attribute.parse("#mhlo<fusion_kind kLoop>"))
    block = fusion.regions[0].blocks.append(*[x.type for x in values])
    with ir.InsertionPoint(block):
        found = mlir.lower_fun(parts.inside)(ctx, *block.arguments)
        mhlo.ReturnOp([y for x in found for y in (x if isinstance(x, list | tuple) else [x])])
    return list(fusion.results)


mlir.register_lowering(fusion_p, _fused, platform="cpu")
