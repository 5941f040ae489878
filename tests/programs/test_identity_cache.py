"""Results are cached by the identities of the objects from which they are computed."""

import gc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from udkjax.programs import identity_cache
from udkjax.programs.identity_cache import cached_by_identity


class Tree(eqx.Module):
    x: jax.Array


class Thing:
    """An object whose deletion can be observed."""


@pytest.fixture
def counted():
    calls = []

    @cached_by_identity
    def function(*args):
        calls.append(len(args))
        return object()

    return function, calls


def test_objects_are_told_apart_by_identity_and_numbers_by_value(counted):
    function, calls = counted
    one, two = np.zeros(3), np.zeros(3)
    assert function(one, 1.0, None, "a") is function(one, 0.5 + 0.5, None, "a")
    assert len(calls) == 1
    others = [function(two, 1.0, None, "a"), function(one, 1, None, "a"), function(one, True, None, "a"), function(one, 1.0)]
    assert len({function(one, 1.0, None, "a"), *others}) == 5 == len(calls)


def test_a_result_goes_with_its_object(counted):
    function, calls = counted
    things = [Thing() for _ in range(3)]
    for thing in things:
        function(thing)
    del thing, things[:]
    for _ in range(20):  # new objects take the places in memory of those that are gone
        function(Thing())
    assert len(calls) == 23


def test_what_cannot_be_watched_is_held(counted):
    """A list has no weak references, and so the cache keeps it: no other object gets its identity."""
    function, calls = counted
    for k in range(10):
        function([k])
    assert len(calls) == 10


def test_the_oldest_make_room(counted, monkeypatch):
    monkeypatch.setattr(identity_cache, "CACHE_SIZE", 2)
    function, calls = counted
    one, two, three = (Thing() for _ in range(3))
    for thing in (one, two, one, three, one):  # the second one was asked for longest ago
        function(thing)
    assert len(calls) == 3
    function(two)
    assert len(calls) == 4


@pytest.mark.slow
def test_results_of_traced_trees_hold_within_their_trace():
    """One computation for concrete numbers, and one in each trace. A trace within another one stores nothing of its own."""
    calls = []

    @cached_by_identity(within_trace=True)
    def doubled(tree):
        calls.append(0)
        return Tree(2 * tree.x)

    tree = Tree(jnp.arange(3.0))
    assert doubled(tree) is doubled(tree) and len(calls) == 1

    @jax.jit
    def outer(tree):
        assert doubled(tree) is doubled(tree)
        inner = jax.vmap(lambda y: doubled(tree).x.sum() + y)(tree.x)
        other = Tree(tree.x + 1)
        before = len(calls)
        again = jax.vmap(lambda y: doubled(other).x.sum() * y)(tree.x)
        doubled(other)
        assert len(calls) == before + 1  # numbers without a batch axis are computed once
        third = Tree(tree.x + 2)
        assert jax.jit(lambda: doubled(third).x)() is not doubled(third).x and len(calls) == before + 3
        return inner + again + doubled(other).x + doubled(tree).x

    with jax.checking_leaks():
        found = outer(tree)
    assert_allclose(found, 6 + np.arange(3.0) + 12 * np.arange(3.0) + 2 * (np.arange(3.0) + 1) + 2 * np.arange(3.0))
    del tree
    gc.collect()
    assert doubled(Tree(jnp.ones(3))).x[0] == 2
