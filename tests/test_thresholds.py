"""Thresholds and limits of repetitions ten times as large or as small leave motions and verdicts as they are."""

from collections.abc import Callable
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.equations.test_rubbing import states
from tests.equations.test_stationary_rows import rod_between_guides
from tests.friction import cart, drawer, pendulum, rubbing
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, floor
from tests.integrate.events.instant.test_impacts import rocking
from tests.integrate.events.instant.test_own_system_events import coupled, swung
from tests.integrate.events.instant.test_sticking import block, oscillator, sticking
from tests.integrate.events.law.test_kinks import swinging
from tests.integrate.systems.own_systems import G
from tests.integrate.systems.own_systems import pendulum as spatial_pendulum
from tests.integrate.test_matrices_in_forces import SolvedSpring
from tests.native.test_implicit_stages import damped
from tests.statics.test_holding import clamp, cranks, wedge
from tests.study.test_geared_freedoms import MECHANISMS, mechanism_of
from tests.synthesis.test_design import FOUR_BAR
from tests.ten_times import multiplied
from udkjax.equations.programs.scales import concrete_scales
from udkjax.equations.rows.analysis import _with_rank_tol
from udkjax.equations.rows.dense_rows import DenseRows
from udkjax.equations.rows.redundancy import examine_rows
from udkjax.integrate.solvers import method_of
from udkjax.native.module.steps import STABILITY_LIMIT, STIFF_LIMIT
from udkjax.study.tolerancing.dimensions import ToleratedNumbers

pytestmark = pytest.mark.slow
TIGHT: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9, "throw": False}


def held_pins() -> dict[str, Any]:
    """Rods across guides, and mechanisms without any: what `analyse` finds in their rows."""
    scenes = {f"rod {x:g}": rod_between_guides(x, 0.4) for x in (0.05, 3.0, 40.0)}
    for name in ("parallelogram", "peaucellier", "elliptic_trammel", "slider_crank"):
        scenes[name] = getattr(udk.library, name)()
    scenes["flat"] = udk.library.parallelogram(1e-3)  # near a singular configuration
    rows = {name: examine_rows(mechanism) for name, mechanism in scenes.items()}
    return {name: (found.redundant, [pin.name for pin in found.held]) for name, found in rows.items()}


def geared_rows() -> dict[str, Any]:
    """Gears of large ratios: their redundant rows and units, and the velocities that a motor at the slow end gives."""
    found: dict[str, Any] = {}
    for kind, driven in product(MECHANISMS, ("first", "last")):
        mechanism = mechanism_of(kind, driven, 1e5, 1.0)
        rows = examine_rows(mechanism)
        scales = _with_rank_tol(mechanism, concrete_scales(mechanism), rows)
        *_, psi, rates, rank = DenseRows(mechanism, scales).assemble(0.0, np.ravel(mechanism.q0), np.zeros(mechanism.q0.size))
        found[f"{kind}, {driven}"] = rows.redundant, rank, bool(max(np.abs(psi).max(), np.abs(rates).max()) < 1e-9)
    return found


def impacts_of_systems() -> dict[str, Any]:
    """Impacts, and contacts that the constraints block: that of a pendulum with a sphere about its pivot that grows."""
    grows = udk.Event(lambda t, q, v: 1.5 - t - q @ q, udk.Impact(0.5, at_rest="stop"), name="sphere")
    start = udk.State([0.8, 0.0, -0.6], [0.0, 0.8 * np.sqrt(G / 0.6), 0.0])
    blocked = udk.simulate(spatial_pendulum(), [0.0, 1.0], start, **TIGHT, events=grows)
    runs = {"swung": swung("native"), "coupled": coupled(3.0), "blocked": blocked}
    return {name: (int(run.code), run.q) for name, run in runs.items()}


