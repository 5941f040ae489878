"""Scenes in which many features meet: their views, the comparisons of a few, and comparisons that find mistakes."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("experiments", reason="not in a source tree")

import udkjax as udk
from experiments.parts import mixed_states
from experiments.parts.mixed_case import Case, difference_of_events, states
from experiments.parts.mixed_properties import PROPERTIES, check_mixed
from experiments.parts.mixed_scenes import FEATURES, MOST, build, mixed_scene
from experiments.parts.random_scenes import state_of
from experiments.parts.reference_equations import evaluate
from experiments.parts.scene_views import can_be_turned, delayed, in_units, mirrored, moved, permuted
from experiments.parts.tally import Tally

SEED = 3
TOLERANCES = {name.removeprefix("mixed: "): it.tolerance for name, it in PROPERTIES.items()}


def test_scenes_have_all_features_and_are_closed():
    seen, most = Counter(), 0
    for structure in range(150):
        scene = mixed_scene(SEED, structure)
        assert scene.table == mixed_scene(SEED, structure).table
        terms = evaluate(scene.table, 0.0, *state_of(scene.table))
        assert np.max(abs(terms.psi), initial=0.0) < 1e-12 and np.max(abs(terms.psi_dot), initial=0.0) < 1e-9
        elements = scene.table["force"] + scene.table["driver"] + scene.table["event"]
        seen.update(e.get("action", e.get("law", e.get("type", "driver"))) for e in elements)
        seen.update(joint["type"] for joint in scene.table["joint"])
        most = max(most, len(elements))
    kinds = {"spring", "torsion_spring", "force", "torque", "friction", "set-valued", "bumper", "servo", "zone", "square_drag"}
    kinds |= {"contact", "limit", "stop", "log", "release", "lock", "attach", "driver"}
    kinds |= {"revolute", "prismatic", "slot", "distance", "weld", "gear", "rack", "cam"}
    assert kinds <= set(seen) and most >= MOST, kinds - set(seen)


VIEWS = {
    "moved": lambda scene: moved(scene, 0.7, np.array([0.4, -2.0])),
    "mirrored": mirrored,
    "delayed": lambda scene: delayed(scene, 0.3),
    "in_units": lambda scene: in_units(scene, 1e3, 1e-2, 1e-4),
    "permuted": lambda scene: scene._replace(table=permuted(scene.table, np.random.default_rng(scene.seed))),
}


def _energy_and_power(scene, t):
    """Return the kinetic energy and the power of the loads, in the scene's units; check that it is closed."""
    q, v = state_of(scene.table)
    terms = evaluate(scene.table, t, q, v)
    rows = np.max(abs(terms.psi_q * np.tile([scene.length, scene.length, 1.0], len(q))), axis=1, initial=0.0)
    assert np.all(abs(terms.psi) <= 1e-10 * rows) and np.all(abs(terms.psi_dot) * scene.time <= 1e-9 * rows)
    unit, v = scene.mass * (scene.length / scene.time) ** 2, v.ravel()
    return np.array([v @ (terms.mass * v) / 2, v @ terms.force * scene.time]) / unit


@pytest.mark.parametrize("name", VIEWS)
def test_views_are_of_the_same_scene(name):
    """Closed rows stay closed, and loads have the same power."""
    drawn = (mixed_scene(SEED, structure) for structure in range(60))
    scenes = [scene for scene in drawn if name != "moved" or can_be_turned(scene.table)]
    assert len(scenes) > 40
    for scene in scenes:
        right = _energy_and_power(scene, 0.0)
        found = _energy_and_power(VIEWS[name](scene), 0.3 if name == "delayed" else 0.0)
        np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-9 * (1 + np.max(abs(right))), err_msg=str(scene.seed))


def _run(structures, members, checks, features=None):
    tally, failures = Tally(), []
    assert check_mixed(tally, failures, SEED, structures, members, checks, features) > 0
    assert not failures, "\n".join(map(str, failures))
    return {name.removeprefix("mixed: ") for name in tally.found}


def test_a_scene_of_many_features():
    """Samples, friction, a kinked force and events in one scene, at three tolerances and beside the reference."""
    features = "held", "smooth_friction", "servo", "log"
    done = _run([4], 1, ["tolerances", "states", "energy"], features)
    assert {"converged", "endings", "events", "accelerations", "Newton's law", "friction takes power", "no crash"} <= done


@pytest.mark.slow
def test_scenes_of_many_features_in_all_views():
    done = _run(
        range(3), 3, ["tolerances", "views", "parts", "derivatives", "second derivatives", "states", "energy", "reference"]
    )
    assert {"lanes", "jit", "permuted", "rescaled", "derivative", "forward and reverse"} <= done


