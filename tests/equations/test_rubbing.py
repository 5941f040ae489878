"""Friction that depends on the loads of joints: the programs by elimination agree with the textbook, and never add energy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.friction import cart, drawer, pendulum, rubbing
from tests.run_programs import evaluate_programs
from tests.ten_times import multiplied
from udkjax.equations.friction.rubbing import rubbing_loads, settled_multipliers
from udkjax.equations.programs.scene_programs import ScenePrograms
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.states.textbook import prepare
from udkjax.equations.terms.structure import structure
from udkjax.pinv.rank_policy import RankPolicy

MOVING = {"a": udk.Body(1.0, 0.1, [0.4, 0.1], 0.3), "b": udk.Body(2.0, 0.3, [0.9, 0.3], 0.3)}
GUIDED = {"a": udk.Body(1.0, 0.1, [0.0, 0.3], velocity=[1.0, 0.0]), "b": udk.Body(2.0, 0.2, [1.0, 0.3], velocity=[1.0, 0.0])}
GUIDES = {
    "S1": udk.Prismatic(["ground", "a"], [[0.0, 0.3], [0.1, 0.0]], 0.0),
    "S2": udk.Prismatic(["ground", "b"], [[0.0, 0.3], [0.2, 0.0]], 0.0),
    "P": udk.Revolute(["a", "b"], [[0.5, 0.1], [-0.5, 0.1]]),
}
REDUNDANT = {  # their redundant rows share loads: of pins, of slides in metres and radians, of both
    "parallelogram": lambda: rubbing(udk.library.parallelogram()),
    "two guides": lambda: rubbing(udk.Mechanism(GUIDED, GUIDES, gravity=[0.3, -9.81])),
    "lift": lambda: rubbing(udk.library.scissor_lift()),
}
MECHANISMS = {
    "pendulum": lambda: pendulum(coefficient=0.3, radius=0.1),
    "cart": lambda: cart(0.3, 0.2, static_coefficient=0.4, viscous=0.1),
    "four-bar": lambda: rubbing(udk.library.four_bar()),
    "slider-crank": lambda: rubbing(udk.library.slider_crank()),
    "trammel": lambda: rubbing(udk.library.elliptic_trammel()),
    "chain": lambda: rubbing(udk.library.double_pendulum(), radius=0.2),
    "moving guide": lambda: rubbing(udk.Mechanism(MOVING, {"S": udk.Prismatic(["a", "b"], [[0.1, 0.2], [0.3, 0.1]], 0.5)})),
}


def states(mechanism: udk.Mechanism, count: int) -> list[tuple[jnp.ndarray, jnp.ndarray]]:
    """Return positions of a mechanism with random velocities that its constraints allow."""
    equations, rng = prepare(mechanism), np.random.default_rng(3)
    q = jnp.ravel(jnp.asarray(udk.assemble(mechanism).q))
    return [(q, equations.tangent_part(0.0, q, q, q, jnp.asarray(rng.normal(size=q.size))).dv) for _ in range(count)]


FAST = "pendulum", "moving guide"
ACCELERATIONS = "a", "safe", "unsettled"  # by one round of Newton's method
MULTIPLIERS = "a", "multipliers"  # by as many rounds as friction needs


@pytest.mark.parametrize("name", [*FAST, *(pytest.param(x, marks=pytest.mark.slow) for x in MECHANISMS if x not in FAST)])
def test_elimination_agrees_with_the_textbook(name):
    mechanism = MECHANISMS[name]()
    for q, v in states(mechanism, 1):
        found = evaluated(mechanism, prepare(mechanism).programs, MULTIPLIERS, q, v)
        expected = np.asarray(udk.accelerations(mechanism, 0.0, q.reshape(-1, 3), v.reshape(-1, 3))).ravel()
        np.testing.assert_allclose(found["a"], expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["two guides", *(pytest.param(x, marks=pytest.mark.slow) for x in ("parallelogram", "lift"))])
def test_redundant_rows_share_loads_by_least_norm(name):
    mechanism = REDUNDANT[name]()
    for factor in (1.0, 8.0):
        changed = scaled(mechanism, factor)
        for q, v in states(changed, 2):
            found = evaluated(changed, prepare(changed).programs, MULTIPLIERS, q, v)
            state = 0.0, q.reshape(-1, 3), v.reshape(-1, 3)
            a, multipliers = udk.accelerations(changed, *state, method=udk.pinv.SVD(), multipliers=True)
            np.testing.assert_allclose(found["a"], np.ravel(a), atol=1e-12 * np.abs(a).max())
            np.testing.assert_allclose(found["multipliers"], multipliers, atol=1e-12 * np.abs(multipliers).max())


def test_only_redundant_rows_take_operations():
    """A scene without redundant rows has the programs of one in which no row may be redundant, also if marks tell so."""
    mechanism, own = rubbing(udk.library.four_bar()), {"null", "loads0", "border"}
    equations = prepare(mechanism)
    marked = replace(equations, redundant=None).programs
    assert marked.shares_by_marks and not equations.programs.marks_rows
    switched = replace(equations, redundant=None, only_switched=True).programs
    for programs in (equations.programs, marked.with_shared_rows(())):
        assert not own & {*programs.scratch, *programs.of("a").arrays}
    assert marked.with_shared_rows(()) is switched
    shared = prepare(REDUNDANT["parallelogram"]()).programs
    assert shared.weighs_rows and own <= {*shared.of("a").arrays}


def scaled(mechanism: udk.Mechanism, factor: float) -> udk.Mechanism:
    """Return a mechanism with coefficients of friction multiplied by a factor."""
    names = [x for x in mechanism.parameters() if x.endswith(("coefficient", ".viscous"))]
    return mechanism.with_parameters({x: factor * mechanism.parameters()[x] for x in names})


def evaluated(
    mechanism: udk.Mechanism, programs: ScenePrograms, outputs: tuple[str, ...], q: jnp.ndarray, v: jnp.ndarray
) -> dict:
    """Return the results of a program of a mechanism."""
    numbers = map(float, np.concatenate([np.ravel(x) for x in mechanism.without_origin.numbers]))
    weights = map(float, udk.analyse(mechanism).scales.weights if programs.weighs_rows else ())
    return evaluate_programs(programs, [outputs], [*numbers, *weights, 0.0, 0.0], 0.0, np.asarray(q), np.asarray(v))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "jam"), [("pendulum", 17.6), ("four-bar", 60.2), ("slider-crank", 47.3), ("chain", 15.2)])
def test_friction_settles_up_to_jams(name, jam):
    """One round suffices up to a fiftieth of the friction that jams, the rounds of other programs up to nine tenths.

    `jam` is the factor of all coefficients from which on no accelerations are close to those without friction.
    """
    mechanism = MECHANISMS[name]()
    programs = prepare(mechanism).programs
    for q, v in states(mechanism, 2):
        for part, program in ((0.02, ACCELERATIONS), (0.3, MULTIPLIERS), (0.9, MULTIPLIERS)):
            changed = scaled(mechanism, part * jam)
            found = evaluated(changed, programs, program, q, v)["a"]
            expected = np.asarray(udk.accelerations(changed, 0.0, q.reshape(-1, 3), v.reshape(-1, 3))).ravel()
            np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max(), err_msg=f"{part} of jamming")


@pytest.mark.slow
def test_both_forms_settle_loads_that_change_their_signs():
    """At 0.6 of the friction that jams, Newton's method alone goes back and forth between the signs of two loads."""
    mechanism = scaled(rubbing(udk.library.slider_crank(), speed=0.05), 0.6 * 47.3)
    programs, ts = prepare(mechanism).programs, [0.0, 0.02, 0.03, 0.0325, 0.04]
    solution = udk.simulate(mechanism, ts)
    for q, v in zip(solution.q[1:], solution.v[1:], strict=True):
        found = evaluated(mechanism, programs, MULTIPLIERS, jnp.ravel(q), jnp.ravel(v))["a"]
        expected = np.asarray(udk.accelerations(mechanism, 0.0, q, v)).ravel()
        np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_accelerations_hardly_depend_on_what_counts_as_settled(factor):
    with multiplied(factor, "equations.elimination.friction_elimination.LOAD_CHANGE_TOL"):
        _check_accelerations()