def feet_in_turns() -> dict[str, Any]:
    """Rods whose feet lift each other until both rest, with and without friction."""
    runs = {
        (inertia, friction): rocking([inertia, 0.3], 1e-5, [0.0, 0.2, 0.5], **({"coefficient": friction} if friction else {}))
        for inertia in (0.4, 1.0)
        for friction in (None, 0.1)
    }
    return {str(name): (int(run.code), run.q) for name, run in runs.items()}


def matrices_in_forces() -> dict[str, Any]:
    rod, pin = udk.Body(1.0, 0.1, [0.5, 0.0]), udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]])
    spring = SolvedSpring(["ground", "rod"], jnp.asarray(7.0))
    mechanism = udk.Mechanism({"rod": rod}, {"pin": pin}, forces={"spring": spring})
    return {"rod": udk.simulate(mechanism, [0.0, 0.5, 1.0], **TIGHT).q}


def sticking_joints() -> dict[str, Any]:
    """Joints at rest of which some lock each other, some slide: times of events and last places."""
    found: dict[str, Any] = {}
    for name in ("four_bar", "slider_crank", "double_pendulum"):
        run = udk.simulate(sticking(getattr(udk.library, name)()), np.linspace(0.0, 6.0, 4), **TIGHT)
        assert run.events is not None and run.sticking is not None
        found[name] = run.q, run.events.time, run.sticking
    for name, mechanism in {"block": block(0.2, 2.0, coefficient=0.3), "oscillator": oscillator()}.items():
        found[name] = udk.simulate(mechanism, [0.0, 1.0, 50.0], **TIGHT).q
    return found


def rubbing_joints() -> dict[str, Any]:
    """Friction at three tenths of the jamming coefficient, by machine code and by JAX."""
    scenes = {"pendulum": pendulum(coefficient=1.5, radius=0.1, speed=0.05), "cart": cart(0.3, 0.2, speed=0.05)}
    scenes |= {name: rubbing(getattr(udk.library, name)(), 1.0, speed=0.05) for name in ("four_bar", "slider_crank")}
    found: dict[str, Any] = {name: udk.simulate(x, [0.0, 0.1, 0.2], **TIGHT).q for name, x in scenes.items()}
    for name, x in scenes.items():
        for k, (q, v) in enumerate(states(x, 2)):
            found[f"{name} {k}"] = np.asarray(udk.accelerations(x, 0.0, q.reshape(-1, 3), v.reshape(-1, 3))) / 1e3
    return found


def jams() -> dict[str, Any]:
    """The joints that jam, by name."""
    turns = udk.State([[0.5, 0.0, 0.0]], [[0.0, 1.5, 3.0]])
    scenes = {"drawer": (drawer(0.26), None), "pin": (pendulum(coefficient=5.7, radius=0.1), turns)}
    causes = {name: udk.simulate(x, [0.0, 1.0], state, throw=False).cause for name, (x, state) in scenes.items()}
    assert all("friction jams joint" in cause for cause in causes.values())
    return causes


def held_mechanisms() -> dict[str, Any]:
    """Efforts that hold mechanisms against friction, in units of the weight or of the push, near locking and at a dead point."""
    steep = np.pi / 2 - np.arctan(0.5)
    wedges = {name: wedge(angle, coefficient=0.5) for name, angle in (("flat", 0.2), ("steep", steep - 1e-6), ("locked", 1.4))}
    found = {name: udk.holding_efforts(x, "body.load.x", [0.0, 0.1]) for name, x in wedges.items()}
    limit = 2 * 0.1 * 0.01 / 0.2
    found["clamp"] = udk.holding_efforts(clamp(2.5 * limit), "body.lever.angle", np.arcsin(limit * np.array([2.5, 1.001, 0.5])))
    found["dead point"] = udk.holding_efforts(pendulum(coefficient=0.3, radius=0.05), "body.bob.y", [-0.3, -0.49, -0.5])
    found["preloaded"] = udk.holding_efforts(cranks(), "body.crank0.angle", [1.0, 1.1])
    units = {"steep": 1e6, "locked": 20.0, "flat": 20.0, "clamp": 10.0}
    return {name: [x / units.get(name, 10.0) for x in (e.lower, e.upper, e.without_friction)] for name, e in found.items()}


