"""Quantities of concrete numbers, by NumPy on the scene's programs, against the traced functions."""

import tracemalloc
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import udkjax as udk
from tests.quantities import QUANTITIES, arguments
from udkjax.equations.states import state_arrays

SCENES = {
    "redundant": lambda: udk.library.parallelogram(),
    "driven": lambda: udk.library.planetary_gear(),
    "loaded": lambda: udk.library.andrews_squeezer(),
    "unconstrained": lambda: udk.Mechanism({"a": udk.Body(1.0, 0.1, [0.5, 0.1])}),
}


def history(mech, count, seed=0):
    """Random states near the guess, the last of them lost."""
    random = np.random.default_rng(seed)
    q, v = (np.asarray(mech.q0) + 0.05 * random.standard_normal((count, *mech.q0.shape)) for _ in range(2))
    q[-1] = v[-1] = np.nan
    return SimpleNamespace(ts=np.linspace(0.0, 1.0, count), q=q, v=v)


@pytest.mark.parametrize("name", ["redundant", *(pytest.param(n, marks=pytest.mark.slow) for n in SCENES if n != "redundant")])
def test_quantities_of_concrete_numbers_are_those_of_the_textbook(name, monkeypatch):
    mech = SCENES[name]()
    states = history(mech, 4)
    t, q, v = 0.3, states.q[1], states.v[1]
    stabilized: Any = {"stabilization": udk.Baumgarte(3.0, 4.0)}

    def found():
        return (
            udk.violation(mech, states),
            udk.energy(mech, states),
            udk.efforts(mech, states),
            udk.accelerations(mech, t, q, v, multipliers=True, **stabilized),
            udk.reactions(mech, states, **stabilized),
            udk.reactions(mech, states, frame="joint", about="joint"),
            udk.unique_reactions(mech, states, frame="body"),
            udk.singular_values(mech, t, q),
            udk.uniqueness(mech, t, q),
            [f(mech, *arguments(f, t, q, v)) for f in QUANTITIES.values()],
        )

    by_numpy = found()
    for module in ("quantities", "reactions", "evaluate"):
        monkeypatch.setattr(import_module(f"udkjax.equations.states.{module}"), "by_numpy", lambda *given: False)
    traced = found()
    assert jax.tree.structure(by_numpy) == jax.tree.structure(traced)
    for x, y in zip(jax.tree.leaves(by_numpy), jax.tree.leaves(traced), strict=True):
        assert isinstance(x, jax.Array) and (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, atol=1e-12 * max(1.0, np.nanmax(np.abs(y), initial=0.0)))


def test_reactions_take_little_memory_besides_their_results(monkeypatch):
    """Psi_q of an output takes 1.2 kB, and the results half of that."""
    mech = udk.library.parallelogram()
    udk.reactions(mech, history(mech, 2))
    monkeypatch.setattr(state_arrays, "PIECE", 2**18)
    states = history(mech, 3000)
    tracemalloc.start()
    found = udk.reactions(mech, states)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3000 * 2000
    assert sum(x.nbytes for x in jax.tree.leaves(found)) == 3000 * 9 * 24


def test_quantities_of_traced_numbers_are_traced():
    mech = udk.library.parallelogram()
    states = SimpleNamespace(**{name: x[:-1] for name, x in vars(history(mech, 3)).items()})
    slope = jax.grad(lambda x: udk.energy(mech.with_parameters({"body.link1.mass": x}), states).potential[0])(1.0)
    assert slope == pytest.approx(9.81 * states.q[0, 0, 1], rel=1e-12)
