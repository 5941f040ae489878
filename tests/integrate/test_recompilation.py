"""One compiled program serves all values of all numbers. JAX's own counts are used."""

from typing import NamedTuple

import numpy as np
import pytest

import udkjax as udk


class Motion(NamedTuple):
    """The states of which energies and violations are computed."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray


TS = np.linspace(0.0, 0.2, 5)


@pytest.fixture(scope="module")
def mechanisms():
    """The same structure with two sets of numbers, the second one assembled from another guess."""
    mech = udk.library.double_pendulum()
    names = list(mech.bodies)
    numbers = {f"body.{names[0]}.mass": 2.5, f"body.{names[1]}.inertia": 0.4, "gravity": [0.3, -4.0]}
    return mech, mech.with_parameters(numbers | {f"body.{names[0]}.angle": float(mech.bodies[names[0]].angle) + 0.2})


CHOICES = {
    "by default": lambda k, mech: {"rtol": 10.0 ** -(6 + k), "atol": 10.0 ** -(7 + k), "drift_tol": 1e-4 * (k + 1)},
    "by Baumgarte and rank from a state": lambda k, mech: {
        "state": udk.assemble(mech, state=udk.State(mech.q0 + 0.1 * k, mech.v0)),
        "stabilization": udk.Baumgarte(2.0 + k, 3.0 - k),
        "method": udk.Elimination(rank_tol=1e-5 * (1 + k)),
        "dt0": 0.01 / (1 + k),
    },
}


@pytest.mark.parametrize("choices", CHOICES.values(), ids=CHOICES)
def test_a_simulation_with_other_numbers_compiles_nothing(mechanisms, compilations, choices):
    def run(k: int):
        solutions.append(udk.simulate(mechanisms[k], TS * (1 + k), **chosen[k]))

    chosen, solutions = [choices(k, mech) for k, mech in enumerate(mechanisms)], []
    run(0)
    assert compilations(lambda: run(1)) == []
    assert np.abs(np.asarray(solutions[0].q) - np.asarray(solutions[1].q)).max() > 0.01


def test_what_is_asked_of_a_motion_compiles_nothing_for_other_numbers(mechanisms, compilations):
    def ask(k: int):
        mech = mechanisms[k]
        state = udk.assemble(mech)
        udk.accelerations(mech, 0.1 * k, state.q, state.v, udk.Elimination(rank_tol=1e-5 * (1 + k)))
        motion = Motion(TS * (1 + k), *(np.repeat(np.asarray(x)[None], len(TS), 0) for x in (state.q, state.v)))
        energies.append(udk.energy(mech, motion).total)
        udk.violation(mech, motion)
        udk.reactions(mech, motion)

    energies = []
    ask(0)
    assert compilations(lambda: ask(1)) == []
    assert np.abs(np.asarray(energies[0]) - np.asarray(energies[1])).min() > 0.01
