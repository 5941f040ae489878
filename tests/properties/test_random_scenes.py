"""A part of `python -m experiments properties`, with another seed, few mechanisms and little input, but the same checks."""

import functools
import json
import math
from typing import Any

import jax
import numpy as np
import pytest

pytest.importorskip("experiments", reason="not in a source tree")

import udkjax as udk
from experiments.common import HERE, load
from experiments.parts import fuzz_arguments, state_properties
from experiments.parts.friction_properties import check_friction, check_friction_runs, check_uniqueness
from experiments.parts.friction_reference import with_friction
from experiments.parts.fuzz import Case, cases_of, run, verdict
from experiments.parts.idiom_properties import (
    check_conditions,
    check_limits,
    check_rest,
    check_samples,
    check_training,
    check_unprojected,
)
from experiments.parts.random_scenes import build, random_scene, shrunk, state_of
from experiments.parts.reference_equations import evaluate
from experiments.parts.state_properties import check_large, check_states
from experiments.parts.tally import Tally
from experiments.properties import PROPERTIES, page
from tests.calls import calls_of
from udkjax.cli import main
from udkjax.integrate.events.run.plain_system import run_plain
from udkjax.scene.tables.schema import CLASSES_BY_TYPE

SEED = 3


def check(tally):
    """Compare all results with the tolerances. A failure says how to draw the mechanism again."""
    assert tally.found
    wrong = {n: (f.worst, f.at) for n, f in tally.found.items() if not f.worst <= PROPERTIES[n].tolerance}
    assert not wrong, wrong


def test_states_of_random_mechanisms(monkeypatch):
    monkeypatch.setattr(state_properties, "check_methods", lambda *_: None)  # tests/pinv and test_formulations do that
    tally = Tally()
    assert check_states(tally, SEED, range(2), 3) == 6
    check(tally)
    assert {"elimination", "order", "copies", "names", "units", "power", "reciprocity"} <= set(tally.found)


@pytest.mark.slow
def test_states_by_all_methods():
    tally = Tally()
    check_states(tally, SEED, range(4, 12), 8)
    check_large(tally, SEED, range(2))
    check(tally)


@pytest.mark.filterwarnings("ignore:assembly moved")
def test_training_and_runs_without_projection():
    tally = Tally()
    assert check_training(tally, SEED, 1) == 1
    assert check_unprojected(tally, SEED, range(1)) == 1
    check(tally)


@pytest.mark.slow
def test_conditions_samples_rest_and_limits():
    tally = Tally()
    for property_check in (check_samples, check_rest, check_limits):
        assert property_check(tally, SEED, 3) >= 3
    assert check_conditions(tally, SEED, 3, ["maximum"]) == 3
    check(tally)
    assert {"once at a sample", "rest", "gradient at rest", "limits of all joints", "gradient of a condition"} <= set(tally.found)


@pytest.mark.slow
def test_friction_in_all_joints():
    """Accelerations, loads and runs with friction, and which of them are unique."""
    tally = Tally()
    assert check_friction(tally, SEED, range(8), 5) > 0
    assert check_uniqueness(tally, SEED, range(4), 1) > 0
    assert any(check_friction_runs(tally, SEED, structure, 4, False) for structure in range(8))
    check(tally)
    assert {"friction", "friction power", "unique loads", "unique accelerations", "batch with friction"} <= set(tally.found)


@pytest.mark.slow
def test_loads_that_rounds_do_not_settle_are_followed_from_those_without_friction():
    """Newton's steps go back and forth between two sets of signs; still a run begins with the accelerations of the textbook."""
    scene = with_friction(random_scene(0, 161, 5))
    state, mechanism = state_of(scene.table), build(scene.table)
    h = 1e-4 * scene.time
    run = udk.simulate(mechanism, h * np.arange(3), udk.State(*state), rtol=1e-12, atol=1e-12)
    assert run.settings["engine"] == "native"
    first, second, third = np.asarray(run.v)
    right = np.asarray(udk.accelerations(mechanism, 0.0, *state))
    unit = np.array([scene.length, scene.length, 1.0])
    error = np.max(abs((4 * second - 3 * first - third) / (2 * h) - right) / unit)
    assert error < 1e-6 * np.max(abs(right) / unit)


