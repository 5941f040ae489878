"""Derivatives of a run, forward and reverse, of any order.

A run is a function x -> f(x) of its numbers. Forward mode is that of the integrator itself: x' -> J x'. In reverse mode the steps
are recorded and walked back (replay.py): w -> J^T w. Both together are one linear map with its transpose (`Linear`), to JAX a
primitive, so that no derivative is ever transposed operation by operation.

A derivative of the map is one of two functions again, of x and a direction v, or of x and a cotangent w,

    g(x, v) = J(x) v,        h(x, w) = J(x)^T w.

Forward mode of both is JAX's. In reverse mode, since w^T J(x) v is one number, of which derivatives may be taken in any order,
the cotangents of x are d/dx (w^T J v) = dh(x, w) along v, and those of v and w are h and g. So forward mode through the
integrator and through the way back is all that derivatives of higher orders take.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from udkjax.equations.linear import through_constants
from udkjax.equations.programs import Equations
from udkjax.integrate import by_native
from udkjax.integrate.batched import one_by_one
from udkjax.integrate.explicit import march
from udkjax.integrate.lanes import Lanes, number_of, raw_of, serves, solve, task_of
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.record import Record
from udkjax.integrate.replay import walked_back
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.straightline import along

Mask = tuple[bool, ...]  # of a list of arrays: those that have tangents
SMOOTH = tuple(Raw._fields.index(name) for name in ("q", "v", "y"))  # of `Raw`: what has derivatives


def differentiable(problem: Problem) -> Raw:
    """Integrate a problem, with derivatives of any order; of `Raw`, q, v and y have some.

    None are taken along numbers that do not depend on what is differentiated.
    """
    arrays, rest = eqx.partition(problem, eqx.is_inexact_array)
    xs, tree = jax.tree.flatten(arrays)
    return _run(Run(rest, tree), xs)


@eqx.filter_custom_jvp
def _run(function: "Run", xs: list[Array]) -> Raw:
    return function.fast(xs)


@_run.def_jvp
def _(primals, tangents):
    moving = tuple(dx is not None for dx in tangents[1])
    if not any(moving):
        return _run(*primals), Raw(*[None] * len(Raw._fields))
    shapes = eqx.filter_eval_shape(_run, *primals)

    def in_parts(at: Any, *directions: list[Array]) -> tuple[list[Any], ...]:
        """The run with its record, and linear maps of the directions."""
        raw, record = at[0].recorded(undifferentiated(at[1]), moving)
        linear = Linear(function=at[0], xs=at[1], run=(raw, record), moving=moving)
        return list(_as_run(*at, raw)), *(linear.applied(direction) for direction in directions)

    def at_once(at: Any, direction: list[Array]) -> tuple[list[Any], ...]:
        """Both by forward mode."""
        function, xs = at
        raw, change = function.pushed(xs, moving, direction)
        return list(raw), change

    known = list(shapes), [shapes[k] for k in SMOOTH]
    raw, change = along(in_parts, at_once, primals, those(tangents[1], moving), None, known)
    return Raw(*raw), Raw(*[change[SMOOTH.index(k)] if k in SMOOTH else None for k in range(len(raw))])


@eqx.filter_custom_jvp
def _as_run(function: "Run", xs: list[Array], raw: Raw) -> Raw:
    """What a run left, with the derivatives of the run."""
    del function, xs
    return raw


@_as_run.def_jvp
def _(primals, tangents):
    *at, raw = primals
    if all(dx is None for dx in tangents[1]):
        return raw, Raw(*[None] * len(raw))
    return raw, eqx.filter_jvp(_run, tuple(at), tuple(tangents[:2]))[1]


# --- functions, and those that their derivatives are


class Function(eqx.Module):
    """A function of a list of arrays that returns a list of arrays. Forward mode of it is JAX's."""

    @abstractmethod
    def __call__(self, xs: list[Array]) -> list[Array]:
        """f(x)."""

    @abstractmethod
    def pull(self, xs: list[Array], moving: Mask, ws: list[Array]) -> list[Array]:
        """J^T w, of those of x that are moving."""

    @abstractmethod
    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        """Those of f(x)."""

    def forward(self, xs: list[Array], moving: Mask, vs: list[Array], run: Any) -> list[Array]:
        """J v. `run` is what evaluating f at x has left for its first derivatives, if anything."""
        del run
        return _change(self, xs, moving, vs)[1]

    def backward(self, xs: list[Array], moving: Mask, ws: list[Array], run: Any) -> list[Array]:
        """J^T w, of those of x that are moving, in the same way."""
        del run
        return self.pull(xs, moving, ws)

    @property
    def plain(self) -> "Function":
        """The same in the form that is differentiated more than once."""
        return self

    def counted_twice(self, xs: list[Array], dxs: list[Any], moving: Mask, bars: list[Array]) -> list[Array] | None:
        """Of a change of cotangents, what JAX adds itself."""
        return None