def designs() -> dict[str, Any]:
    """Four-bars through places of a circle and of a bow: the sums of squares that they leave, in lengths of 10."""
    places = {"circle": [[2.0, 8.0], [5.0, 11.0], [8.0, 8.0], [5.0, 5.0]], "bow": [[0.0, 8.0], [2.0, 12.0], [9.0, 14.0]]}
    found = {name: udk.design(FOUR_BAR, udk.PathGoal("P", at), starts=40, results=1)[0] for name, at in places.items()}
    return {name: found.loss / 100 for name, found in found.items()}


def stiff_runs() -> dict[str, Any]:
    """Whether dampers make a run go on implicitly, and where it ends."""
    scenes = {  # tolerance, seconds
        "four_bar": (damped(1e5), 1e-6, 1.0),
        "pendulum": (damped(1e7, scene=udk.library.compound_pendulum()), 1e-6, 1.0),
        "parallelogram": (udk.library.parallelogram(), 1e-6, 5.0),
        "double_pendulum": (udk.library.double_pendulum(), 1e-9, 5.0),
    }
    runs = {name: udk.simulate(x, [0.0, end / 2, end], rtol=tol, atol=tol, throw=False) for name, (x, tol, end) in scenes.items()}
    return {name: (int(run.stats["implicit"]) > 0, run.q) for name, run in runs.items()}


def located_events() -> dict[str, Any]:
    """Impacts, joints that events add and cut, events at samples, and kinks: their times, and last places."""
    swing = udk.Event(lambda t, at: at["link"].omega, udk.Log(), name="turns")
    torque = udk.Torque(["ground", "link"], udk.Held(np.sin(np.arange(21.0)), 0.1))
    driven = udk.Mechanism(PENDULUM.bodies, PENDULUM.joints, forces={"T": torque})
    runs = {
        "ball": udk.simulate(BALL, [0.0, 1.0, 2.0], **TIGHT, events=floor(0.7)),
        "caught": udk.simulate(CATCH, [0.0, 0.5, 1.0], **TIGHT, events=CAUGHT),
        "driven": udk.simulate(driven, [0.0, 1.0, 2.0], **TIGHT, events=swing),
    }
    found: dict[str, Any] = {name: (run.q, run.events.time) for name, run in runs.items() if run.events is not None}
    run = udk.simulate(swinging(), [0.0, 0.5, 1.0], **TIGHT)
    return found | {"kinks": (run.q, int(run.stats["kinks"]))}


def rests() -> dict[str, Any]:
    """Positions of rest, some with dependent rows; a turn of a crank, and the efforts that hold it."""
    scenes = {name: getattr(udk.library, name)() for name in ("four_bar", "slider_crank", "parallelogram", "double_pendulum")}
    scenes |= {"chain": udk.library.chain(6, 0.4)}
    found: dict[str, Any] = {name: udk.equilibrium(x).q for name, x in scenes.items()}
    crank = f"body.{scenes['four_bar'].body_names[0]}.angle"
    turns = udk.kinematics(scenes["four_bar"], crank, np.linspace(1.0, 1.3, 4))
    efforts = udk.holding_efforts(scenes["four_bar"], crank, [1.0, 1.2])
    return found | {"turns": turns.q, "efforts": efforts.without_friction / 10}


def bars(beside: float) -> udk.Mechanism:
    """A four-bar whose links fold flat together, but for a difference of one length."""
    pins = {
        "O": (0, 0),
        "C": (4.0 + beside, 0),
        "A": udk.polar("O", 1.5, np.deg2rad(60)),
        "B": udk.circles(("A", "C"), (4, 1.5), "left"),
    }
    links = {
        "crank": udk.Link(["O", "A"], mass=1.0),
        "coupler": udk.Link(["A", "B"], mass=1.0),
        "rocker": udk.Link(["C", "B"], mass=1.0),
    }
    return udk.Drawing(pins=pins, links=links, ground=["O", "C"]).mechanism()


