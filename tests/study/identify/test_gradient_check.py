"""Derivatives compared with differences: right ones agree at any tolerance; wrong ones are found and located."""

from typing import Any

import jax
import numpy as np
import pytest

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.integrate.solution import Result
from udkjax.study.identify.answers.gradient_check import compare_gradients
from udkjax.study.identify.identification import identify
from udkjax.study.identify.problem.fit_problem import FitProblem, build_problem
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.search.shooting import MultipleShooting

DATA = {"time": TS, ANGLE: np.zeros(len(TS))}
FIRST = 0.5, 0.15


def exact():
    """The derivatives of the pendulum's angle, as exact as integration allows."""
    mech = pendulum(*FIRST)
    problem = FitProblem(mech, unknowns_of(mech, NAMES), [udk.Record(TS, {ANGLE: DATA[ANGLE]})])
    return problem.evaluate(np.zeros((1, 2)), (1e-13, 1e-13)).J[0]


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-3, 1e-5, 1e-8, 1e-11, 1e-13])
def test_right_derivatives_agree_at_any_tolerance(tol):
    check = udk.check_gradients(pendulum(*FIRST), DATA, NAMES, tol=tol)
    assert check.ok and check.agrees.shape == (5, 1)
    assert check.message == "derivatives agree with finite differences, to within the errors of both"
    slopes = check.directions @ exact().T
    assert check.size[:, 0] == pytest.approx(np.sqrt(np.mean(slopes**2, 1)), rel=0.03)
    # The floor is no higher than it has to be, and known before anything is compared.
    relative = check.floor / check.size
    assert (relative < max(300.0 * tol, 1e-8)).all() and (relative > 1e-12).all()
    # Most directions are off by 0.5 to 1 times the floor; the second one by 0.2 to 3 times, depending on rounding.
    assert np.median(check.ratio) < 1.0


@pytest.mark.slow
def test_errors_of_the_derivatives_themselves_are_measured():
    check = udk.check_gradients(pendulum(*FIRST), DATA, NAMES, tol=1e-7)
    mech = pendulum(*FIRST)
    problem = FitProblem(mech, unknowns_of(mech, NAMES), [udk.Record(TS, {ANGLE: DATA[ANGLE]})])
    off = problem.evaluate(np.zeros((1, 2)), (1e-7, 1e-7)).J[0] - exact()
    assert check.derivative_error[:, 0] == pytest.approx(np.sqrt(np.mean((check.directions @ off.T) ** 2, 1)), rel=0.05)


def test_at_an_estimate_nothing_is_compiled(measured, compilations):
    estimate = identify(pendulum(*FIRST), {"time": TS, ANGLE: measured[1]}, NAMES, progress=False)
    found = []
    assert compilations(lambda: found.append(estimate.check_gradients())) == []
    assert found[0].ok and found[0].tol == estimate.tol and found[0].names[:2] == NAMES


def test_a_table_says_it(measured):
    check = udk.check_gradients(pendulum(*FIRST), DATA, NAMES)
    lines = str(check).splitlines()
    assert "1e-11" in lines[0] and lines[1].split()[:2] == ["direction", "size"] and "worst in" not in lines[1]
    assert [line.split()[0] for line in lines[2:4]] == list(NAMES) and all(line.endswith("agrees") for line in lines[2:7])
    assert lines[7:] == [check.message]


# --- wrong ones


def wrong(by, value=lambda x: x):
    """A function with a wrong derivative."""
    function = jax.custom_jvp(value)

    @function.defjvp
    def _(primals, tangents):
        return value(primals[0]), by(tangents[0])

    return function


SLIGHTLY = wrong(lambda t: 1.00001 * t)  # which takes a small tolerance to be seen
AT_ONE_TIME, NO_NUMBER = wrong(lambda t: t.at[17].mul(1.01)), wrong(lambda t: t.at[5].set(np.nan))
MADE_UP = wrong(lambda t: t, lambda x: 0.0 * x)