class Run(Function):
    """Positions and velocities at the output times, and at the end, of the numbers of a problem. `rest` is what else it has.

    A first derivative is that of the programs, which depend on constants made of the numbers of a scene; a further one is that of
    the textbook, of the numbers themselves: `plain`.
    """

    rest: Problem
    tree: Any = eqx.field(static=True)
    is_plain: bool = eqx.field(static=True, default=False)

    def problem(self, xs: list[Array]) -> Problem:
        problem = eqx.combine(jax.tree.unflatten(self.tree, xs), self.rest)
        return replace(problem, equations=problem.equations.plain, fallback=False) if self.is_plain else problem

    @property
    def plain(self) -> "Run":
        return replace(self, is_plain=True)

    def fast(self, xs: list[Array]) -> Raw:
        """By machine code, which has no derivatives, if that serves."""
        problem = self.problem(xs)
        return by_native.solve(problem) if by_native.serves(problem) else self.raw(xs)

    def forward(self, xs: list[Array], moving: Mask, vs: list[Array], run: Any) -> list[Array]:
        return super().forward(xs, moving, vs, run) if run is None else self.pushed(xs, moving, vs)[1]

    def backward(self, xs: list[Array], moving: Mask, ws: list[Array], run: Any) -> list[Array]:
        if run is None:
            return self.pull(xs, moving, ws)
        problem, which = self.problem(xs), jax.tree.unflatten(self.tree, moving)
        if not self.is_plain and by_native.serves_derivatives(problem, which):
            q, v, y = ws
            found = by_native.pulled(problem, which, jnp.concatenate([q, v], axis=1), y)
            pairs = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (which, found)), strict=True)
            return [bar for m, bar in pairs if m is True]
        raw, record = run
        if record is None:
            return self.through_diffrax("RecursiveCheckpointAdjoint", xs, moving, ws)
        return self.walk(_pulled, xs, moving, raw, record, ws)

    def pushed(self, xs: list[Array], moving: Mask, vs: list[Array]) -> tuple[Raw, list[Array]]:
        """The run, and the change of its states along v, of those of x that are moving: by machine code, if that serves."""
        problem, which = self.problem(xs), jax.tree.unflatten(self.tree, moving)
        if not self.is_plain and by_native.serves_derivatives(problem, which):
            rest = iter(vs)
            change = jax.tree.unflatten(self.tree, [next(rest) if m else None for m in moving])
            raw, found = by_native.pushed(problem, which, change)
            return raw, list(found)
        raw, change = _change(lambda xs: self.raw(xs), xs, moving, vs)
        return raw, [change[k] for k in SMOOTH]

    def raw(self, xs: list[Array]) -> Raw:
        """By the engine that serves; under vmap in lanes, or one after another."""
        problem = self.problem(xs)
        return solve(problem) if serves(problem) else one_by_one(problem, partial(_by_diffrax, adjoint="ForwardMode"))

    def recorded(self, xs: list[Array], moving: Mask) -> tuple[Raw, Any]:
        """The run, and its record if it is made for one."""
        problem, which = self.problem(xs), jax.tree.unflatten(self.tree, moving)
        if not self.is_plain and by_native.serves_derivatives(problem, which):
            return by_native.recorded(problem, which), None
        return _recorded(problem) if serves(problem) else (self.raw(xs), None)

    def __call__(self, xs: list[Array]) -> list[Array]:
        """Forward mode of it may be taken again, and mapped in any way: one run, in which all members wait for the slowest."""
        problem = self.problem(xs)
        raw = _marched(problem)[0] if serves(problem) else _by_diffrax(problem, "ForwardMode")
        return [raw[k] for k in SMOOTH]

    def pull(self, xs: list[Array], moving: Mask, ws: list[Array]) -> list[Array]:
        problem = self.problem(xs)
        if serves(problem):
            return self.walk(walked_back, xs, moving, *_marched(problem), ws)
        return self.through_diffrax("DirectAdjoint", xs, moving, ws)

    def walk(self, back: Callable, xs: list[Array], moving: Mask, raw: Raw, record: Record, ws: list[Array]) -> list[Array]:
        """The way back of a recorded run."""

        def arrays(some: list[Array]) -> Problem:
            return eqx.filter(self.problem(replaced(xs, moving, some)), eqx.is_inexact_array)

        numbers, to_xs = jax.vjp(arrays, those(xs, moving))
        which = replace(jax.tree.unflatten(self.tree, moving), fallback=numbers.fallback)
        if self.is_plain and isinstance(which.equations, Equations):
            textbook, none = which.equations.textbook, jax.tree.map(lambda _: False, numbers.equations)
            which = replace(which, equations=replace(none, mechanism=textbook.mechanism, baumgarte=textbook.baumgarte))
        some = jax.tree.map(lambda m, x: x if m else None, which, numbers)
        q, v, y = ws
        found = back(self.problem(xs), some, raw, record, jnp.concatenate([q, v], axis=1), y)
        return to_xs(eqx.combine(found, jax.tree.map(jnp.zeros_like, numbers)))[0]

    def through_diffrax(self, adjoint: str, xs: list[Array], moving: Mask, ws: list[Array]) -> list[Array]:
        """Reverse mode by an adjoint of diffrax."""

        def function(some: list[Array]) -> list[Array]:
            raw = _by_diffrax(self.problem(replaced(xs, moving, some)), adjoint)
            return [raw[k] for k in SMOOTH]

        return jax.vjp(function, those(xs, moving))[1](ws)[0]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        problem = eqx.combine(jax.tree.unflatten(self.tree, xs), self.rest)
        (times,), (n,) = problem.ts.shape, problem.q.shape
        return [(times, n), (times, n), (2 * n,)]

    def counted_twice(self, xs: list[Array], dxs: list[Any], moving: Mask, bars: list[Array]) -> list[Array]:
        """Of a change of cotangents, what JAX adds itself, since the constants are functions of numbers that change."""
        rest = iter(bars)
        trees = xs, dxs, [next(rest) if m else None for m in moving], moving
        at, along, given, which = (jax.tree.unflatten(self.tree, some).equations for some in trees)
        none = jax.tree.unflatten(self.tree, [jnp.zeros_like(x) if m else None for x, m in zip(xs, moving, strict=True)])
        if isinstance(at, Equations) and any(which.constants):
            leaves, tree = jax.tree.flatten((which.textbook.mechanism, which.textbook.baumgarte), is_leaf=lambda x: x is None)
            moved, constants = tuple(map(bool, leaves)), tuple(which.constants)
            bars = [bar for bar, m in zip(given.constants, constants, strict=True) if m]
            equations: Any = eqx.combine(at, self.rest.equations)
            found = iter(through_constants(equations, along, constants, moved, bars))
            mechanism, baumgarte = tree.unflatten([next(found) if m else None for m in moved])
            textbook = replace(none.equations.textbook, mechanism=mechanism, baumgarte=baumgarte)
            none = replace(none, equations=replace(none.equations, textbook=textbook))
        return jax.tree.leaves(none)


