import warnings

import numpy as np
import pytest

import udkjax as udk
from udkjax.positions.assembling.assembly import AssemblyWarning

MECH = udk.library.four_bar()


def test_a_mistyped_guess_is_said():
    """With the rocker's centre mistyped by 0.3 m it closes. `check` names what moved, and the run warns."""
    place = np.asarray(MECH.bodies["rocker"].position) + [0.3, 0.0]
    wrong = MECH.with_parameters({"body.rocker.position": place})
    found = udk.check(wrong)
    assert found.closed and [text.split(" by ")[0] for text in found.moved][-1] == "assembly moved rocker"
    q = np.asarray(udk.assemble(wrong).q) - np.asarray(wrong.q0)
    assert f"by {np.hypot(*q[2, :2]):.2g} m and {np.degrees(abs(q[2, 2])):.2g} deg" in found.moved[-1]
    assert found.moved[-1].removeprefix("assembly ") in repr(found)
    with pytest.warns(AssemblyWarning, match="assembly moved rocker by"):
        udk.simulate(wrong, [0.0, 0.01])


def test_a_slide_that_does_not_turn_is_said_without_an_angle():
    mech = udk.Mechanism(
        {"block": udk.Body(1.0, 0.1, (0.3, 0.5), 0.7)}, {"guide": udk.Prismatic(("ground", "block"), [(0, 0), (0, 0)], axis=0.0)}
    )
    assert udk.check(mech).moved == ("assembly moved block by 0.5 m",)


def test_rounding_is_not():
    near = MECH.with_parameters({"body.rocker.position": np.asarray(MECH.bodies["rocker"].position) + 1e-3})
    assert udk.check(near).moved == () == udk.check(MECH).moved
    late = udk.library.slider_crank()  # which its driver has moved by then
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        udk.simulate(near, [0.0, 0.01])
        udk.simulate(late, [0.4, 0.41])