def _inertia(mechanism, value):
    return mechanism.with_parameters({NAMES[0]: SLIGHTLY(value)})


def _angle(solution):
    return solution.q[:, 0, 2]


QUANTITIES = [
    udk.Quantity("wrong", lambda mechanism, solution: AT_ONE_TIME(_angle(solution)), "rad"),
    udk.Quantity("still", lambda mechanism, solution: 0.0 * _angle(solution)),
    udk.Quantity("made up", lambda mechanism, solution: MADE_UP(_angle(solution))),
    udk.Quantity("no number", lambda mechanism, solution: NO_NUMBER(_angle(solution))),
]


@pytest.fixture(scope="module")
def wrong_problem():
    mech = pendulum(*FIRST)
    parameters = [udk.Parameter(_inertia, "mine", guess=FIRST[0], transform="positive"), NAMES[1]]
    values: dict[str | udk.Quantity, Any] = dict.fromkeys([ANGLE, *QUANTITIES], DATA[ANGLE])
    return FitProblem(mech, unknowns_of(mech, parameters), [udk.Record(TS, values)])


def test_wrong_derivatives_are_found(wrong_problem):
    check = compare_gradients(wrong_problem, np.zeros(2), (1e-11, 1e-11))
    assert not check.ok and [name for _, name in check.series] == [ANGLE, "wrong", "still", "made up", "no number"]
    assert (
        check.agrees.tolist()
        == [[False, False, True, False, False], [True, False, True, False, False]] + [[False, False, True, False, False]] * 3
    )
    inertia = check.discrepancy[0, 0] / check.size[0, 0]
    assert inertia[2:5] == pytest.approx([1e-5] * 3, rel=1e-2)
    for s, time, factor in ((1, 17, 1.01), (4, 5, np.nan)):
        place = check.places[1][s]
        assert place[:3] == (0, check.series[s][1], TS[time])
        assert place.derivative == pytest.approx(factor * place.difference, rel=1e-6, nan_ok=True)
    assert check.places[1][3].difference == 0.0 != check.places[1][3].derivative
    assert np.isnan(check.ratio[1]).tolist() == [False, False, False, False, True] and check.worst[1] == 4


def test_what_is_wrong_is_told_with_its_place(wrong_problem, monkeypatch):
    """The place is in the series with the worst agreement, here one of two."""
    series = wrong_problem.series()[:2]
    monkeypatch.setattr(wrong_problem, "series", lambda: series)
    check = compare_gradients(wrong_problem, np.zeros(2), (1e-11, 1e-11))
    lines = str(check).splitlines()
    assert lines[1].split()[1:3] == ["worst", "in"] and all(line.endswith("DIFFERS") for line in lines[2:7])
    assert lines[3].split()[:2] == [NAMES[1], "wrong"]
    assert f"{NAMES[1]}: at t = {TS[17]:.6g} s of wrong the derivative is" in check.message


def test_what_is_below_the_floor_is_not_said_to_be_wrong(wrong_problem):
    check = compare_gradients(wrong_problem, np.zeros(2), (1e-4, 1e-4))
    assert check.agrees[:, 0].all() and (check.floor > 2e-5 * check.size)[:, 0].all()


# --- runs that fail


@pytest.fixture
def failing(monkeypatch):
    """A problem whose runs fail beyond some distance."""
    mech = pendulum(*FIRST)
    problem = FitProblem(mech, unknowns_of(mech, NAMES), [udk.Record(TS, {ANGLE: DATA[ANGLE]})])
    row_blocks = problem.row_blocks

    def beyond(distance):
        def limited(z, tol):
            fails = np.linalg.norm(z, axis=1) > distance
            for found in row_blocks(z, tol):
                r = np.where(fails[:, None], np.nan, found.r)
                yield found._replace(r=r, code=np.where(fails, int(Result.step_limit), found.code))

        monkeypatch.setattr(problem, "row_blocks", limited)
        return problem

    return beyond