class Along(Function):
    """g(x, v) = J(x) v, with v of those of x that are moving."""

    of: Function
    moving: Mask = eqx.field(static=True)

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        return _change(self.of, xs, self.moving, vs)[1]

    def pull(self, xs: list[Array], moving: Mask, ws: list[Array]) -> list[Array]:
        xs, vs = self.parts(xs)
        of_x, of_v = moving[: len(xs)], moving[len(xs) :]
        either = tuple(a or b for a, b in zip(of_x, self.moving, strict=True))
        found, change = _change(lambda xs: self.of.pull(xs, either, ws), xs, self.moving, vs)
        change = those(change, tuple(x for x, e in zip(of_x, either, strict=True) if e))
        found = those(found, tuple(m for m, e in zip(self.moving, either, strict=True) if e))
        return [*change, *those(found, of_v)]

    def parts(self, xs: list[Array]) -> tuple[list[Array], list[Array]]:
        return xs[: len(self.moving)], xs[len(self.moving) :]

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return self.of.shapes(self.parts(xs)[0])


class Back(Along):
    """h(x, w) = J(x)^T w, of those of x that are moving."""

    def __call__(self, xs: list[Array]) -> list[Array]:
        xs, ws = self.parts(xs)
        return self.of.pull(xs, self.moving, ws)

    def pull(self, xs: list[Array], moving: Mask, ws: list[Array]) -> list[Array]:
        (xs, bars), directions = self.parts(xs), ws
        of_x, of_w = moving[: len(xs)], moving[len(xs) :]
        found = []
        if any(of_x):
            found += _change(lambda xs: self.of.pull(xs, of_x, bars), xs, self.moving, directions)[1]
        if any(of_w):
            found += those(_change(self.of, xs, self.moving, directions)[1], of_w)
        return found

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        return [x.shape for x in those(self.parts(xs)[0], self.moving)]