def followed_turns() -> dict[str, Any]:
    """Turns of linkages at change points and beside them, in few steps and in many: statuses, positions and velocities."""
    found: dict[str, Any] = {}
    for beside, count in product((0.0, 1e-9, 1e-6, 1e-4, 1e-2, -1e-2), (7, 40, 200)):
        folded = udk.library.slider_crank(0.4, driven=False, crank=0.3, rod=0.3 + beside)
        for name, mechanism in (("four-bar", bars(beside)), ("slider-crank", folded)):
            driver, start = f"body.{mechanism.body_names[0]}.angle", float(mechanism.q0[0, 2])
            turn = udk.kinematics(mechanism, driver, start + np.linspace(0.0, 2 * np.pi, count))
            found[f"{name}, {beside:g}, {count}"] = turn.status, turn.q
    return found


def linearized_rests() -> dict[str, Any]:
    """Positions of rest of chains and linkages of one freedom, started far from them, and their frequencies."""
    scenes = {name: getattr(udk.library, name)() for name in ("four_bar", "slider_crank", "scissor_lift", "compound_pendulum")}
    found: dict[str, Any] = {}
    for name, mechanism in scenes.items():
        rest = udk.equilibrium(mechanism)
        found[name] = rest.q, udk.modes(mechanism, rest.state).frequencies
    return found


def hidden_numbers() -> dict[str, Any]:
    """Tolerances of which one number would hide another, and others that are independent, on several mechanisms."""
    given = {
        "four_bar": [("pin.C", "length(coupler)"), ("pin.A", "length(rocker)"), ("link.crank.mass", "length(crank)")],
        "slider_crank": [("pin.P", "length(crank)"), ("pin.O", "length(rod)"), ("pin.B", "length(rod)")],
        "n_four_bar": [("joint.A0.points[0]", "length(rod0)")],
    }
    found: dict[str, Any] = {}
    for name, pairs in given.items():
        mech = getattr(udk.library, name)()
        for pair in pairs:
            try:
                ToleratedNumbers(mech, dict.fromkeys(pair, 1e-3))
                found[f"{name}: {pair}"] = "independent"
            except udk.SceneError:
                found[f"{name}: {pair}"] = "one hides the other"
    assert len(set(found.values())) == 2
    return found


def least_gaps() -> dict[str, Any]:
    """Least gaps of four-bars whose crank turns or swings, with links that touch or do not: distances, values and contacts."""
    found: dict[str, Any] = {}
    for name, C, width in (("turns", (0.18, 0.0), 0.015), ("hits", (0.18, 0.0), 0.1), ("swings", (0.26, 0.0), 0.015)):
        pins = {"O": [0.0, 0.0], "A": [0.03, 0.04], "B": [0.16, 0.11], "C": list(C)}
        links = {k: udk.Link(list(ends), mass=1.0, width=width) for k, ends in (("a", "OA"), ("b", "AB"), ("c", "BC"))}
        motors = {"motor": {"pin": "O", "speed": 1.0}}
        gaps = udk.gaps(udk.Drawing(pins=pins, links=links, ground=["O", "C"], motors=motors).mechanism())
        found[name] = gaps.least.distance, [(x.begins, x.ceases) for x in gaps.contacts]
    return found