def test_steps_that_fail_are_left_out(failing):
    check = compare_gradients(failing(1e-3), np.zeros(2), (1e-10, 1e-10))
    assert check.ok and (check.step < 1e-3).all() and np.isnan(check.discrepancy[:, :, check.steps > 1e-3]).all()


def test_where_all_steps_fail_nothing_is_claimed(failing):
    check = compare_gradients(failing(1e-8), np.zeros(2), (1e-10, 1e-10))
    assert not check.ok and check.message.startswith("all directions: cannot") and "runs with nearby values fail" in check.message
    assert "unknown" in str(check)


def test_where_the_motion_fails_there_is_nothing_to_check(failing):
    with pytest.raises(udk.IdentificationError, match="no derivatives to check"):
        compare_gradients(failing(-1.0), np.zeros(2), (1e-10, 1e-10))


def test_mistakes_are_those_of_an_identification():
    with pytest.raises(udk.IdentificationError, match=r"body.rod.inertia"):
        udk.check_gradients(pendulum(), DATA, ["body.rod.inrtia"])


# --- what takes long to compile


@pytest.mark.slow
@pytest.mark.parametrize("angle", [-np.pi / 4, np.pi / 3 + 1e-3])
def test_redundant_linkages_and_singular_configurations(angle):
    """From pi/3 the parallelogram passes through the configuration where it could change over to its other branch.

    From pi/3 itself an output lies 2e-5 rad from it, where derivatives through its projection lose a digit. From there on to
    0.03 rad from it, tighter tolerances gain nothing below some 1e-5: 2e-6 to 1.3e-5 were seen at 1e-11.
    """
    least = 3e-5 if angle > 0.0 else 0.0
    ts = np.linspace(0.0, 5.0, 101)
    names = ["length(link1, link2, link3)", "body.link1.mass = body.link2.mass = body.link3.mass"]
    data = {"time": ts, "body.link1.angle": 0.0 * ts}
    for tol, most in ((1e-3, 0.1), (1e-5, 1e-3), (1e-7, 1e-4), (1e-9, 1e-5), (1e-11, 1e-6)):
        check = udk.check_gradients(udk.library.parallelogram(angle=angle), data, names, tol=tol)
        assert check.ok and (check.floor < max(most, least) * check.size).all(), str(check)


@pytest.mark.slow
def test_along_chaotic_motion_nothing_is_claimed_but_of_pieces():
    """Derivatives are 1e8: a change in the ninth digit leads to another motion. A piece is as regular as any other motion."""
    mech, tol = udk.library.double_pendulum(), (1e-11, 1e-11)
    for end, ok in ((3.0, True), (20.0, False)):
        ts = np.linspace(0.0, end, 200)
        angle = np.asarray(udk.simulate(mech, ts, rtol=1e-11, atol=1e-11).q)[:, 1, 2]
        problem = build_problem(mech, {"time": ts, "body.lower.angle": angle}, ["body.lower.mass", "body.upper.inertia"], {})
        check = compare_gradients(problem, np.zeros(2), tol)
        assert check.ok is ok and (ok or "do not converge" in check.message), str(check)
    shooting = MultipleShooting(problem, np.zeros(2), (1e-9, 1e-9))  # pyright: ignore[reportPossiblyUnboundVariable]
    check = compare_gradients(shooting, shooting.guess, tol)
    assert check.ok and len(check.names) == 2 + 3 and (check.floor < 1e-6 * check.size).all(), str(check)


# --- of second order, and along directions of one's own

CURVED: dict[str, dict[str, float]] = {"heavier": {NAMES[0]: 1.0}, "heavier and slower": {NAMES[0]: 0.2, NAMES[1]: 0.1}}
SWING = udk.Parameter(NAMES[1], bounds=(0.01, 1.0))