def _change(function: Callable, xs: list[Array], moving: Mask, vs: list[Array]) -> tuple[Any, Any]:
    """f(x), and its change along v, of those of x that are moving, by forward mode."""
    return jax.jvp(lambda *some: function(replaced(xs, moving, some)), those(xs, moving), vs)


# --- the linear map


class Linear(eqx.Module):
    """v -> J(x) v, or transposed w -> J(x)^T w, of those of x that are moving."""

    function: Function
    xs: list[Array]
    run: Any  # what evaluating it has left for its first derivatives; None: nothing
    moving: Mask = eqx.field(static=True)
    transposed: bool = eqx.field(static=True, default=False)

    @property
    def T(self) -> "Linear":
        return replace(self, transposed=not self.transposed)

    @property
    def inputs(self) -> list[tuple[int, ...]]:
        """The shapes of what it is applied to."""
        return self.function.shapes(self.xs) if self.transposed else [x.shape for x in those(self.xs, self.moving)]

    def applied(self, vs: list[Array]) -> list[Array]:
        return _split(_bind(self, _flat(vs)), self.T.inputs)


def _apply(linear: Linear, vector: Array) -> Array:
    function, vs = linear.function, _split(vector, linear.inputs)
    apply = function.backward if linear.transposed else function.forward
    return _flat(apply(linear.xs, linear.moving, vs, linear.run))


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
    moving = tuple(dx is not None for dx in dxs)
    further = Linear(kind(function.plain, linear.moving), [*linear.xs, *_split(vector, linear.inputs)], None, moving)
    slope = _bind(further, _flat(those(dxs, moving)))
    if linear.transposed:
        twice = function.counted_twice(linear.xs, at.xs, linear.moving, _split(found, linear.T.inputs))
        slope = slope if twice is None else slope - _flat(twice)
    return found, slope


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    linear, _ = inputs
    return jax.tree.map(lambda _: None, linear), _bind(linear.T, cotangent)


_linear_p = eqxi.create_vprim("derivative_of_a_run", eqxi.filter_primitive_def(_apply), _shape, _derivative, _transpose)


def _bind(linear: Linear, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_linear_p, linear, vector)