CASES: dict[str, tuple[Callable[[], dict[str, Any]], tuple[str, ...], float]] = {
    "SQUARE_FIT_TOL": (held_pins, ("equations.rows.stationary_rows.SQUARE_FIT_TOL",), 0.0),
    "SMALL_SINGULAR_VALUE": (held_pins, ("equations.rows.stationary_rows.SMALL_SINGULAR_VALUE",), 0.0),
    "CONSTANT_COEFFICIENT_TOL": (geared_rows, ("equations.rows.balance.CONSTANT_COEFFICIENT_TOL",), 0.0),
    "ANCHOR_WEIGHT": (geared_rows, ("equations.rows.balance.ANCHOR_WEIGHT",), 0.0),
    "GEARED_SHARE": (geared_rows, ("equations.rows.analysis.GEARED_SHARE",), 0.0),
    "BLOCKED_IN_SYSTEM_TOL": (impacts_of_systems, ("integrate.events.instant.impacts.BLOCKED_IN_SYSTEM_TOL",), 0.0),
    "LONGEST_FALL": (feet_in_turns, ("integrate.events.instant.hops.LONGEST_FALL",), 1e-9),
    "MOST_ROWS": (matrices_in_forces, ("expressions.reading.matrix_rules.MOST_ROWS",), 1e-8),
    "LIMIT_ITERATIONS": (sticking_joints, ("complementarity.stick_or_slip.LIMIT_ITERATIONS",), 1e-9),
    "SWEEPS": (sticking_joints, ("complementarity.stick_or_slip.SWEEPS",), 1e-9),
    "SHARE_TOL": (sticking_joints, ("complementarity.stick_or_slip.SHARE_TOL",), 1e-9),
    "BLOCK_STEPS": (sticking_joints, ("complementarity.stick_or_slip.BLOCK_STEPS",), 1e-9),
    "SINGLE_STEPS": (sticking_joints, ("complementarity.stick_or_slip.SINGLE_STEPS",), 1e-9),
    "LOAD_CHANGE_TOL": (rubbing_joints, ("equations.elimination.friction_elimination.LOAD_CHANGE_TOL",), 1e-8),
    "LAST_CHANGE": (rubbing_joints, ("transforms.newton_steps.LAST_CHANGE",), 1e-8),
    "FRICTION_ROUNDS": (rubbing_joints, ("equations.elimination.friction_elimination.FRICTION_ROUNDS",), 1e-8),
    "SETTLING_ROUNDS": (rubbing_joints, ("native.module.steps.SETTLING_ROUNDS",), 1e-8),
    "MOST_STEPS": (rubbing_joints, ("transforms.newton_steps.MOST_STEPS",), 1e-8),
    "BLOCKING_TOL, OPTIMALITY_TOL": (
        held_mechanisms,
        tuple(f"complementarity.linear_program.{x}" for x in ("BLOCKING_TOL", "OPTIMALITY_TOL")),
        1e-9,
    ),
    "STEPS_PER_ROW": (held_mechanisms, ("complementarity.linear_program.STEPS_PER_ROW",), 1e-9),
    "STOPPED_TOL": (held_mechanisms, ("statics.holding.STOPPED_TOL",), 1e-9),
    "UNBALANCED_TOL, LOADED_TOL": (
        held_mechanisms,
        tuple(f"statics.admissible_reactions.{x}" for x in ("UNBALANCED_TOL", "LOADED_TOL")),
        1e-9,
    ),
    "tangents": (
        held_mechanisms,
        tuple(f"statics.admissible_reactions.{x}" for x in ("MOST_TANGENTS", "LAST_CHANGE", "STEP_ASIDE", "PRELOAD")),
        1e-9,
    ),
    "STAGE_ROUNDS": (rubbing_joints, ("native.module.steps.STAGE_ROUNDS",), 1e-8),
    "LARGE_CORRECTION": (rubbing_joints, ("equations.elimination.friction_elimination.LARGE_CORRECTION",), 1e-8),
    "REVERSAL_SPEED": (sticking_joints, ("integrate.events.law.crossings.REVERSAL_SPEED",), 1e-9),
    "STAGES": (rubbing_joints, ("equations.programs.run_programs.RunPrograms.STAGES",), 1e-8),
    "MOST_AIMS": (located_events, ("native.watching.conditions.MOST_AIMS",), 1e-8),
    "MOST_LANDINGS": (located_events, ("native.watching.conditions.MOST_LANDINGS",), 1e-8),
    "LAST_CHANGE, of events": (located_events, ("native.watching.conditions.LAST_CHANGE",), 1e-8),
    "LEAST_STEP": (located_events, ("native.watching.conditions.LEAST_STEP",), 1e-8),
    "SHORT_STEP": (located_events, ("native.module.steps.SHORT_STEP",), 1e-8),
    "USES_BEFORE_ELIMINATION": (rests, ("equations.programs.eliminated_steps.USES_BEFORE_ELIMINATION",), 1e-9),
    "LEAST_DISTANCE": (rests, ("equations.programs.eliminated_steps.LEAST_DISTANCE",), 1e-9),
    "FEW_OPERATIONS": (rests, ("expressions.loops.float_loops.FEW_OPERATIONS",), 1e-9),
    "ASSIGNING_ROUNDS": (designs, ("synthesis.starts.ASSIGNING_ROUNDS",), 1e-6),
    "LEAST_FALL": (designs, ("synthesis.search.LEAST_FALL",), 1e-6),
    "LEAST_EFFECT": (hidden_numbers, ("study.tolerancing.dimensions.LEAST_EFFECT",), 0.0),
    **{
        name: (least_gaps, (f"positions.gaps.{name}",), 1e-9)
        for name in (
            "search.PROVEN_TOL",
            "search.OPENING_TOL",
            "search.KINK_OFFSET",
            "search.LAST_STEP",
            "search.STEEP_FRACTION",
            "motion.POLYNOMIAL_TOL",
        )
    },
    "KEEPS_SIDE": (followed_turns, ("native.closing.marching.KEEPS_SIDE",), 1e-8),
    "CLEARLY_ALONG": (linearized_rests, ("statics.linearization.CLEARLY_ALONG",), 1e-9),
    "JAMMING_TIMES": (jams, ("integrate.causes.jamming.JAMMING_TIMES",), 0.0),
}
USUAL: dict[Any, Any] = {}


