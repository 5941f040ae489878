"""Large scenes, whose redundant rows are found, and which are closed, by sparse arithmetic."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.equations import prepare, redundancy


def side_by_side(one, copies, off=0.0):
    """Copies of a mechanism in one scene, each body's place off by a little."""
    random, bodies, joints = np.random.default_rng(0), {}, {}
    for k in range(copies):
        bodies |= {
            f"{k} {n}": udk.Body(b.mass, b.inertia, b.position + off * random.standard_normal(2), b.angle)
            for n, b in one.bodies.items()
        }
        joints |= {
            f"{k} {n}": udk.Revolute([body if body == "ground" else f"{k} {body}" for body in j.bodies], j.points)
            for n, j in one.joints.items()
        }
    return udk.Mechanism(bodies, joints)


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
def test_sparse_analysis_finds_as_many_rows_as_singular_values_which_do_as_well(name, monkeypatch):
    """At every position that the other has seen, what stays is as far from dependent as what the other leaves."""
    mech, choose = REDUNDANT[name](), redundancy.kinematic_rows
    q, found = np.asarray(mech.q0).ravel(), []
    for size in (False, True):
        monkeypatch.setattr(redundancy, "kinematic_rows", lambda mech, size=size: choose(mech, size))
        found.append(redundancy.redundant_rows(mech))
    dense = choose(mech, False)
    null_spaces = [p.null_space for p in redundancy.sample_positions(dense, q) if p.smallest > redundancy.ORDINARY_TOL]
    assert len(found[0]) == len(found[1]) == null_spaces[0].shape[1]
    one, other = (min(np.linalg.svd(N[list(rows)])[1][-1] for N in null_spaces) for rows in found)
    assert one > 0.05 and other > 0.2 * one


@pytest.mark.slow
def test_a_large_scene_is_closed_and_its_redundant_rows_are_found():
    """Thirty linkages side by side, their guesses off: a row of each is left out, and all of them are closed."""
    one = udk.library.parallelogram(-0.6)
    mech = side_by_side(one, 30, 0.01)
    redundant = udk.analyse(mech).redundant_rows
    assert redundant is not None and len(redundant) == 30
    assert {row // 12 for row in redundant} == set(range(30))
    equations = prepare(mech)
    state = udk.assemble(mech)
    psi, psi_dot = equations.violation(0.0, state.q.ravel(), state.v.ravel())
    assert jnp.abs(psi).max() < 1e-12 and jnp.abs(psi_dot).max() < 1e-12
    a = udk.accelerations(mech, 0.0, state.q, state.v)
    for k in (0, 29):
        part = slice(4 * k, 4 * k + 4)
        expected = udk.accelerations(one, 0.0, state.q[part], state.v[part])
        assert_allclose(a[part], expected, atol=1e-9)


# --- whole runs


@pytest.mark.slow
def test_a_chain_of_a_thousand_links_keeps_its_energy():
    mech = udk.library.chain(1000, np.pi / 3)
    sol = udk.simulate(mech, jnp.linspace(0.0, 0.05, 3))
    energy = udk.energy(mech, sol)
    assert jnp.abs(udk.violation(mech, sol)).max() < 1e-12
    assert energy.kinetic[-1] > 0.05
    assert jnp.abs(energy.total - energy.total[0]).max() < 1e-9 * energy.kinetic[-1]
