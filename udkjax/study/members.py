"""Compiled functions of the members of a study, with forward derivatives.

Some inputs of a member differ between members, others are shared by all. A program computes a fixed number of members at a time
(a piece); the last piece is padded with copies. Results therefore do not depend on the number of members or the size of chunks.
"""

import hashlib
import os
import platform
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from udkjax.devices import default_devices
from udkjax.threads import cores, thread_count

MOST_PROGRAMS = 64  # number of programs of identifications, and of sweeps, in memory; each holds the scene that it was made for

T = TypeVar("T")
Outputs: TypeAlias = dict[str, Array]
Results: TypeAlias = tuple[dict[str, np.ndarray], dict[str, np.ndarray]]  # values (members, ...); slopes (members, ..., K)


class MemberFunction(Protocol):
    """A function that computes arrays by name for one member.

    Its arguments are the inputs that all members share, the member's own inputs, and a shift (K,) that is added to the numbers
    with respect to which derivatives are computed.
    """

    def __call__(self, shared: Any, own: Any, shift: Array, /) -> Outputs: ...


def structure_of(tree: PyTree) -> Hashable:
    """Return a hashable key of everything in a tree except the values of its arrays; trees with equal keys share a program."""
    arrays, static = eqx.partition(tree, eqx.is_array)
    leaves, form = jax.tree.flatten(static)
    return jax.tree.structure(arrays), tuple((x.shape, str(x.dtype)) for x in jax.tree.leaves(arrays)), form, tuple(leaves)


class Program:
    """A function of members, compiled for `piece` members on each of `devices`, with derivatives for K = `slopes` numbers.

    `function` computes a single member. Results are the values and their derivatives, both by name.
    """

    def __init__(self, function: MemberFunction, slopes: int, piece: int, devices: Sequence[Any] = ()):
        self.function, self.slopes, self.piece, self.devices = function, slopes, piece, tuple(devices)
        self.size = piece * max(1, len(self.devices))
        self._lock = threading.RLock()
        self._traced: jax.stages.Traced | None = None
        self._shapes: tuple[dict[str, jax.ShapeDtypeStruct], dict[str, jax.ShapeDtypeStruct]] | None = None
        self._compiled: jax.stages.Compiled | None = None

    def __call__(self, shared: PyTree, own: PyTree, on_threads: bool = False) -> Results:
        """Return values and derivatives of the members along the first axis of `own`, in order.

        `shared` are the inputs that all members share. Pieces run in turn or, with `on_threads`, concurrently.
        """
        count = len(jax.tree.leaves(own)[0])
        program = self.compile(shared, own)

        def compute(first: int) -> tuple[Outputs, Outputs]:
            return jax.tree.map(np.asarray, program(shared, _rows(own, first, self.size)))

        each: Callable[..., Iterable] = member_threads().map if on_threads and count > self.size else map
        return jax.tree.map(lambda *x: np.concatenate(x)[:count], *each(compute, range(0, count, self.size)))

    def place(self, shared: T, own: PyTree) -> T:
        """Compile for inputs of this kind, and return the shared inputs on the devices, where repeated calls can use them."""
        return jax.device_put(shared, self.compile(shared, own).input_shardings[0][0])

    def compile(self, shared: PyTree, own: PyTree) -> jax.stages.Compiled:
        """Return the executable for inputs of this kind, which is compiled once."""
        with self._lock:
            if self._compiled is None:
                self._compiled = _compile(self._trace(shared, own).lower(), self.devices)
                self.shapes(shared, own)  # before the trace is forgotten
                self._traced = None
        return self._compiled

    def shapes(self, shared: PyTree, own: PyTree) -> tuple[dict[str, jax.ShapeDtypeStruct], dict[str, jax.ShapeDtypeStruct]]:
        """Return shapes and types of the values and of the derivatives of one member, both by name."""
        with self._lock:
            shapes = self._shapes
            if shapes is None:
                found = self._trace(shared, own).out_info
                shapes = self._shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), found)
            return shapes

    def _trace(self, shared: PyTree, own: PyTree) -> jax.stages.Traced:
        """Return the traced program, which is kept until it is compiled, so that shapes and executable need a single trace."""
        if self._traced is None:
            self._traced = jax.jit(self._on_devices()).trace(shared, _rows(own, 0, self.size))
        return self._traced

    def _compute(self, shared: PyTree, own: PyTree) -> tuple[Outputs, Outputs]:
        """Return values of members, and derivatives of those that are floating-point numbers."""
        alone = len(jax.tree.leaves(own)[0]) == 1

        def values(shift: Array) -> tuple[Outputs, Outputs]:
            if alone:  # `vmap` of a single member would execute all branches
                outputs = self.function(shared, jax.tree.map(lambda x: x[0], own), shift)
                outputs = {name: jnp.asarray(x)[None] for name, x in outputs.items()}
            else:
                outputs = jax.vmap(lambda own: self.function(shared, own, shift))(own)
            return {name: x for name, x in outputs.items() if jnp.issubdtype(x.dtype, jnp.floating)}, outputs

        no_shift = jnp.zeros(self.slopes)
        if not self.slopes:
            return values(no_shift)[1], {}
        slopes, outputs = jax.jacfwd(values, has_aux=True)(no_shift)
        return outputs, slopes

    def _on_devices(self) -> Callable[[PyTree, PyTree], tuple[Outputs, Outputs]]:
        """Return the function that computes one piece on each device."""
        if len(self.devices) < 2:
            return self._compute
        from jax.sharding import AxisType, Mesh, PartitionSpec

        mesh = Mesh(np.array(self.devices), ("members",), axis_types=(AxisType.Auto,))
        same, spread = PartitionSpec(), PartitionSpec("members")
        return jax.shard_map(self._compute, mesh=mesh, in_specs=(same, spread), out_specs=spread, check_vma=False)


