"""The derivation for one state, compared with NumPy, the paper's closed form and Gauss's principle."""

import json

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.friction import pendulum, rubbing

G = 9.81


@pytest.fixture(scope="module")
def found():
    return udk.explain(udk.library.parallelogram())


def test_the_numbers_of_the_paper_s_linkage_are_those_of_its_closed_form(found, data):
    """theta'' = -3.5 g cos(theta) / 3.05 at -45 degrees; lambda on link and ground as in the reference."""
    row = data("seed_fivebar_parallelogram")["cases"]["rest_-45deg"]["reference"]["0"]
    assert_allclose(found.a[[2, 5, 8]], float(row["thetadd"]), rtol=1e-12)
    ground, coupler = (np.array(row[f"{which}_joint_force_on_link"], float) for which in ("ground", "coupler"))
    assert_allclose(found.multipliers, np.concatenate([np.tile(-ground, 3), np.tile(-coupler, 3)]), atol=1e-10)
    assert found.rank == 11 and not found.unique.any()
    assert_allclose(found.a_F, [0, -G, 0] * 4)


def test_every_symbol_is_what_numpy_makes_of_the_ones_before(found):
    mass = np.array([1, 1, 0.1] * 3 + [2, 2, 0.2])
    D = found.psi_q / np.sqrt(mass)
    assert_allclose(found.mass, mass)
    assert_allclose(found.D, D, atol=1e-15)
    assert_allclose(found.D_plus, np.linalg.pinv(D, rcond=1e-10), atol=1e-13)
    assert_allclose(found.singular_values, np.linalg.svd(D)[1], atol=1e-14)
    assert_allclose(found.b, found.gamma - found.psi_q @ found.a_F, atol=1e-14)
    assert_allclose(found.a, found.a_F + np.linalg.pinv(D, rcond=1e-10) @ found.b / np.sqrt(mass), atol=1e-12)
    assert_allclose(found.constraint_force, mass * (found.a - found.a_F), atol=1e-12)
    assert_allclose(found.psi_q.T @ found.null_rows, 0.0, atol=1e-14)
    assert max(found.checks.values()) < 1e-13 and len(found.checks) == 6


def test_gauss_s_principle_is_shown_by_what_is_feasible(found):
    """G grows by half the square of any feasible deviation, as computed by hand along the linkage's only motion."""
    along = np.array([0.5 * np.sqrt(0.5), 0.5 * np.sqrt(0.5), 1.0] * 3 + [np.sqrt(0.5), np.sqrt(0.5), 0.0])
    assert_allclose(found.psi_q @ along, 0.0, atol=1e-15)

    def gauss(a):
        return 0.5 * np.sum(found.mass * (a - found.a_F) ** 2)

    assert_allclose(gauss(found.a), found.gauss.at_a, rtol=1e-13)
    for step in (-1.0, 1e-3, 2.0):
        assert_allclose(gauss(found.a + step * along), found.gauss.at_a + step**2 * 3.05 / 2, rtol=1e-12)
    assert found.gauss.free == 1 and found.gauss.slope < 1e-14
    assert found.gauss.at_a < found.gauss.least_rival < 1.01 * found.gauss.at_a


def test_the_text_reads_line_by_line(found):
    text = str(found)
    for words in (
        "five-bar parallelogram at t = 0 s",
        "A1 (x)  x . x . . . . . . . . .",
        "Rank of Psi_q: 11 of 12 rows; 12 coordinates - 11 = 1 degree of freedom",
        "B1: only the component of its force along 45 degrees is unique",
        "not unique",
        "Gauss's principle",
        "G(a) = 143.9597398",
        "other feasible accelerations is 143.9",
        ": larger.",
    ):
        assert words in text
    assert max(map(len, text.split("\n"))) < 160
    assert found._repr_html_().startswith("<pre>")
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert np.shape(data["D_plus"]) == (12, 12) and data["rows"][3] == "A2 (y)" and data["rank"] == 11


