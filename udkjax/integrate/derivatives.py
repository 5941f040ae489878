"""Derivatives of a run, forward and reverse, of any order.

A run is a function x -> f(x) of its numbers. Its first derivatives, forward x' -> J x' and in reverse w -> J^T w, are machine
code where that serves, else diffrax's. Both together are one linear map with its transpose (`Linear`), to JAX a primitive, so
that no derivative is ever transposed operation by operation.

A derivative of the map is one of two functions again, of x and a direction v, or of x and a cotangent w,

    g(x, v) = J(x) v,        h(x, w) = J(x)^T w.

Forward mode of both is JAX's. In reverse mode, since w^T J(x) v is one number, of which derivatives may be taken in any order,
the cotangents of x are d/dx (w^T J v) = dh(x, w) along v, and those of v and w are h and g. There h is found row by row, w^T J e
for each unit vector e, so that forward mode through diffrax is all that derivatives of higher orders take.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from udkjax.integrate import native_engine
from udkjax.integrate.gradients import TreeDef, stop_gradients
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.integrate.split_jvp import split_jvp
from udkjax.scene.fields import number

Mask = tuple[bool, ...]  # of a list of arrays: those that have tangents
SMOOTH = tuple(IntegratorOutput._fields.index(name) for name in ("q", "v", "y"))  # of `IntegratorOutput`: what has derivatives


def differentiable(problem: Problem, native: bool) -> IntegratorOutput:
    """Integrate a problem by machine code or by diffrax, with derivatives of any order of q, v and y.

    None are taken along numbers that do not depend on what is differentiated.
    """
    problem_of, xs = split_numbers(problem)
    return _run(Run(problem_of, native), xs)


@eqx.filter_custom_jvp
def _run(function: "Run", xs: list[Array]) -> IntegratorOutput:
    return function.fast(xs)


@_run.def_jvp
def _(primals, tangents):
    active = tuple(dx is not None for dx in tangents[1])
    if not any(active):
        return _run(*primals), IntegratorOutput._make([None] * len(IntegratorOutput._fields))
    shapes = eqx.filter_eval_shape(_run, *primals)

    def in_parts(at: Any, *directions: list[Array]) -> tuple[list[Any], ...]:
        """The run, and linear maps of the directions."""
        raw, record = at[0].recorded(stop_gradients(at[1]), active)
        linear = Linear(function=at[0], xs=at[1], run=(raw, record), active=active)
        return list(_as_run(*at, raw)), *(linear.applied(direction) for direction in directions)

    def at_once(at: Any, direction: list[Array]) -> tuple[list[Any], ...]:
        """Both by forward mode."""
        function, xs = at
        raw, change = function.run_and_jvp(xs, active, direction)
        return list(raw), change

    known = list(shapes), [shapes[k] for k in SMOOTH]
    raw, change = split_jvp(in_parts, at_once, primals, select(tangents[1], active), None, known)
    return IntegratorOutput(*raw), IntegratorOutput._make(
        change[SMOOTH.index(k)] if k in SMOOTH else None for k in range(len(raw))
    )


@eqx.filter_custom_jvp
def _as_run(function: "Run", xs: list[Array], raw: IntegratorOutput) -> IntegratorOutput:
    """What a run left, with the derivatives of the run."""
    del function, xs
    return raw


@_as_run.def_jvp
def _(primals, tangents):
    *at, raw = primals
    if all(dx is None for dx in tangents[1]):
        return raw, IntegratorOutput._make([None] * len(raw))
    return raw, eqx.filter_jvp(_run, tuple(at), tuple(tangents[:2]))[1]


# --- functions, and those that their derivatives are


class KnownNumbers:
    """The known arrays among those of a tree, None in place of the others; compared by value, so that they are static."""

    def __init__(self, arrays: Sequence[Array | None]):
        self.arrays = arrays
        self._key = tuple(None if x is None else (x.shape, np.asarray(x).tobytes()) for x in arrays)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KnownNumbers) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class TreeOfNumbers(eqx.Module):
    """A tree as a function of the arrays of floats in it that are traced. The others stay known: JAX would trace them all."""

    rest: PyTree  # the tree without arrays of floats
    known: KnownNumbers = eqx.field(static=True)
    structure: TreeDef = eqx.field(static=True)

    def __call__(self, xs: Sequence[Array]) -> Any:
        traced = iter(xs)
        arrays = [next(traced) if x is None else x for x in self.known.arrays]
        return eqx.combine(jax.tree.unflatten(self.structure, arrays), self.rest)

    def marks(self, active: Mask) -> Any:
        """The tree with True in place of the arrays that are active, and False in place of the others."""
        traced = iter(active)
        return jax.tree.unflatten(self.structure, [x is None and next(traced) for x in self.known.arrays])

    def changes(self, active: Mask, some: Sequence[Array]) -> Any:
        """The tree with some arrays in place of those that are active, and None in place of the others."""
        marks, rest = jax.tree.leaves(self.marks(active)), iter(some)
        return jax.tree.unflatten(self.structure, [next(rest) if m else None for m in marks])


def split_numbers(tree: PyTree) -> tuple[TreeOfNumbers, list[Array]]:
    """Return a tree as a function of the arrays of floats in it that are traced, and these arrays."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    known = KnownNumbers(
        [None if isinstance(x, jax.core.Tracer) else number(x) if isinstance(x, np.ndarray) else x for x in leaves]
    )
    return TreeOfNumbers(rest, known, structure), [x for x in leaves if isinstance(x, jax.core.Tracer)]