_EXECUTABLES: OrderedDict[Hashable, jax.stages.Compiled] = OrderedDict()  # the `MOST_PROGRAMS` most recently used


def _compile(lowered: jax.stages.Lowered, devices: tuple[Any, ...]) -> jax.stages.Compiled:
    """Return the executable of a program; studies that differ only in the values of its arguments share an executable.

    Programs are identified by their text. Programs that call Python functions, or whose constants JAX stores
    outside the text, are always compiled.
    """
    text = lowered.as_text()
    if "callback" in text or getattr(jax.config, "jax_use_simplified_jaxpr_constants", False):
        return lowered.compile()
    key = hashlib.sha256(text.encode()).digest(), lowered.in_tree, lowered.out_tree, devices
    executable = _EXECUTABLES.get(key) or lowered.compile()
    _EXECUTABLES[key] = executable
    _EXECUTABLES.move_to_end(key)
    while len(_EXECUTABLES) > MOST_PROGRAMS:
        _EXECUTABLES.popitem(last=False)
    return executable


def _rows(own: T, first: int, count: int) -> T:
    """Return the inputs of `count` members from the index `first` on, padded with copies of the last member."""
    return jax.tree.map(lambda x: x[np.minimum(np.arange(first, first + count), len(x) - 1)], own)


def member_threads() -> ThreadPoolExecutor:
    """Return the thread pool of this process; starting new threads would take as long as a short run."""
    return _threads(os.getpid(), thread_count())


@lru_cache(maxsize=1)
def _threads(process: int, count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="members")


CHUNKED_PLATFORMS = ("cpu",)  # platforms that compute a batch in pieces; others compute the whole batch at once
PIECE_MEMBERS = 64  # number of members of a piece on these platforms


def concurrent_chunks() -> int:
    """Return the number of chunks that are computed concurrently.

    A single CPU device runs a program per thread; several devices share each chunk.
    """
    devices = default_devices()
    return thread_count() if len(devices) == 1 and devices[0].platform in CHUNKED_PLATFORMS else 1


def machine() -> str:
    """Return the name of the processor, the number of its cores that may be used, and the system, as text."""
    return f"{processor()}, {cores()} of {os.cpu_count()} cores, {platform.system()} {platform.release()}"


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