def test_a_driven_mechanism_with_rows_in_radians():
    """There is only one feasible acceleration, and all multipliers are unique. Baumgarte's terms go into b."""
    mechanism = udk.library.slider_crank(0.7)
    found = udk.explain(mechanism)
    assert found.rank == 9 and found.unique.all() and found.gauss.free == 0
    text = str(found)
    assert (
        "a is the only feasible acceleration" in text
        and "guide (angle)" in text
        and "motor (row 1)" in text
        and "All rows are independent" in text
    )
    state = udk.assemble(mechanism)
    a, multipliers = udk.accelerations(mechanism, 0.0, state.q, state.v, multipliers=True)
    assert_allclose(found.a, np.ravel(a), atol=1e-11)
    assert_allclose(found.multipliers, multipliers, atol=1e-10)
    gains = udk.Baumgarte(3.0, 4.0)
    fed = udk.explain(mechanism, stabilization=gains)
    assert_allclose(fed.b - found.b, -found.weights * (6 * found.psi_dot + 16 * found.psi), atol=1e-12)
    assert max(fed.checks.values()) < 1e-12


def test_tolerances_that_motions_needed():
    """The text has the ranges of all mechanisms of the atlas, and tolerances of mechanisms with this name."""
    text = str(udk.explain(udk.library.parallelogram())).partition("\n10. ")[2]
    assert "1e-07 for the paper's linkage, turning" in text and "error 1e-06: " in text and "crank-rocker" not in text
    other = str(udk.explain(udk.Mechanism({"stone": udk.Body(2.0, 1.0)}))).partition("\n10. ")[2]
    assert "error 1e-06: " in other and "linkage" not in other


def test_a_free_body_falls():
    found = udk.explain(udk.Mechanism({"stone": udk.Body(2.0, 1.0)}))
    assert_allclose(found.a, [0, -G, 0])
    assert found.gauss.at_a == 0.0 and "Gauss" in str(found)


def test_friction_of_joints_is_among_the_loads():
    """The accelerations and multipliers are those of `accelerations`, whose loads contain friction."""
    mechanism = pendulum(coefficient=0.3, radius=0.05, speed=0.01)
    v = np.array([[0.0, 1.0, 2.0]])
    found = udk.explain(mechanism, state=udk.State(mechanism.q0, v))
    a, multipliers = udk.accelerations(mechanism, 0.0, mechanism.q0, v, multipliers=True)
    assert_allclose(found.a, np.ravel(a), rtol=1e-12)
    assert_allclose(found.multipliers, multipliers, rtol=1e-12)
    assert max(found.checks.values()) < 1e-13 and found.gauss.slope < 1e-12
    rub = found.friction["rub"]
    assert rub.joint == "A" and rub.is_unique
    assert_allclose([rub.speed, rub.coefficient, rub.load], [0.1, 0.3 * np.tanh(40.0), np.linalg.norm(multipliers)], rtol=1e-12)
    assert_allclose(found.force, [0.0, -2 * G, -0.3 * 0.05 * rub.load], rtol=1e-12)
    assert "rub in A" in str(found) and json.loads(json.dumps(found.to_dict()))["friction"]["rub"]["is_unique"] is True


@pytest.mark.slow
def test_loads_of_friction_that_are_not_unique_are_marked():
    mechanism = rubbing(udk.library.parallelogram(), 0.2, 0.03)
    state = udk.assemble(mechanism)
    found = udk.explain(mechanism, state=state)
    verdict = udk.diagnose(mechanism, fixes=False, walk=False).friction
    assert {x.joint: x.is_unique for x in found.friction.values()} == {joint: x.load for joint, x in verdict.items()}
    assert "not unique: that of the minimum-norm solution" in str(found)
    assert_allclose(found.a, np.ravel(udk.accelerations(mechanism, 0.0, state.q, state.v)), rtol=1e-9, atol=1e-12)


def test_traced_numbers_are_refused():
    mechanism = udk.library.parallelogram()

    def ask(mass):
        udk.explain(mechanism.with_parameters({"body.coupler.mass": mass}))
        return mass

    with pytest.raises(ValueError, match="concrete numbers"):
        jax.jit(ask)(1.0)


def test_the_text_of_a_large_mechanism_fits_on_a_page_and_says_what_it_leaves_out():
    text = str(udk.explain(udk.library.chain(30)))
    assert len(text) < 30_000
    assert "and 48 rows and 72 columns more, in the fields of the explanation" in text