def test_rounds_for_loads_end_where_the_load_of_a_slide_is_nearly_zero():
    """A correction that leads back to the sign of the load before is not kept, or the rounds would not end."""
    scene = with_friction(random_scene(0, 161, 5))
    start, ts, mechanism = udk.State(*state_of(scene.table)), [0.0, 0.05 * scene.time], build(scene.table)
    ends = [udk.simulate(mechanism, ts, start, rtol=tol, atol=tol).q[-1] for tol in (1e-8, 1e-11)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-7)


@pytest.mark.slow
def test_forces_are_watched_where_loads_are_followed_from_those_without_friction():
    """A block beside such a mechanism sticks in machine code, which does not leave the run to its plain form."""
    scene = with_friction(random_scene(0, 161, 5))
    (q, v), beside, kg, m, s = state_of(scene.table), build(scene.table), scene.mass, scene.length, scene.time
    pull = udk.Spring(["ground", "block"], [[0.1 * m, 2 * m], [0, 0]], stiffness=30 * kg / s**2, length=0.0)
    mechanism = udk.Mechanism(
        {**beside.bodies, "block": udk.Body(kg, kg * m**2)},
        {**beside.joints, "S": udk.Prismatic(["ground", "block"], [[0, 0], [0, 0]], axis=0.0)},
        beside.drivers,
        {**beside.forces, "pull": pull, "stick": udk.Friction("S", coefficient=0.2, law="set-valued")},
        gravity=beside.gravity,
    )
    state, ts = udk.State(*(np.vstack([x, np.zeros(3)]) for x in (q, v))), [0.0, 0.05 * s]
    with calls_of(run_plain) as plain:
        run = udk.simulate(mechanism, ts, state, rtol=1e-10, atol=1e-10)
        alone = udk.simulate(beside, ts, udk.State(q, v), rtol=1e-10, atol=1e-10)
    assert plain == []
    assert run.sticking is not None and run.sticking["S"].all()
    np.testing.assert_allclose(run.q[-1, :-1], alone.q[-1], rtol=1e-7)


@pytest.mark.slow
def test_a_run_that_ends_where_friction_jams_does_not_leave_machine_code():
    """Loads grow without bound at its end, which is the same at any tolerance."""
    scene = random_scene(11, 51, 0, bodies=(2, 5))
    rub = {"type": "friction", "coefficient": 0.3, "radius": 0.3 * scene.length, "law": "set-valued"}
    pins = [joint["name"] for joint in scene.table["joint"] if joint["type"] == "revolute"]
    others = [force for force in scene.table["force"] if force["type"] != "friction"]
    table = scene.table | {"force": [*others, *({"name": f"rub {pin}", "joint": pin} | rub for pin in pins)]}
    for tol in (1e-6, 1e-8, 1e-10):
        with calls_of(run_plain) as plain:
            run = udk.simulate(build(table), np.linspace(0.0, 3 * scene.time, 31), rtol=tol, atol=tol, throw=False)
        assert plain == []
        assert run.result == udk.Result.step_too_small and run.settings["engine"] == "native"
        assert float(run.time) == pytest.approx(0.1157806638384, rel=1e-10)


@pytest.mark.slow
def test_uniqueness_near_a_singular_configuration():
    """Joints that cannot slide do not, though the rank of accelerations leaves out a singular value of 2e-4."""
    tally = Tally()
    assert check_uniqueness(tally, 0, [2055], 3)
    check(tally)


@pytest.mark.slow
def test_derivatives_where_loads_are_followed_from_those_without_friction():
    """First derivatives, forward and in reverse, and second ones begin with the same loads as the run."""
    scene = with_friction(random_scene(0, 161, 5))
    state, mechanism = udk.State(*state_of(scene.table)), build(scene.table)

    def end(coefficient):
        changed = mechanism.with_parameters({"force.rub1.coefficient": coefficient})
        return udk.simulate(changed, [0.0, 0.05 * scene.time], state, rtol=1e-11, atol=1e-11).q[-1].sum()

    at, h, slope = 0.15, 1e-4, jax.grad(end)
    assert float(slope(at)) == pytest.approx(float(end(at + h) - end(at - h)) / (2 * h), rel=1e-6)
    assert float(jax.jacfwd(end)(at)) == pytest.approx(float(slope(at)), rel=1e-9)
    assert float(jax.jacfwd(slope)(at)) == pytest.approx(float(slope(at + h) - slope(at - h)) / (2 * h), rel=1e-6)