def _check_accelerations():
    for name in ("pendulum", "cart", "four-bar", "slider-crank", "chain"):
        mechanism = MECHANISMS[name]()
        tree, shapes = structure(mechanism.without_origin)
        programs = ScenePrograms(tree, shapes, (), False, RankPolicy.FALL_BACK)
        for q, v in states(mechanism, 2):
            found = evaluated(mechanism, programs, MULTIPLIERS, q, v)["a"]
            expected = np.asarray(udk.accelerations(mechanism, 0.0, q.reshape(-1, 3), v.reshape(-1, 3))).ravel()
            np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_friction_takes_few_operations():
    """Friction in all joints of a loop adds at most two and a half times the operations of the other equations."""
    mechanism = udk.library.four_bar()
    counts = []
    for x in (mechanism, rubbing(mechanism)):
        program = Unrolled(prepare(x).programs, [ACCELERATIONS]).program(*ACCELERATIONS).program
        counts.append(len(program.order))
    assert counts[1] < 3.5 * counts[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANISMS)
def test_friction_takes_power(name):
    mechanism = MECHANISMS[name]()
    weights = udk.analyse(mechanism).scales.weights

    @jax.jit
    def power(q, v):
        multipliers = settled_multipliers(mechanism.without_origin, 0.0, q, v, udk.pinv.SVD(1e-10), None, weights)
        return v @ rubbing_loads(mechanism.without_origin, 0.0, q, v, multipliers)

    for q, v in states(mechanism, 20):
        assert float(power(q, v)) < 0


