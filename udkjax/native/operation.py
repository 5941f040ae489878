"""Machine code as an operation of JAX: what is compiled once for each kind, called at once or from compiled programs."""

import ctypes
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native import machine
from udkjax.native.backpropagation import Reverse
from udkjax.native.closing import Closing
from udkjax.native.closing_derivatives import ClosingForward, ClosingReverse
from udkjax.native.ffi import handler
from udkjax.native.layout import INFO, INPUTS, OUTPUTS, Plan
from udkjax.native.marching import Marching
from udkjax.native.module import Module
from udkjax.native.program import UnsupportedError
from udkjax.native.record import STORED, record_length
from udkjax.native.tableau import Method
from udkjax.native.tangents import Forward
from udkjax.native.trajectory import Trajectory

FEW = 2  # members up to which one follows another: eight lanes take as long as two members


class Kind(NamedTuple):
    """Which trajectory: all that its code depends on but the number of lanes."""

    code: ScenePrograms
    method: "Tableau"
    projected: bool
    breaks: bool
    active: tuple[bool, ...] | None = None  # of a run with derivatives: along which numbers of the scene
    sampled: tuple[int, ...] = ()  # places of the numbers that have samples
    points: int = STORED  # that the record of a run has room for
    mode: str = "run"  # or "forward", "reverse", "closing" and its derivatives, "marching"


class Tableau:
    """A method, to be looked up by its numbers."""

    def __init__(self, method: Method):
        self.method = method
        self._key = tuple(np.asarray(x).tobytes() for x in method)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tableau) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


CLOSING: dict[str, Any] = {"closing forward": ClosingForward, "closing reverse": ClosingReverse}


@lru_cache(maxsize=256)
def generate(kind: Kind, width: int, several: bool) -> Module:
    """A kind of trajectory in so many lanes, with its text; raises `UnsupportedError` where there is no instruction for it.

    `several`: whether there may be more than one direction of a single member, which then are side by side.
    """
    if kind.mode == "marching":
        trajectory: Module = Marching(kind.code, width, machine.lanes())
    elif kind.mode == "closing":
        trajectory = Closing(kind.code, machine.lanes())
    elif kind.mode in CLOSING:
        trajectory = CLOSING[kind.mode](kind.code, machine.lanes(), kind.active)
    else:
        written_out = kind.code.is_small
        plan = Plan(
            kind.code, kind.method.method, kind.projected, kind.breaks, width, machine.lanes(), written_out, sampled=kind.sampled
        )
        if kind.mode == "forward":
            assert kind.active is not None
            trajectory = Forward(plan, kind.active, machine.lanes() if several else width)
        else:
            trajectory = Reverse(plan, kind.active) if kind.active is not None else Trajectory(plan)
    handlers = handler(trajectory, "call_frame")
    declared = sorted(set().union(*(f.declared for f in handlers)))
    trajectory.module = "\n".join([trajectory.text(), *declared, *(f.text() for f in handlers)])
    return trajectory


def unsupported(kind: Kind) -> str:
    """Return what a kind of trajectory takes that machine code has no instruction for; empty where there is nothing."""
    try:
        generate(kind, 1, False)
    except UnsupportedError as error:
        return str(error)
    return ""


class Compiled:
    """The machine code of one kind of trajectory, in so many lanes."""

    def __init__(self, kind: Kind, width: int, several: bool):
        self.trajectory, self._in_passes = generate(kind, width, several), kind.mode == "reverse"
        self.name, self._run = load(self.trajectory.module)

    def __call__(self, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        """Outputs of these shapes, on as many threads as there are cores."""
        names, fields = self.trajectory, {}
        inputs = [np.ascontiguousarray(x, np.float64) for x in inputs]
        # Of the two passes of reverse mode each leaves out what the other finds: zeros, since NaN would alarm jax.debug_nans.
        found = [np.full(shape, 0.0 if self._in_passes else np.nan) for shape in shapes]
        for name, x in zip((*INPUTS, *names.inputs), inputs, strict=True):
            fields[name] = x.ctypes.data
            fields[f"{name} stride"] = math.prod(x.shape[1:]) if len(x) > 1 else 0
        fields |= {name: x.ctypes.data for name, x in zip((*names.results, *names.outputs), found, strict=True)}
        arrays = dict(zip((*INPUTS, *names.inputs, *names.results, *names.outputs), (*inputs, *found), strict=True))
        fields |= {f"{name} length": arrays[name].shape[1] for name in names.lengths}
        members, times = shapes[0][0], inputs[INPUTS.index("ts")].shape[1]
        following = ctypes.c_int64(0)
        fields |= {"members": members, "times": times, "knots": inputs[INPUTS.index("breaks")].shape[1]}
        fields |= {"directions": inputs[-1].shape[names.directions_in], "next": ctypes.addressof(following)}
        call = (ctypes.c_int64 * len(names.call_fields))(*(fields[name] for name in names.call_fields))
        threads = min(os.cpu_count() or 1, members)
        if threads == 1:
            self._run(ctypes.addressof(call))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda _: self._run(ctypes.addressof(call)), range(threads)))
        return found


_LOADED: dict[str, tuple[machine.Library, Any]] = {}
_LOADING = Lock()


def load(text: str) -> tuple[str, Any]:
    """Load the code of a module; return the name that XLA knows it by, and `run`.

    XLA takes one address for a name, and programs that it has compiled call that whenever they run: what was loaded once stays,
    and serves everyone who asks for the same text.
    """
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        if name not in _LOADED:
            library = machine.library(text, ("run", "call_frame"))
            capsule = jax.ffi.pycapsule(ctypes.c_void_p(library["call_frame"]))
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")
            _LOADED[name] = library, machine.function(library["run"], ctypes.c_void_p)
        return name, _LOADED[name][1]