def those(xs: Sequence[Any], which: Mask) -> list[Any]:
    """Those that are marked."""
    return [x for x, m in zip(xs, which, strict=True) if m]


def replaced(xs: Sequence[Array], moving: Mask, some: Sequence[Array]) -> list[Array]:
    """The same, with others in place of those that are moving."""
    rest = iter(some)
    return [next(rest) if m else x for x, m in zip(xs, moving, strict=True)]


def _flat(xs: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x)) for x in xs])


def _split(vector: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends), shapes, strict=True)]


# --- runs and records


def _by_diffrax(problem: Problem, adjoint: str) -> Raw:
    import diffrax

    from udkjax.integrate.by_diffrax import by_diffrax

    return by_diffrax(problem, getattr(diffrax, adjoint)())


def _marched(problem: Problem) -> tuple[Raw, Record]:
    lanes = Lanes(problem.equations)
    m = march(task_of(problem, lanes, recorded=True), problem.q, problem.v, number_of(problem.equations))
    assert m.record is not None
    return raw_of(problem, lanes, m), m.record


def _recorded(problem: Problem) -> tuple[Raw, Record]:
    """A run and its record; under vmap records are left blank, not to fill the memory: `_pulled` makes each where it needs it."""
    arrays, static = eqx.partition(problem, eqx.is_array)

    def single(arrays: Any) -> tuple[Raw, Record]:
        return _marched(eqx.combine(arrays, static))

    one = custom_vmap(single)

    @one.def_vmap
    def _(size, batched, arrays):
        del size
        found = jax.eval_shape(single, jax.tree.map(lambda x, b: x[0] if b else x, arrays, batched[0]))
        every = jax.tree.map(lambda _: any(jax.tree.leaves(batched)), found[0])
        if not any(jax.tree.leaves(batched)):  # only tangents are
            return single(arrays), (every, jax.tree.map(lambda _: False, found[1]))
        raw = jax.vmap(lambda arrays: solve(eqx.combine(arrays, static)), (_axes(batched[0]),))(arrays)
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), found[1])
        return (raw, blank), (every, jax.tree.map(lambda _: False, blank))

    return one(arrays)


def _pulled(problem: Problem, moving: Problem, raw: Raw, record: Record, ys: Any, y: Any) -> Problem:
    """The cotangents of what is `moving`."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    moves = jax.tree.map(lambda x: x is not None, moving, is_leaf=lambda x: x is None)

    def single(arrays: Any, raw: Raw, record: Record, bars: Any) -> Problem:
        return walked_back(eqx.combine(arrays, static), eqx.filter(arrays, moves), raw, record, *bars)

    def again(arrays: Any, bars: Any) -> Problem:
        return single(arrays, *_marched(eqx.combine(arrays, static)), bars)

    return _of_members(single, again)(arrays, raw, record, (ys, y))


def _of_members(single: Callable, again: Callable) -> Callable:
    """`single(arrays, raw, record, bars)`; under vmap, where problems differ, `again(arrays, bars)` of one after another."""
    pulled = custom_vmap(lambda arrays, raw, record, bars: single(arrays, raw, record, bars))

    @pulled.def_vmap
    def _(size, batched, *inputs):
        if any(jax.tree.leaves(batched[0])):

            def member(k: Any) -> Problem:
                arrays, _, _, bars = jax.tree.map(lambda x, b: x[k] if b else x, inputs, tuple(batched))
                return again(arrays, bars)

            found = jax.lax.map(member, jnp.arange(size))
        elif any(jax.tree.leaves(batched[3])):  # of one problem; of one in a batch, if that of problems is the outer one
            axes = _axes(batched[3])
            found = _of_members(jax.vmap(single, (None, None, None, axes)), jax.vmap(again, (None, axes)))(*inputs)
        else:  # only tangents are
            found = single(*inputs)
        return found, jax.tree.map(lambda _: any(jax.tree.leaves(batched)), found)

    return pulled


def _axes(batched: Any) -> Any:
    return jax.tree.map(lambda b: 0 if b else None, batched)