@pytest.mark.slow
def test_second_derivatives_agree_with_those_of_the_motion():
    """d^T H d by JAX's own rules of the angle as a function of positive and bounded unknowns, with the same directions."""
    check = udk.check_gradients(pendulum(*FIRST), DATA, [NAMES[0], SWING], tol=1e-9, order=2, directions=CURVED)
    assert check.ok and check.order == 2 and check.names == tuple(CURVED), str(check)
    assert "second derivatives" in str(check).splitlines()[0] and check.message.startswith("second derivatives agree")
    scene, part = pendulum(*FIRST), (FIRST[1] - 0.01) / 0.99

    def angles(z):
        damping = 0.01 + 0.99 / (1.0 + (1.0 - part) / part * jax.numpy.exp(-z[1]))
        changed = scene.with_parameters({NAMES[0]: FIRST[0] * jax.numpy.exp(z[0]), NAMES[1]: damping})
        return udk.simulate(changed, TS, rtol=1e-11, atol=1e-11).q[:, 0, 2]

    H = np.asarray(jax.jacfwd(jax.jacfwd(angles))(np.zeros(2)))
    per_unit = np.array([1 / FIRST[0], 1 / (0.99 * part * (1 - part))])
    for row, changes in zip(check.directions, CURVED.values(), strict=True):
        d = per_unit * [changes.get(name, 0.0) for name in NAMES]
        np.testing.assert_allclose(row, d / np.linalg.norm(d), rtol=1e-12)
    sizes = [np.sqrt(np.mean((H @ d @ d) ** 2)) for d in check.directions]
    np.testing.assert_allclose(check.size[:, 0], sizes, rtol=1e-6)
    assert (check.floor < 1e-5 * check.size).all()


def test_wrong_second_derivatives_are_found(monkeypatch):
    right, given = FitProblem.second_derivatives, (pendulum(*FIRST), DATA, list(NAMES))
    directions: dict[str, dict[str, float]] = {"both": dict.fromkeys(NAMES, 1.0)}
    check = udk.check_gradients(*given, tol=1e-9, order=2, directions=directions)
    assert check.ok and "second derivatives" in str(check).splitlines()[0]
    monkeypatch.setattr(FitProblem, "second_derivatives", lambda *given: 1.001 * right(*given))
    check = udk.check_gradients(*given, tol=1e-9, order=2, directions=directions)
    assert not check.ok and "the second derivative is" in check.message


def test_directions_are_combinations_of_unknowns():
    estimate = identify(pendulum(*FIRST), {"time": TS, ANGLE: swing(pendulum())}, NAMES, progress=False)
    wrong: Any
    for wrong in ([], 1j, {"both": 1.0}, {"both": {NAMES[0]: []}}):
        with pytest.raises(ValueError, match=r"^directions.* must "):
            estimate.check_gradients(directions=wrong)
    check = estimate.check_gradients(directions={"both": {NAMES[0]: 0.375, NAMES[1]: 0.2}})
    assert check.ok and check.names == ("both",)
    np.testing.assert_allclose(check.directions, np.full((1, 2), np.sqrt(0.5)), rtol=1e-6)  # relative changes of both


@pytest.mark.parametrize(
    ("directions", "problem"),
    [
        ({"up": {"body.rod.inrtia": 1.0}}, f'directions: "up": no unknown "body.rod.inrtia"; did you mean "{NAMES[0]}"?'),
        ({"up": {}}, 'directions: "up" must change an unknown by a finite number'),
        ({"up": {NAMES[0]: 0.0}}, 'directions: "up" must change an unknown by a finite number'),
        ({"up": {NAMES[0]: np.inf}}, 'directions: "up" must change an unknown by a finite number'),
        ({}, "directions: there are none"),
    ],
)
def test_directions_without_meaning_are_refused(directions, problem):
    with pytest.raises(udk.IdentificationError) as caught:
        udk.check_gradients(pendulum(*FIRST), DATA, NAMES, directions=directions)
    assert caught.value.problems == [problem]