def test_drawer_jams_at_its_angle():
    """With the pull F at the reach e from a guide of length b, F (1 - 2 mu e / b) = m a."""
    at = jnp.zeros((1, 3)), jnp.array([[0.5, 0.0, 0.0]])
    for coefficient in (0.1, 0.2, 0.24):
        _, (*_, minus_pull) = udk.accelerations(drawer(coefficient), 0.0, *at, multipliers=True)
        assert -float(minus_pull) == pytest.approx(2.0 * 0.6 / (1 - 4 * coefficient), rel=1e-9)
    assert not np.isfinite(udk.accelerations(drawer(0.26), 0.0, *at)).any()


def test_no_loads_give_no_friction():
    """A mechanism that jams has no multipliers, and then no accelerations: not those without friction."""
    mechanism = pendulum(coefficient=0.3, radius=0.1).without_origin
    at = jnp.zeros(3), jnp.array([0.0, 0.0, 1.0])
    assert jnp.isnan(rubbing_loads(mechanism, 0.0, *at, jnp.full(2, jnp.nan))[2])
    assert rubbing_loads(mechanism, 0.0, *at, jnp.zeros(2))[2] == 0


@pytest.mark.slow
def test_pin_jams():
    """Beyond the coefficient at which the pin's friction outweighs what turns it, there are no accelerations."""
    mechanism = MECHANISMS["pendulum"]()
    q, v = states(mechanism, 1)[0]
    for factor, jams in ((15.0, False), (19.0, True)):
        found = udk.accelerations(scaled(mechanism, factor), 0.0, q.reshape(-1, 3), v.reshape(-1, 3))
        assert np.isnan(found).any() == jams


def test_static_coefficient_is_reached_at_its_speed():
    """At s = speed, mu is the static coefficient up to 1 - tanh 4; far above it is the coefficient."""
    at = jnp.zeros((1, 3))
    mechanism = udk.Mechanism(
        {"b": udk.Body(1.0, 0.1)},
        {"S": udk.Prismatic(["ground", "b"], [[0.0, 0.0]] * 2, 0.0)},
        forces={"rub": udk.Friction("S", coefficient=0.1, static_coefficient=0.15, speed=0.01)},
    )
    for speed, coefficient in ((0.01, 0.1 * np.tanh(4.0) + 0.05), (-0.01, -0.1 * np.tanh(4.0) - 0.05), (100.0, 0.1)):
        a = udk.accelerations(mechanism, 0.0, at, jnp.array([[speed, 0.0, 0.0]]))
        assert float(a[0, 0]) == pytest.approx(-9.81 * coefficient, rel=1e-9)
