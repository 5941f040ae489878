"""A function of numbers as one fusion of XLA: what it computes on the way stays in the processor's registers.

By itself XLA fuses each result with a copy of all that it is made of, or, where barriers forbid that, writes every number between
them to a place of its own, whose address it looks up first. A single run waits for that: as fusions its programs have two thirds
of the instructions, and a step takes three quarters of the time. In a batch it is one loop along the members: it compiles in a
quarter of the time, and takes half of it.

XLA takes a fusion that it has not made itself where it compiles a whole loop into one function on the CPU, and ends the process
anywhere else. So a fusion is asked for together with the `Loop` that it is in. Batches of batches, derivatives, other devices and
versions of JAX that were not tried take the function as it is, with its barriers.
"""

import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters.mlir import ir

from udkjax.straightline.barrier import cut, cut_p
from udkjax.straightline.trigonometry import sincos_of_one, sincos_p

KNOWN = ((0, 12),)  # versions of JAX that were tried
FLAGS = ("while_loop_byte_threshold", "disable_hlo_passes", "optimization_level")  # with one of them loops may be taken apart
# Without the first, loops along many arrays are worked off number by number; without the second, large reductions in a loop keep
# XLA from making one function of it.
NEEDED = ("vectorize-memory-check-threshold", "xla_cpu_experimental_ynn_fusion_type=-reduce")
LARGEST = 10_000  # operations: twenty four-bars have 7,000, and take half of the time as one; what is larger goes by levels
# A fusion of a batch first looks, for each two arrays of which one is a result, whether they overlap: in 1.4 ns. An operation on
# 64 members takes 4 ns by itself, and 1.3 in a fusion. So many such looks for an operation are worth it.
CHECKS = 2.0
# Operations of which XLA makes arithmetic, each by itself; others may call functions of a library.
SIMPLE = frozenset(
    """abs add and ceil clamp convert_element_type copy cos div eq exp expm1 floor ge gt integer_pow le log log1p lt max min mul
    ne neg not or pow rsqrt select_n sign sin sqrt square stop_gradient sub tan tanh""".split()
)


class Loop:
    """A loop that XLA compiles into one function, unless something in it turns out to forbid that before it is compiled.

    XLA must not know how often it goes round, or may write the rounds one after the other instead. A loop that is batched, but
    not made for a `batch`, may hold products of matrices, which forbid it; and so may one that is, where it is differentiated.
    """

    def __init__(self, batch: bool = False) -> None:
        self.batch, self._found = batch, {"whole": True}

    @property
    def whole(self) -> bool:
        """Whether nothing has been found yet that forbids it."""
        return self._found["whole"]

    @property
    def fuses(self) -> bool:
        """Whether programs along the elements of one state can be fusions in it, as far as is known."""
        return self.whole and not self.batch and _known() and _told() and not _flagged()

    def holds(self, simple: bool) -> None:
        """Say whether what is in it is arithmetic alone."""
        self._found["whole"] &= simple

    def differentiated(self) -> None:
        """Say that a derivative is taken in it."""
        self.holds(not self.batch)

    @property
    def along_elements(self) -> "Loop":
        """The same loop, for programs that are mapped over elements of one state."""
        other = Loop(True)
        other._found = self._found
        return other


def together(jaxpr: Any, shapes: Sequence[tuple[int, ...]]) -> Callable[..., list[Any]]:
    """What a jaxpr of scalars computes of all numbers of arrays: to be called with the loop that it is in, and those."""
    parts = Parts(jaxpr, tuple(shapes))

    def call(loop: Loop, *arrays: Any) -> list[Any]:
        loop.holds(parts.simple)  # what else there is may keep XLA from making one function of the loop
        return together_p.bind(*arrays, parts=parts, loop=loop)

    return call