@pytest.mark.slow
def test_smooth_scenes_in_all_studies():
    smooth = "spring", "torsion", "square_drag"
    done = _run(range(3), 1, ["sweep", "statics", "identification", "reference"], smooth)
    assert {"sweep", "equilibrium", "modes", "identification", "reference"} <= done


def test_mistakes_are_found(monkeypatch):
    """Accelerations, loads and events that are slightly wrong are failures."""
    monkeypatch.setattr(mixed_states, "solve", _wrong(mixed_states.solve))
    tally, failures = Tally(), []
    check_mixed(tally, failures, SEED, [0], 1, ["states"], ("spring", "torsion"))
    assert {f.name for f in failures} == {"accelerations", "Newton's law"}
    case = Case(mixed_scene(SEED, 0, features=("log",)), Tally(), [], TOLERANCES)
    run = udk.simulate(case.mechanism, case.ts, case.state, events=[udk.Event(lambda t, at: t - 0.1, udk.Log(), name="early")])
    late = udk.simulate(case.mechanism, case.ts, case.state, events=[udk.Event(lambda t, at: t - 0.2, udk.Log(), name="early")])
    assert difference_of_events(run, late) == pytest.approx(0.1)
    assert states(run).shape == (*run.q.shape[:2], 6)


def _wrong(solve):
    def wrong(case, t, q, v):
        a, terms, condition = solve(case, t, q, v)
        return a * (1 + 1e-6), terms, condition

    return wrong


def test_features_are_methods_of_the_drawing():
    """Each name draws something on some topology."""
    for feature in FEATURES:
        scenes = [mixed_scene(SEED, k, features=(feature,)).table for k in range(12)]
        assert any(scene["force"] or scene["driver"] or scene["event"] for scene in scenes), feature


@pytest.mark.parametrize(("numbers", "forces"), [(8, ["stiff"]), (33, ["stiff"]), (33, None), (35, ["stiff"])])
def test_driven_parallelogram_with_a_stiff_damper_keeps_its_branch(numbers, forces):
    """A motor turns it through its change point, where only the damper, of 1e6 N s/m, resists the other branch.

    If loads turn the velocity where rows are left out, runs with tolerances below 1e-10 end on the other branch, or not at all.
    """
    table = mixed_scene(SEED, 12, numbers).table
    table = table | {"event": [], "force": [x for x in table["force"] if forces is None or x["name"] in forces]}
    mech, tols = build(table), jnp.logspace(-5, -12, 8)
    state = udk.assemble(mech)
    assert_allclose(state.v[0, 2], 0.0, atol=1e-12)  # a parallelogram: the coupler does not turn

    def run(tol):
        sol = udk.simulate(mech, [0.0, 1.0], state, rtol=tol, atol=tol, throw=False)
        return sol.q[-1], sol.code, sol.stats["steps"]

    angles = np.asarray(state.q)[:, 2]
    for q, code, steps in (jax.vmap(run)(tols), jax.tree.map(lambda *x: jnp.stack(x), *map(run, tols.tolist()))):
        assert np.all(code == udk.Result.successful)
        assert_allclose(q[:, 0, 2], angles[0], atol=1e-9)
        assert_allclose(q[:, 2, 2] - q[:, 1, 2], angles[2] - angles[1], atol=1e-9)
        assert np.max(steps) < 250


@pytest.mark.parametrize("numbers", [4, 8])
def test_driven_parallelogram_in_other_coordinates_keeps_its_branch(numbers):
    """Its mass matrix is not diagonal."""
    table = mixed_scene(SEED, 12, numbers).table
    mech = build(table | {"event": [], "force": [x for x in table["force"] if x["name"] == "stiff"]})
    state = udk.assemble(mech)
    to = np.eye(9) + 0.3 * np.random.default_rng(1).normal(size=(9, 9))
    back = np.linalg.inv(to)
    mass = back.T @ np.diag(np.ravel([[b["mass"], b["mass"], b["inertia"]] for b in table["body"]])) @ back
    system = udk.ConstrainedSystem(
        lambda y: mass,
        lambda t, y, w: back.T @ udk.equations.force(mech, t, back @ y, back @ w),
        lambda t, y: udk.equations.psi(mech, t, back @ y),
    )
    start = udk.State(to @ np.ravel(state.q), to @ np.ravel(state.v))
    for tol in np.logspace(-5, -10, 6):
        end = back @ np.asarray(udk.simulate(system, [0.0, 1.0], start, rtol=tol, atol=tol).q[-1])
        assert_allclose(end[2], state.q[0, 2], atol=1e-9)
