"""Large scenes are closed, and their redundant rows found, by sparse arithmetic."""

import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.equations.rows import redundancy
from udkjax.equations.rows.position_rows import GENERIC_TOL

# --- redundant rows


def copied(mech, seed, copies=3):
    random, joints = np.random.default_rng(seed), dict(mech.joints)
    joints |= {f"copy{k}": joints[name] for k, name in enumerate(random.choice(list(joints), copies))}
    return udk.Mechanism(mech.bodies, joints, mech.drivers, mech.forces)


FAST = ("scissor lift", "linkage, copied")
REDUNDANT = {
    "linkage": lambda: udk.library.parallelogram(),
    "scissor lift": lambda: udk.library.scissor_lift(),
    "linkage, copied": lambda: copied(udk.library.parallelogram(), 0),
    "gear, copied": lambda: copied(udk.library.planetary_gear(3), 3),
}


@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in REDUNDANT])
def test_sparse_analysis_finds_as_many_rows_as_singular_values_which_do_as_well(name):
    """At every position of the dense analysis, the retained rows are as far from dependence as those that it retains."""
    mech = REDUNDANT[name]()
    q, found = np.asarray(mech.q0).ravel(), [redundancy.redundant_rows(mech, large) or () for large in (False, True)]
    dense = redundancy.kinematic_rows(mech, False)
    null_spaces = [p.null_space for p in dense.sample(q) if p.smallest > GENERIC_TOL]
    assert len(found[0]) == len(found[1]) == null_spaces[0].shape[1]
    one, other = (min(np.linalg.svd(N[list(rows)])[1][-1] for N in null_spaces) for rows in found)
    assert one > 0.05 and other > 0.2 * one


# --- whole runs


@pytest.mark.slow
def test_a_chain_of_a_thousand_links_keeps_its_energy():
    mech = udk.library.chain(1000, np.pi / 3)
    sol = udk.simulate(mech, jnp.linspace(0.0, 0.05, 3))
    energy = udk.energy(mech, sol)
    assert jnp.abs(udk.violation(mech, sol)).max() < 1e-12
    assert energy.kinetic[-1] > 0.05
    assert jnp.abs(energy.total - energy.total[0]).max() < 1e-9 * energy.kinetic[-1]
