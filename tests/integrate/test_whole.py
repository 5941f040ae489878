"""A run is few functions: what a compiled program starts one by one, for a microsecond each, is little."""

import re
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.custom_derivatives import SymbolicZero

import udkjax as udk
from udkjax.integrate.lanes import LANES
from udkjax.integrate.packing import Packing

SEQUENTIAL = 8  # operations that XLA does one after the other in the same thread, however large their arrays
READY = 9  # so does it of more, where no more than these wait for nothing
NOTHING = re.compile(r" (parameter|constant|tuple|get-tuple-element|bitcast)\(")
TS = jnp.linspace(0.0, 2.0, 41)


def started(text: str) -> dict[str, list[str]]:
    """The operations of each computation that has some; those that are compiled into one function are one."""
    found: dict[str, list[str]] = {}
    for block in re.split(r"\n\n", text):
        lines = [line.strip() for line in block.splitlines()[1:] if " = " in line]
        name = re.match(r"(ENTRY )?%?([\w.\-]+)", block)
        if name:
            found["ENTRY" if name[1] else name[2]] = [line for line in lines if not NOTHING.search(line)]
    return found


def ready(entry: str) -> int:
    """How many operations of the program wait for no other."""
    given, count = set(), 0
    for line in entry.splitlines():
        match = re.match(r"\s*(?:ROOT )?(%[\w.\-]+) = .*? ([a-z\-]+)\((.*?)\)[,\s]", line + " ")
        if match and all(name in given for name in re.findall(r"%[\w.\-]+", match[3])):
            waits = match[2] not in ("parameter", "constant", "tuple", "get-tuple-element", "bitcast")
            count += waits
            given |= set() if waits else {match[1]}
    return count


@pytest.mark.skipif(jax.__version_info__ < (0, 12), reason="older versions of XLA fuse otherwise")
@pytest.mark.parametrize("derived, count", [(lambda f: f, 2), (lambda f: f, 8), (jax.jacfwd, 2)])
def test_what_waits_for_nothing_is_handed_to_no_other_thread(derived, count):
    """Of a run with some or all masses and inertias traced, and of its derivative by many."""
    mechanism = udk.library.parallelogram()
    names = [f"body.{body}.{name}" for name in ("mass", "inertia") for body in mechanism.body_names]

    def angle(values):
        changed = mechanism.with_parameters(dict(zip(names, values, strict=False)))
        start, forward = udk.State(mechanism.q0, mechanism.v0), diffrax.ForwardMode()
        return udk.simulate(changed, TS[:2], start, adjoint=forward, throw=False).q[-1, 0, 2]

    text = jax.jit(derived(angle)).lower((1.0,) * count).compile().as_text() or ""
    assert 0 < ready(text.split("\nENTRY")[1]) <= READY


def test_a_run_walked_back_starts_few_operations():
    """Also where there is one output alone: no loop over those, but one function."""
    mechanism = udk.library.parallelogram()

    def angle(mass):
        changed = mechanism.with_parameters({"body.link1.mass": mass})
        return udk.simulate(changed, TS[:2], udk.State(mechanism.q0, mechanism.v0), throw=False).q[-1, 0, 2]

    assert len(started(jax.jit(jax.grad(angle)).lower(1.0).compile().as_text() or "")["ENTRY"]) <= 40


def compiled(mechanism):
    run = lambda state, tol: udk.simulate(mechanism, TS, state, tol, tol, throw=False).q  # noqa: E731
    return started(jax.jit(run).lower(udk.assemble(mechanism), jnp.asarray(1e-8)).compile().as_text() or "")


def test_a_run_starts_few_operations():
    """The steps are one function, the outputs another; only steps that want care are in neither."""
    computations = compiled(udk.library.parallelogram())
    entry = computations["ENTRY"]
    assert len(entry) <= 26
    assert sum("xla_cpu_small_call" in line for line in entry) == 1
    loops = [name for line in entry if " while(" in line for name in re.findall(r"body=%?([\w.\-]+)", line)]
    assert len(loops) == 1
    for body in loops:
        assert len(computations[body]) <= SEQUENTIAL
        assert sum("xla_cpu_small_call" in line for line in computations[body]) == 1


@pytest.mark.skipif(jax.__version_info__ < (0, 12), reason="older versions of XLA know no such loops")
def test_lanes_of_many_coordinates_are_one_function_too():
    """Of reductions over 4,096 numbers and more XLA would make calls of a library, which no such function can hold."""
    count = 1 + 4096 // (2 * 3 * LANES)
    rods = {f"rod{k}": udk.Body(2.0, 0.4, position=[k, -0.75]) for k in range(count)}
    pins = {f"pin{k}": udk.Revolute(["ground", f"rod{k}"], [[k, 0.0], [0.0, 0.75]]) for k in range(count)}
    mechanism = udk.Mechanism(rods, pins)
    start = udk.State(mechanism.q0, mechanism.v0)
    run = jax.vmap(lambda tol: udk.simulate(mechanism, TS[:2], start, tol, tol, throw=False).q)
    computations = started(jax.jit(run).lower(np.full(LANES, 1e-8)).compile().as_text() or "")
    in_lanes = [line for lines in computations.values() for line in lines if f"[{3 * count},{LANES}]" in line]
    assert any("xla_cpu_small_call" in line for line in in_lanes)


def test_what_is_packed_is_unpacked():
    tree = {"vector": np.arange(2.0), "number": 0.1, "count": 7, "flag": True, "other": (np.full(4, 2.5), False)}
    tree = jax.tree.map(jnp.asarray, tree)
    packing = Packing(tree)
    packed = packing.pack(tree)
    assert len(packed) == 3  # vectors, numbers, counts
    found = packing.unpack(packed)
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(tree), strict=True):
        assert x.dtype == y.dtype and x.shape == y.shape
        np.testing.assert_array_equal(x, y)


def test_only_what_has_a_tangent_is_packed_with_one():
    """Numbers that are no vectors keep to themselves: where times do not move, neither do step sizes."""
    tree = {"q": jnp.ones(2), "t": jnp.asarray(3.0), "n": jnp.asarray(1)}
    packing, moved = Packing(tree), []

    @jax.custom_jvp
    def seen(*packed):
        return packed

    @partial(seen.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        moved.extend(not isinstance(dx, SymbolicZero) for dx in tangents)
        return primals, tangents

    jax.jvp(lambda q: seen(*packing.pack({**tree, "q": q})), (tree["q"],), (tree["q"],))
    found = {str(x.dtype) + str(x.shape): m for x, m in zip(packing.pack(tree), moved, strict=True)}
    assert found == {"float64(2,)": True, "float64(1,)": False, "int64(1,)": False}
