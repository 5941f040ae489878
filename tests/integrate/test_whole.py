"""A run is few functions: what a compiled program starts one by one, for a microsecond each, is little."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

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
