"""Quantities of concrete numbers, by NumPy on the scene's programs, against the traced functions."""

import tracemalloc
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import udkjax as udk
from udkjax.equations.states import state_arrays


def history(mech, count, seed=0):
    """Random states near the guess, the last of them lost."""
    random = np.random.default_rng(seed)
    q, v = (np.asarray(mech.q0) + 0.05 * random.standard_normal((count, *mech.q0.shape)) for _ in range(2))
    q[-1] = v[-1] = np.nan
    return SimpleNamespace(ts=np.linspace(0.0, 1.0, count), q=q, v=v)


def test_reactions_take_little_memory_besides_their_results(monkeypatch):
    """Psi_q of an output takes 1.2 kB, and the results half of that."""
    mech = udk.library.parallelogram()
    udk.reactions(mech, history(mech, 2))
    monkeypatch.setattr(state_arrays, "PIECE_BYTES", 2**18)
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