def test_random_scenes_are_closed_and_drawn_again():
    for structure in range(40):
        scene = random_scene(SEED, structure, 0)
        assert scene.table == random_scene(SEED, structure, 0).table
        terms = evaluate(scene.table, 0.0, *state_of(scene.table))
        row = np.max(abs(terms.psi_q * np.tile([scene.length, scene.length, 1.0], len(scene.table["body"]))), axis=1, initial=0.0)
        assert np.all(abs(terms.psi) <= 1e-12 * row * 10) and np.all(abs(terms.psi_dot) * scene.time <= 1e-9 * row)


@pytest.mark.parametrize("mistake", ["psi_q", "gamma", "force"])
def test_a_mistake_is_found(mistake):
    """A term that is wrong by one millionth violates a property."""

    def wrong(*arguments):
        terms = evaluate(*arguments)
        return terms._replace(**{mistake: getattr(terms, mistake) * (1 + 1e-6)})

    drawn = (random_scene(SEED, k, 0) for k in range(20))
    scene, tally = next(s for s in drawn if s.table["gravity"][0] and s.table["joint"]), Tally()
    solved = state_properties.solve(scene, wrong(scene.table, 0.0, *state_of(scene.table)))
    right = state_properties.solve(scene)
    mechanism = build(scene.table)
    redundant = udk.analyse(mechanism).redundant_rows
    assert redundant is not None
    a, safe = state_properties.accelerate(scene, mechanism, redundant)
    assert safe and np.max(abs(a - right.a) / right.unit) < 1e-10
    state_properties.check_accelerations(tally, scene, solved, a, 1.0)
    assert any(f.worst > PROPERTIES[name].tolerance for name, f in tally.found.items())


def test_numbers_of_tables_are_those_of_mechanisms():
    for k in range(30):
        table = random_scene(SEED, k, 0).table
        mechanism = build(table)
        right = np.concatenate([np.ravel(x) for x in mechanism.numbers])
        found = state_properties.numbers_of(mechanism, [table])[0]
        np.testing.assert_allclose(found, right, rtol=1e-12, atol=1e-15 * abs(right).max())


def test_shrinking_leaves_what_fails():
    table = random_scene(SEED, 0, 0, bodies=(5, 5)).table
    body = table["joint"][0]["bodies"][1]
    small = shrunk(table, lambda t: any(body in j["bodies"] for j in t["joint"]) and build(t) is not None)
    assert len(small["joint"]) == 1 and not small["driver"] and not small["force"] and len(small["body"]) <= 2


def test_the_page_is_that_of_the_data():
    assert (HERE / "properties.md").read_text(encoding="utf-8") == page(load("properties"))


def test_what_is_not_a_number_is_the_worst():
    tally = Tally()
    tally.add("x", [1.0, math.nan], "here")
    other = Tally()
    other.add("x", 0.5, "there")
    other.merge(tally)
    assert other.found["x"].worst == math.inf and other.found["x"].cases == 3 and other.found["x"].at == "here"


@pytest.mark.parametrize(("kind", "count"), [("files", 120), ("arguments", 60)])
def test_fuzz(kind, count, tmp_path, monkeypatch):
    """For any input the answer is a result, or a documented error that names the place."""
    monkeypatch.chdir(tmp_path)
    draw = cases_of(kind, SEED)
    found = {}
    for k in range(count):
        case = draw(k)
        wrong, text = verdict(case)
        if wrong:
            found[k, case.about] = wrong, text
    assert not found, found


def test_wrong_arguments_are_given_to_each_type_of_the_format():
    types = {cls.__name__ for known in CLASSES_BY_TYPE.values() for cls in known.values()}
    missing = types - fuzz_arguments.ELEMENTS.keys()
    assert not missing, f"give arguments for each in ELEMENTS of experiments/parts/fuzz_arguments.py: {sorted(missing)}"


@pytest.mark.parametrize("name", fuzz_arguments.ELEMENTS)
def test_every_field_is_named(name):
    """For any value of a field, the error names the element and the field."""
    given = fuzz_arguments.ELEMENTS[name]
    for key in given:
        for wrong in (object(), np.array(["a"]), np.full((2, 5), np.nan), udk.SVD):
            with pytest.raises(udk.SceneError, match=rf"\b{key}\b"):
                fuzz_arguments._element(name, **{**given, key: wrong})