class Function(eqx.Module):
    """A function of a list of arrays that returns a list of arrays. Forward mode of it is JAX's."""

    @abstractmethod
    def __call__(self, xs: list[Array]) -> list[Array]:
        """f(x)."""

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        """J^T w, of those of x that are active: w^T J e for each unit vector e. Forward mode of it is JAX's, too."""
        some = select(xs, active)
        units = jnp.eye(sum(x.size for x in some))
        shapes = [x.shape for x in some]
        row = lambda e: jnp.vdot(_flat(ws), _flat(_change(self, xs, active, _split(e, shapes))[1]))  # noqa: E731
        return _split(jax.vmap(row)(units), shapes)

    @abstractmethod
    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        """Those of f(x)."""

    def forward(self, xs: list[Array], active: Mask, vs: list[Array], run: Any) -> list[Array]:
        """J v. `run` is what evaluating f at x has left for its first derivatives, if anything."""
        del run
        return _change(self, xs, active, vs)[1]

    def backward(self, xs: list[Array], active: Mask, ws: list[Array], run: Any) -> list[Array]:
        """J^T w, of those of x that are active, in the same way."""
        del run
        return self.pull(xs, active, ws)

    @property
    def plain(self) -> "Function":
        """The same in the form that is differentiated more than once."""
        return self


class Run(Function):
    """Positions and velocities at the output times, and at the end, of the numbers of a problem.

    Derivatives beyond the first are those of diffrax alone: `plain`.
    """

    problem: TreeOfNumbers
    native: bool = eqx.field(static=True)

    @property
    def plain(self) -> "Run":
        return replace(self, native=False)

    def fast(self, xs: list[Array]) -> IntegratorOutput:
        """By machine code, which has no derivatives, if that serves."""
        problem = self.problem(xs)
        return native_engine.integrate(problem) if self.native else _integrate_by_diffrax(problem)

    def forward(self, xs: list[Array], active: Mask, vs: list[Array], run: Any) -> list[Array]:
        return super().forward(xs, active, vs, run) if run is None else self.run_and_jvp(xs, active, vs)[1]

    def backward(self, xs: list[Array], active: Mask, ws: list[Array], run: Any) -> list[Array]:
        if run is None:
            return self.pull(xs, active, ws)
        problem, which = self.problem(xs), self.problem.marks(active)
        if self._is_native(xs, active):
            q, v, y = ws
            found = native_engine.vjp(problem, which, run, jnp.concatenate([q, v], axis=1), y)
            pairs = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (which, found)), strict=True)
            return [bar for m, bar in pairs if m is True]

        def function(some: list[Array]) -> list[Array]:
            raw = _integrate_by_diffrax(self.problem(replaced(xs, active, some)), "RecursiveCheckpointAdjoint")
            return [raw[k] for k in SMOOTH]

        return jax.vjp(function, select(xs, active))[1](ws)[0]

    def run_and_jvp(self, xs: list[Array], active: Mask, vs: list[Array]) -> tuple[IntegratorOutput, list[Array]]:
        """The run, and the change of its states along v, of those of x that are active: by machine code, if that serves."""
        if self._is_native(xs, active):
            change = self.problem.changes(active, vs)
            raw, found = native_engine.jvp(self.problem(xs), self.problem.marks(active), change)
            return raw, list(found)
        raw, change = _change(lambda xs: _integrate_by_diffrax(self.problem(xs)), xs, active, vs)
        return raw, [change[k] for k in SMOOTH]

    def recorded(self, xs: list[Array], active: Mask) -> tuple[IntegratorOutput, Array | None]:
        """The run and its record, by the machine code of its reverse mode, if that serves: no other is compiled."""
        if self._is_native(xs, active):
            return native_engine.integrate_for_vjp(self.problem(xs), self.problem.marks(active))
        return _integrate_by_diffrax(self.problem(xs)), None

    def _is_native(self, xs: list[Array], active: Mask) -> bool:
        return self.native and native_engine.serves_derivatives(self.problem.marks(active))

    def __call__(self, xs: list[Array]) -> list[Array]:
        raw = _integrate_by_diffrax(self.problem(xs))
        return [raw[k] for k in SMOOTH]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        problem = self.problem(xs)
        (times,), (n,) = problem.ts.shape, problem.q.shape
        return [(times, n), (times, n), (2 * n,)]