def usual(results: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    if results not in USUAL:
        USUAL[results] = results()
    return USUAL[results]


def assert_same(found: dict[str, Any], expected: dict[str, Any], atol: float) -> None:
    """Compare results: numbers up to a tolerance, everything else exactly."""
    for key, value in expected.items():
        assert jax.tree.structure(value) == jax.tree.structure(found[key]), key
        for x, y in zip(jax.tree.leaves(found[key]), jax.tree.leaves(value), strict=True):
            if isinstance(y, str) or not np.issubdtype(np.asarray(y).dtype, np.floating):
                np.testing.assert_array_equal(x, y, err_msg=key)
            else:
                np.testing.assert_allclose(np.asarray(x), np.asarray(y), atol=atol, rtol=0, err_msg=key)


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("name", CASES)
def test_ten_times(name, factor):
    results, constants, atol = CASES[name]
    expected = usual(results)
    with multiplied(factor, *constants):
        found = results()
    assert_same(found, expected, atol)


def test_what_limits_explicit_steps_is_the_stability_of_dopri8():
    """|R(z)| <= 1 up to z = -STABILITY_LIMIT, and up to 5/4 STIFF_LIMIT along the imaginary axis: steps are 4/5 as long."""
    A, b = method_of(None).v[:-1], method_of(None).v[-1]
    one = np.ones(len(b))

    def growth(z: complex) -> float:
        return abs(1 + z * (b @ np.linalg.solve(np.eye(len(b)) - z * A, one)))

    for axis, bound in ((-1.0, STABILITY_LIMIT), (1j, 1.25 * STIFF_LIMIT)):
        assert all(growth(axis * bound * share) <= 1 + 1e-3 for share in np.linspace(0.01, 0.97, 50)), axis
        assert growth(axis * bound * 1.25) > 1.05, axis


def test_early_trials_of_implicit_steps_change_little():
    """Trials begin far from the limit, or are as long as has to pay: stiff runs go on implicitly, others never."""
    expected = usual(stiff_runs)
    for factor, name in ((0.1, "STIFF_LIMIT"), (0.5, "PAYING_MARGIN"), (2.0, "PAYING_MARGIN")):
        with multiplied(factor, f"native.module.steps.{name}"):
            assert_same(stiff_runs(), expected, 3e-5)
