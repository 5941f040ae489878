"""Barriers that keep XLA from fusing what lies before them with what comes after.

XLA fuses each result with a copy of everything before it that it takes. Between two barriers it can repeat but little. What
passes one goes through memory; no value changes.
"""

from collections.abc import Sequence
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

BARRIERS_HOLD = (0, 11)  # the version of JAX before which XLA takes barriers out on the CPU before it fuses; never a call


def cut(values: Sequence[Any], only_batches: bool = False) -> list[Any]:
    """Keep XLA from fusing across this point, or only where there are batches: the identity, with the identity's derivative."""
    return cut_p.bind(*values, only_batches=only_batches)


def _derivative(primals: Sequence[Any], tangents: Sequence[Any], only_batches: bool) -> tuple[list[Any], list[Any]]:
    # One by one: of a barrier only a part may depend on what is differentiated.
    kept = [t if only_batches or isinstance(t, ad.Zero) else cut([t])[0] for t in tangents]
    return cut(primals, only_batches), kept


def _barrier(*xs: Any, only_batches: bool) -> list[Any]:
    return list(xs) if only_batches else jax.lax.optimization_barrier(list(xs))


def _barrier_on_cpu(*xs: Any, only_batches: bool) -> list[Any]:
    if only_batches or jax.__version_info__ >= BARRIERS_HOLD:
        return _barrier(*xs, only_batches=only_batches)
    with set_xla_metadata(inlineable="false"):
        return list(_themselves(*xs))


@jax.jit
def _themselves(*xs: Any) -> tuple[Any, ...]:
    return xs


# A primitive: programs hold hundreds, and a function with a derivative of its own takes ten times as long to trace.
cut_p = Primitive("cut")
cut_p.multiple_results = True
cut_p.def_impl(lambda *xs, only_batches: list(xs))
cut_p.def_abstract_eval(lambda *xs, only_batches: list(xs))
batching.primitive_batchers[cut_p] = lambda xs, axes, only_batches: (cut(xs), axes)
ad.primitive_jvps[cut_p] = _derivative
ad.primitive_transposes[cut_p] = lambda cotangents, *xs, only_batches: [
    ct if isinstance(ct, ad.Zero) else cut([ct], only_batches)[0] for ct in cotangents
]
mlir.register_lowering(cut_p, mlir.lower_fun(_barrier))
mlir.register_lowering(cut_p, mlir.lower_fun(_barrier_on_cpu), platform="cpu")