class Along(Function):
    """g(x, v) = J(x) v, with v of those of x that are active."""

    of: Function
    active: Mask = eqx.field(static=True)

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        return _change(self.of, xs, self.active, vs)[1]

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        of_x, of_v = active[: len(xs)], active[len(xs) :]
        either = tuple(a or b for a, b in zip(of_x, self.active, strict=True))
        found, change = _change(lambda xs: self.of.pull(xs, either, ws), xs, self.active, vs)
        change = select(change, tuple(x for x, e in zip(of_x, either, strict=True) if e))
        found = select(found, tuple(m for m, e in zip(self.active, either, strict=True) if e))
        return [*change, *select(found, of_v)]

    def parts(self, xs: list[Array]) -> tuple[list[Array], list[Array]]:
        return xs[: len(self.active)], xs[len(self.active) :]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return self.of.shapes(self.parts(xs)[0])


class Back(Along):
    """h(x, w) = J(x)^T w, of those of x that are active."""

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, ws = self.parts(xs)
        return self.of.pull(xs, self.active, ws)

    def pull(self, xs: list[Array], active: Mask, ws: list[Array]) -> list[Array]:
        (xs, bars), directions = self.parts(xs), ws
        of_x, of_w = active[: len(xs)], active[len(xs) :]
        found = []
        if any(of_x):
            found += _change(lambda xs: self.of.pull(xs, of_x, bars), xs, self.active, directions)[1]
        if any(of_w):
            found += select(_change(self.of, xs, self.active, directions)[1], of_w)
        return found

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in select(self.parts(xs)[0], self.active)]


def _change(function: Callable, xs: list[Array], active: Mask, vs: list[Array]) -> tuple[Any, Any]:
    """f(x), and its change along v, of those of x that are active, by forward mode."""
    return jax.jvp(lambda *some: function(replaced(xs, active, some)), select(xs, active), vs)


# --- the linear map


class Linear(eqx.Module):
    """v -> J(x) v, or transposed w -> J(x)^T w, of those of x that are active."""

    function: Function
    xs: list[Array]
    run: Any  # what evaluating it has left for its first derivatives; None: nothing
    active: Mask = eqx.field(static=True)
    transposed: bool = eqx.field(static=True, default=False)

    @property
    def T(self) -> "Linear":
        return replace(self, transposed=not self.transposed)

    @property
    def inputs(self) -> list[tuple[int, ...]]:
        """The shapes of what it is applied to."""
        return self.function.shapes(self.xs) if self.transposed else [x.shape for x in select(self.xs, self.active)]

    def applied(self, vs: list[Array]) -> list[Array]:
        return _split(_bind(self, _flat(vs)), self.T.inputs)


def _apply(linear: Linear, vector: Array) -> Array:
    function, vs = linear.function, _split(vector, linear.inputs)
    apply = function.backward if linear.transposed else function.forward
    return _flat(apply(linear.xs, linear.active, vs, linear.run))


@eqxi.filter_primitive_def
def _shape(linear, vector):
    return jax.core.ShapedArray((sum(map(math.prod, linear.T.inputs)),), vector.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    linear, vector = primals
    at, change = tangents
    found = _bind(linear, vector)
    if all(dx is None for dx in at.xs):
        return found, _bind(linear, change)
    kind, function = Back if linear.transposed else Along, linear.function
    parts = [None] * len(linear.inputs) if change is None else _split(change, linear.inputs)
    dxs = [*at.xs, *parts]
    active = tuple(dx is not None for dx in dxs)
    further = Linear(kind(function.plain, linear.active), [*linear.xs, *_split(vector, linear.inputs)], None, active)
    return found, _bind(further, _flat(select(dxs, active)))


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = eqxi.create_vprim("derivative_of_a_run", eqxi.filter_primitive_def(_apply), _shape, _derivative, _transpose)


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def select(xs: Sequence[Any], which: Mask) -> list[Any]:
    """Those that are marked."""
    return [x for x, m in zip(xs, which, strict=True) if m]


def replaced(xs: Sequence[Array], active: Mask, some: Sequence[Array]) -> list[Array]:
    """The same, with others in place of those that are active."""
    rest = iter(some)
    return [next(rest) if m else x for x, m in zip(xs, active, strict=True)]


def _flat(xs: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in xs])


def _split(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), shapes, strict=True)]


def _integrate_by_diffrax(problem: Problem, adjoint: str = "ForwardMode") -> IntegratorOutput:
    import diffrax

    from udkjax.integrate.diffrax_engine import integrate_by_diffrax

    return integrate_by_diffrax(problem, getattr(diffrax, adjoint)())