class Parts:
    """What a function of all numbers of some arrays computes, and what it only hands on; or those of each member of a batch.

    `shapes` are those of the arrays, without the batch, which comes last; `batched` says which have one, of `size` members.
    """

    def __init__(self, jaxpr: Any, shapes: tuple[tuple[int, ...], ...], batched: tuple[bool, ...] = (), size: int | None = None):
        self.jaxpr, self.shapes, self.batched, self.size = jaxpr, shapes, batched or (False,) * len(shapes), size
        inner = jaxpr.jaxpr
        self.results, self.operations = inner.outvars, inner.eqns
        self.avals = [jax.core.ShapedArray(() if size is None else (size,), x.dtype) for x in jaxpr.out_avals]
        numbers = iter(inner.invars)
        self.given = [[next(numbers) for _ in range(math.prod(shape))] for shape in shapes]
        made = {x for eqn in inner.eqns for x in eqn.outvars}
        taken = {x for eqn in inner.eqns for x in eqn.invars if not isinstance(x, Literal)}
        self.gives = [x for x in dict.fromkeys(x for x in inner.outvars if not isinstance(x, Literal)) if x in made]
        # Arrays that are taken as they are, and the numbers of others, by their types: one address instead of many.
        some = [k for k, numbers in enumerate(self.given) if not taken.isdisjoint(numbers)]
        self.direct = [k for k in some if self.batched[k] or (size is None and shapes[k])]
        self.pooled: dict[Any, list[int]] = {}
        for k in some:
            if k not in self.direct:
                self.pooled.setdefault(self.given[k][0].aval.dtype, []).append(k)
        names = {eqn.primitive.name for eqn in inner.eqns}
        scalar = not any(x.aval.shape for eqn in inner.eqns for x in [*eqn.invars, *eqn.outvars])
        self.simple = names <= SIMPLE | {cut_p.name, sincos_p.name} and scalar and not inner.constvars
        arrays = len(self.direct) + len(self.pooled) + len(self.gives) / 2
        checks = 0 if size is None else len(self.gives) * arrays
        worth = len(inner.eqns) <= LARGEST and checks <= CHECKS * len(inner.eqns)
        self.is_one_fusion = bool(self.gives) and self.simple and worth

    def whole(self, *arrays: Any) -> list[Any]:
        """What it computes, by itself."""
        function = jaxpr_as_fun(self.jaxpr)
        if self.size is None:
            return function(*(x for array in arrays for x in _rows(jnp.reshape(array, -1))))
        axes = tuple(0 if b else None for b, numbers in zip(self.batched, self.given, strict=True) for _ in numbers)
        each = zip(arrays, self.batched, strict=True)
        rows = [x for array, b in each for x in _rows(jnp.reshape(array, (-1, self.size) if b else -1))]
        return jax.vmap(function, in_axes=axes, axis_size=self.size)(*rows)

    def around(self, *arrays: Any) -> list[Any]:
        """All results, of the arrays and of what `inside` computes, as a fusion, to which XLA must add nothing of its own."""
        width = self.size or 1
        operands = [arrays[k].reshape(-1) for k in self.direct]
        for places in self.pooled.values():
            pool = jnp.concatenate([arrays[k].reshape(-1) for k in places])
            operands.append(jnp.broadcast_to(pool[:, None], (len(pool), width)).reshape(-1))
        known: dict[Any, Any] = dict(zip(self.gives, fusion_p.bind(*cut(operands), parts=self), strict=True))
        handed = {x for x in self.results if not isinstance(x, Literal) and x not in known}
        for array, numbers, b in zip(arrays, self.given, self.batched, strict=True):
            if not handed.isdisjoint(numbers):
                known.update(zip(numbers, _rows(array.reshape(-1, width) if b else array.reshape(-1)), strict=True))
        found = [x.val if isinstance(x, Literal) else known[x] for x in self.results]
        shape = () if self.size is None else (self.size,)
        return [jnp.reshape(x, shape) if np.size(x) == width else jnp.broadcast_to(x, shape) for x in found]

    def inside(self, *operands: Any) -> list[Any]:
        """What it computes, of vectors: those of one array follow each other. XLA would ask others for a layout."""
        width = self.size or 1
        places = [*([k] for k in self.direct), *self.pooled.values()]
        numbers = [[x for k in some for x in self.given[k]] for some in places]
        known = {}
        for operand, some in zip(operands, numbers, strict=True):
            parts = (jax.lax.slice(operand, (i * width,), ((i + 1) * width,)) for i in range(len(some)))
            known.update(zip(some, [operand] if len(some) == 1 else parts, strict=True))
        return jax.vmap(lambda xs: self._computed(dict(zip(known, xs, strict=True))))(list(known.values()))

    def _computed(self, known: dict[Any, Any]) -> list[Any]:
        """Without barriers, and sine and cosine of one angle at a time."""
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


def _rows(array: Any) -> list[Any]:
    return [jax.lax.index_in_dim(array, k, keepdims=False) for k in range(len(array))]


def _batched(xs: Sequence[Any], axes: Sequence[int | None], parts: Parts, loop: Loop) -> tuple[list[Any], list[int]]:
    if parts.size is not None or not loop.batch:
        found = jax.vmap(parts.whole, in_axes=tuple(axes))(*xs)
        return found, [0] * len(found)
    size = next(x.shape[axis] for x, axis in zip(xs, axes, strict=True) if axis is not None)
    last = [x if axis is None else jnp.moveaxis(x, axis, -1) for x, axis in zip(xs, axes, strict=True)]
    each = Parts(parts.jaxpr, parts.shapes, tuple(axis is not None for axis in axes), size)
    found = together_p.bind(*last, parts=each, loop=loop)
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
    exported = ctx.module_context.lowering_parameters.for_export
    in_vectors = parts.size is None or _told()
    fused = _known() and loop.whole and parts.is_one_fusion and in_vectors and not _flagged() and not exported
    return mlir.lower_fun(parts.around if fused else parts.whole)(ctx, *values)


def _known() -> bool:
    return jax.__version_info__[:2] in KNOWN


def _told() -> bool:
    """Whether XLA compiles loops along many arrays as they have to be."""
    given = os.environ.get("XLA_FLAGS", "")
    return all(flag in given for flag in NEEDED)


def _flagged() -> bool:
    """Whether loops may be taken apart."""
    given = os.environ.get("XLA_FLAGS", "")
    return any(flag in given for flag in FLAGS) or jax.config.read("jax_disable_most_optimizations")


mlir.register_lowering(together_p, _lowered)
mlir.register_lowering(together_p, _lowered_on_cpu, platform="cpu")

# An operation of XLA's own dialect. XLA lays arrays out later, but not those in a fusion that it finds: there are vectors, which
# need no layout where a loop is one function, and no result is one of the arguments, which have got one.
fusion_p = Primitive("fusion")
fusion_p.multiple_results = True
fusion_p.def_abstract_eval(lambda *xs, parts: [jax.core.ShapedArray((parts.size or 1,), x.aval.dtype) for x in parts.gives])


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