@pytest.mark.parametrize(
    ("make", "name"),
    [(udk.SVD, "rank_tol"), (udk.NullSpaceSVD, "rank_tol"), (udk.Baumgarte, "alpha"), (lambda x: udk.State(x, [[0.0] * 3]), "q")]
    + [(lambda x: udk.Coordinate("b", "x", x), "points"), (lambda x: udk.library.simple_pendulum().with_parameters(x), "values")],
)
def test_every_number_is_named(make, name):
    for wrong in (object(), "text", udk.SVD):
        with pytest.raises((TypeError, udk.SceneError), match=name):
            make(wrong)


KINDS_OF_VALUES: dict[str, Any] = {
    "an object": object(),
    "settings": udk.Baumgarte(),
    "a complex number": 1j,
    "an empty list": [],
    "an empty mapping": {},
    "a mapping without names": {3: 1.0},
    "a mapping to a mapping": {"b": {}},
    "a mapping to a complex number": {"b": 1j},
    "a number": np.array(1.0),
    "a vector": np.ones(3),
    "flat coordinates": np.zeros(6),
    "coordinates": np.zeros((2, 3)),
    "complex coordinates": np.zeros((2, 3), complex),
    "an integer": np.array(2),
}
FUNCTIONS = {name: (function, given) for name, function, given in fuzz_arguments.targets() if "mechanism" in given}


@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x in fuzz_arguments.SELDOM)) for x in FUNCTIONS])
def test_every_argument_of_a_wrong_kind_is_named(name):
    """A value of another kind than the argument's is accepted, or the error names the argument; traced values likewise."""
    function, given = FUNCTIONS[name]
    found = {}
    for parameter in fuzz_arguments.parameters_of(function, given):
        for kind, value in KINDS_OF_VALUES.items():
            for traced in ["", parameter] if fuzz_arguments.is_traceable(value) else [""]:
                case = fuzz_arguments.case_of(name, function, given, {parameter: value}, traced)
                if (answer := verdict(case))[0]:
                    found[case.about, kind] = answer
    assert not found, found


def traced(function: Any, given: dict[str, Any], mass: Any) -> Any:
    found = function(**(given | {"mechanism": given["mechanism"].with_parameters({"body.b.mass": mass})}))
    return [x for x in jax.tree.leaves(found) if isinstance(x, jax.Array)]


def test_traced_mechanisms_are_refused_by_functions_of_concrete_numbers():
    for name in ("branches", "check", "equilibria", "identify", "check_gradients", "design_experiment", "sweep"):
        with pytest.raises(TypeError, match=f"^mechanism must be concrete, not traced: {name} "):
            jax.eval_shape(functools.partial(traced, *FUNCTIONS[name]), 1.0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_traces_or_refuses_traced_numbers(name):
    """No error of JAX itself reaches the user."""
    try:
        jax.eval_shape(functools.partial(traced, *FUNCTIONS[name]), 1.0)
    except jax.errors.JAXTypeError as error:
        pytest.fail(str(error))
    except (TypeError, ValueError) as error:
        assert type(error).__module__.startswith("udkjax"), error


def test_a_folder_is_no_file_to_write(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    udk.save(udk.library.simple_pendulum(), "scene.toml")
    with pytest.raises(SystemExit, match="2"):
        main(["simulate", "scene.toml", "--t1", "0.1", "--out", "."])
    assert "--out" in capsys.readouterr().err


def test_verdicts():
    """Errors of other kinds, from other places, or without a place count as faults."""
    assert "not a documented error" in verdict(Case("", lambda: {}["x"]))[0]
    assert "from json/decoder.py" in verdict(Case("", lambda: json.loads("{")))[0]
    assert "place" in verdict(Case("", lambda: udk.loads("format = 1"), ["nowhere"]))[0]
    assert verdict(Case("", lambda: udk.loads("format = 1"), ["body"]))[0] == ""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["files", "commands"])
def test_fuzz_in_processes(kind):
    *_, (done, faults) = run(kind, SEED, 0, 40, 300.0)
    assert done == 40 and not faults, faults
