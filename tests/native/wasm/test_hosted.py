"""Functions of JAX that call functions of their host, as WebAssembly."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_array_equal

from tests.wasm_host import Host
from udkjax.native.wasm import hosted_module

A, B = np.random.default_rng(0).standard_normal((2, 5))


def evaluate(host, a, b):
    """Calls in a loop, in a branch, and at an empty argument."""

    def once(k, x):
        return x + host["turn"](x, b)[:5] * k

    a = jax.lax.fori_loop(0, 4, once, a)
    more = jax.lax.cond(jnp.sum(a) > jnp.sum(b), lambda: host["size"](a), lambda: jnp.zeros(1))
    return {"a": b, "b": a, "more": more}  # the new values are each other's old ones


def turn(a, b):
    return np.concatenate([a[::-1] * b, a + b])


def size(a):
    return np.array([np.abs(a).max()])


def test_a_function_calls_its_host():
    imports = {"turn": ({"first": (5,), "second": (5,)}, 10), "size": ({"first": (5,)}, 1)}
    module = hosted_module({"evaluate": evaluate}, {"a": (5,), "b": (5,)}, imports)
    calls = []

    def part(name):
        place, shape = module.places[name]
        return host.numbers(start + 8 * place, math.prod(shape)).copy()

    def write(name, numbers):
        host.memory.write(host.store, np.asarray(numbers, float).tobytes(), start + 8 * module.places[name][0])

    def asked(name, function):
        def answer(address):
            assert address == start
            calls.append(name)
            write(name, function(*(part(x) for x in imports[name][0])))

        return answer

    host = Host(module.linked.code, module.linked.data_end, {"turn": asked("turn", turn), "size": asked("size", size)})
    host.begin()
    start = host.put(np.full(module.size, np.nan))  # memory that was never written
    write("a", A)
    write("b", B)
    host.call("evaluate", start)
    with jax.disable_jit():
        by_numpy = {"turn": lambda *x: jnp.asarray(turn(*map(np.asarray, x))), "size": lambda a: jnp.asarray(size(np.asarray(a)))}
        expected = evaluate(by_numpy, jnp.asarray(A), jnp.asarray(B))
    assert calls[:4] == ["turn"] * 4
    for name in ("a", "b", "more"):
        assert_array_equal(part(name), expected[name])