@lru_cache(maxsize=256)
def machine_code(kind: Kind, width: int, several: bool) -> Compiled:
    """The machine code of a kind of trajectory."""
    return Compiled(kind, width, several)


# --- as an operation of JAX: inputs and outputs have the members first, of an input that all share only one


def shapes_of(inputs: Sequence[Any], kind: Kind, times: int) -> list[tuple[int, ...]]:
    """The shapes of the outputs."""
    n = inputs[INPUTS.index("q")].shape[1]
    members = max(x.shape[0] for x in inputs)
    shapes: list[tuple[int, ...]]
    if kind.mode == "marching":
        return [*[(members, times, n)] * 3, (members, 1)]
    if kind.mode.startswith("closing"):
        shapes = [(members, 2 * n), (members, 2 * inputs[INPUTS.index("rows")].shape[1]), (members, 1)]
        if kind.mode == "closing forward":
            shapes += [(members, inputs[-1].shape[1], 2 * n)]
        if kind.mode == "closing reverse":
            shapes += [(members, kind.code.number_count), (members, n), (members, n)]
        return shapes
    shapes = [(members, times, n), (members, times, n), (members, times), (members, len(INFO) + 2 * n)]
    if kind.mode == "forward":
        directions = inputs[-1].shape[1]
        shapes += [(members, directions, times, 2 * n), (members, directions, 2 * n)]
    if kind.mode == "reverse":
        is_first = not inputs[-1].shape[0]  # without cotangents
        shapes += [(members, kind.code.number_count), (members, n), (members, n)]
        if kind.sampled:
            rows = 0 if is_first else inputs[INPUTS.index("breaks")].shape[1] + 1
            shapes.append((members, rows, len(kind.sampled)))
        shapes.append((members, record_length(n, kind.points) if is_first else 0))
    return shapes


def _select_code(inputs: Sequence[Any], kind: Kind) -> Compiled:
    few = kind.mode.startswith("closing") or max(x.shape[0] for x in inputs) <= FEW
    several = kind.mode == "forward" and few and inputs[-1].shape[1] > 1 and kind.code.is_small
    return machine_code(kind, 1 if few else machine.lanes(), several)


def _call(*inputs: Any, kind: Kind, times: int) -> list[Array]:
    found = _select_code(inputs, kind)([np.asarray(x) for x in inputs], shapes_of(inputs, kind, times))
    return [jnp.asarray(x) for x in found]


def _lower(*inputs: Any, kind: Kind, times: int) -> Sequence[Array]:
    results = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes_of(inputs, kind, times)]
    found = jax.ffi.ffi_call(_select_code(inputs, kind).name, results)(*inputs)
    if kind.mode != "reverse":
        return found
    # What a pass leaves out, as in `Compiled`, is memory as it was.
    results, (*bars, record) = found[: len(OUTPUTS)], found[len(OUTPUTS) :]
    if inputs[-1].shape[0]:
        return [*map(jnp.zeros_like, results), *bars, record]
    return [*results, *map(jnp.zeros_like, bars), jnp.where(jnp.isfinite(record), record, 0.0)]


def _abstract_eval(*inputs: Any, kind: Kind, times: int) -> list[Any]:
    return [ShapedArray(shape, np.dtype(float)) for shape in shapes_of(inputs, kind, times)]


def _batch(inputs: Sequence[Any], axes: Sequence[int | None], kind: Kind, times: int) -> tuple[list[Any], list[int | None]]:
    """A batch is more members; but one of directions alone, more directions."""
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    first = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(inputs, axes, strict=True)]
    tangents = (4 if kind.sampled else 3) if kind.mode.endswith("forward") else 0  # the last inputs, which have directions
    results = len(Closing.results if kind.mode.startswith("closing") else OUTPUTS)  # the first outputs, which have none
    shared = len(inputs) - tangents
    if tangents and all(axis is None for axis in axes[:shared]):

        def directions(x: Any, axis: int | None) -> Any:
            x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else x
            x = jnp.moveaxis(x, 0, 1)
            return x.reshape(x.shape[0], x.shape[1] * x.shape[2], *x.shape[3:])

        given = [directions(x, axis) for x, axis in zip(first[shared:], axes[shared:], strict=True)]
        found = native_p.bind(*first[:shared], *given, kind=kind, times=times)
        changes = [x.reshape(x.shape[0], size, x.shape[1] // size, *x.shape[2:]) for x in found[results:]]
        return [*found[:results], *changes], [*[None] * results, *[1] * len(changes)]
    members = max(x.shape[0 if axis is None else 1] for x, axis in zip(first, axes, strict=True))

    def each(x: Any, axis: int | None) -> Any:
        if axis is None and x.shape[0] <= 1:
            return x
        x = x[None] if axis is None else x
        return jnp.broadcast_to(x, (size, members, *x.shape[2:])).reshape(size * members, *x.shape[2:])

    found = native_p.bind(*(each(x, axis) for x, axis in zip(first, axes, strict=True)), kind=kind, times=times)
    return [x.reshape(size, members, *x.shape[1:]) for x in found], [0] * len(found)


native_p = Primitive("native_trajectory")
native_p.multiple_results = True
native_p.def_impl(_call)
native_p.def_abstract_eval(_abstract_eval)
batching.primitive_batchers[native_p] = _batch
mlir.register_lowering(native_p, mlir.lower_fun(_lower), platform="cpu")
