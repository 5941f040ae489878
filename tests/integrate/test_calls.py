"""Calls with known numbers: the work between `simulate` and machine code, and the programs compiled before a first result."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import listening
from udkjax.expressions import read_jaxpr
from udkjax.integrate.events.run import condition_program
from udkjax.native import loaded_code
from udkjax.programs.deferred import _trace, deferred_p

ROOT = Path(udk.__file__).parent
TS = np.linspace(0.0, 0.2, 5)
SIX_BAR = ROOT.parent / "examples" / "six_bar.toml"


def called(function: Callable[[], object]) -> set[tuple[str, str]]:
    """Return the functions of the package that run, by file and name. Comprehensions count as part of their function."""
    seen = set()

    def listen(frame, event, _):
        code = frame.f_code
        if event == "call" and Path(code.co_filename).is_relative_to(ROOT) and not code.co_name.startswith("<"):
            seen.add((code.co_filename, code.co_qualname))

    listened(function, listen)
    return seen


def listened(function: Callable[[], object], listen: Callable[..., None]):
    """Call a function with a listener to its calls."""
    with listening(listen):
        function()


def pendulums(count: int) -> udk.Mechanism:
    """Bodies that hang next to each other. Each count is another structure."""
    bodies = {f"b{k}": udk.Body(1.0, 0.1, [float(k), -0.5], 0.3) for k in range(count)}
    joints = {f"j{k}": udk.Revolute(["ground", f"b{k}"], [[float(k), 0.0], [0.0, 0.5]]) for k in range(count)}
    return udk.Mechanism(bodies, joints)


def test_few_functions_stand_between_a_call_and_machine_code(monkeypatch):
    monkeypatch.setattr(loaded_code, "QUICK_MEMBERS", 0)  # by code that serves for good
    mechanism = udk.library.parallelogram()
    udk.simulate(mechanism, TS)
    seen = called(lambda: udk.simulate(mechanism, TS))
    assert len(seen) <= 40
    assert len({file for file, _ in seen}) <= 13


DRAWN, DRIVEN = udk.library.four_bar(), udk.library.slider_crank()
WITH_MOTOR = udk.Mechanism(DRAWN.bodies, DRAWN.joints, forces={"motor": udk.Torque(["ground", "crank"], 1.0)})

# The calls of Python of a repeated call with concrete numbers, a few more than at the last count, before
# programs are compiled that run often: a microsecond for three.
MOST_CALLS: dict[str, tuple[int, Callable[[Any, Any], object]]] = {
    "simulate": (67, lambda state, run: udk.simulate(DRAWN, TS, state)),
    "step": (35, lambda state, run: udk.step(DRAWN, state, None, 1e-3)),
    "step with an input": (35, lambda state, run: udk.step(WITH_MOTOR, state, {"force.motor.value": 1.0}, 1e-3)),
    "step of another drawing": (36, lambda state, run: udk.step(DRAWN, state, {"link.crank.width": 0.02}, 1e-3)),
    "assemble": (16, lambda state, run: udk.assemble(DRAWN)),
    "accelerations": (113, lambda state, run: udk.accelerations(DRAWN, 0.0, state.q, state.v)),
    "energy": (47, lambda state, run: udk.energy(DRAWN, run)),
    "violation": (47, lambda state, run: udk.violation(DRAWN, run)),
    "reactions": (172, lambda state, run: udk.reactions(DRAWN, run)),
    "kinematics": (115, lambda state, run: udk.kinematics(DRAWN, "body.crank.angle", [1.0, 1.01, 1.02])),
    "inverse dynamics": (166, lambda state, run: udk.inverse_dynamics(DRIVEN, TS)),
    "another number": (62, lambda state, run: WITH_MOTOR.with_parameters({"force.motor.value": 1.0})),
    "another drawing": (1050, lambda state, run: DRAWN.with_parameters({"link.crank.width": 0.02})),
}


@pytest.mark.skipif(deferred_p is None, reason="this JAX evaluates a program in other calls")
def test_a_repeated_call_of_a_public_function_makes_few_calls():
    state = udk.assemble(DRAWN)
    run, counts = udk.simulate(DRAWN, TS, state), {}
    for name, (_, function) in MOST_CALLS.items():
        for _ in range(3):
            function(state, run)
        made = Counter()

        def listen(frame, event, _, made=made):
            code = frame.f_code
            if event == "call" and Path(code.co_filename).is_relative_to(ROOT) and not code.co_name.startswith("<"):
                made[code.co_qualname] += 1

        listened(lambda function=function: function(state, run), listen)
        counts[name] = made.total()
    assert {name: n for name, n in counts.items() if n > MOST_CALLS[name][0]} == {}


def test_an_eager_gradient_by_a_number_makes_few_calls():
    """The numbers of a mechanism are looked up without Python, and NumPy's steps are its own functions."""
    mechanism, count = udk.library.parallelogram(), 0

    def last(mass):
        return udk.simulate(mechanism.with_parameters({"body.coupler.mass": mass}), TS).q[-1, 0, 2]

    def listen(frame, event, _):
        nonlocal count
        count += event == "call" and Path(frame.f_code.co_filename).is_relative_to(ROOT) and frame.f_code.co_name[0] != "<"

    slope = jax.grad(last)
    for k in range(40):
        slope(1.5 + 0.01 * k)
    listened(lambda: slope(2.5), listen)
    assert count <= 850


def test_what_is_decided_of_a_mechanism_is_decided_once():
    mechanism = udk.library.parallelogram()
    udk.simulate(mechanism, TS)
    names = {name for _, name in called(lambda: udk.simulate(mechanism, 2.0 * TS, rtol=1e-6))}
    assert not names & {"structure", "scene_programs", "compile_mechanism", "has_pieces", "_analyse"}


def visited(function: Callable[[], object]) -> Counter[str]:
    """Return the types of the trees whose numbers are listed meanwhile, and how often arrays are put on a device."""
    seen: Counter[str] = Counter()

    def listen(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith("<generated_flatten_"):
            seen[code.co_filename[len("<generated_flatten_") : -1]] += 1
        if event == "call" and code.co_name == "device_put" and code.co_filename.endswith("api.py"):
            seen["device_put"] += 1

    listened(function, listen)
    return seen


FRICTION = udk.Friction("j0", coefficient=0.1, radius=0.01, law="set-valued")


@pytest.mark.parametrize(
    "friction, events",
    [
        ({"rubs": FRICTION}, None),
        ({}, udk.JointLimit("j0", lower=0.0, restitution=0.5)),
        ({}, udk.Event(lambda t, frames: frames["b0"].angle + 0.05, udk.Stop())),
    ],
    ids=["friction that sticks", "impacts", "stop"],
)
def test_a_repeated_run_with_events_visits_no_number_of_the_scene(friction, events):
    """It is decided once whether the numbers of a mechanism and of events are traced, and what follows from them."""
    mechanism = pendulums(1)
    mechanism = udk.Mechanism(mechanism.bodies, mechanism.joints, forces=friction)
    run = lambda: udk.simulate(mechanism, 5.0 * TS, events=events)  # noqa: E731
    assert visited(run)["Body"]  # a new mechanism is visited
    seen = visited(run)
    assert seen.keys() <= {"Solution", "Events", "SceneChanges", "Auto", "Projection", "device_put"}
    assert seen["device_put"] <= 1  # all results at once


@pytest.mark.parametrize(
    "changed",
    [
        lambda mechanism, k: (mechanism.with_parameters({"force.rubs.coefficient": 0.1 + 0.01 * k}), None),
        lambda mechanism, k: (mechanism, udk.JointLimit("j0", lower=0.01 * k)),
        lambda mechanism, k: (mechanism, udk.Contact("b0", [0.0, -0.6], [0.0, -1.099 - 2e-4 * k], coefficient=0.3)),
    ],
    ids=["friction", "limit", "contact"],
)
def test_other_numbers_of_events_need_no_other_programs(changed):
    """Conditions, forces, joints that events add, and their places among all numbers follow from the structure."""
    mechanism = pendulums(1)
    mechanism = udk.Mechanism(mechanism.bodies, mechanism.joints, forces={"rubs": FRICTION})

    def run(k: int) -> None:
        scene, events = changed(mechanism, k)
        solutions.append(udk.simulate(scene, 5.0 * TS, events=events))

    solutions: list[udk.Solution] = []
    run(0)
    names = {name for _, name in called(lambda: run(1))}
    assert "run_loop" in names
    assert not names & {"_conditions", "with_forces", "added_joints", "phase_plan", "read_jaxpr", "places_of_sides", "trace"}
    for solution in solutions:
        assert solution.settings["engine"] == "native"
        assert int(solution.stats["events"]) > 0


def test_the_trace_of_a_condition_has_its_own_operations_and_those_of_frames(monkeypatch):
    """Bodies that it does not name cost a cosine and a sine each, and no reading of coordinates."""

    def operations(count: int) -> int:
        mechanism = pendulums(count)
        event = udk.Event(lambda t, frames: frames["b0"].angle * frames["b0"].omega, udk.Log())
        traced.clear()
        udk.simulate(mechanism, TS, events=event)
        (closed,) = traced
        return len(closed.eqns)

    def read(graph, closed, arguments):
        traced.append(closed)
        return read_jaxpr(graph, closed, arguments)

    traced: list[Any] = []
    monkeypatch.setattr(condition_program, "read_jaxpr", read)
    assert operations(1) <= 5
    assert operations(4) == operations(1) + 3 * 2


def test_a_repeated_step_visits_no_number_of_the_scene():
    """Nor does it put arrays on a device: the numbers of the mechanism are one array, those of the call another."""
    mechanism = pendulums(2)
    state = udk.assemble(mechanism)
    step = lambda: udk.step(mechanism, state, {"body.b0.mass": 1.5}, 1e-3)  # noqa: E731
    assert visited(step)["Body"]
    assert visited(step) == {}


LEVEL = [0.0]


def falls_below_level(t, frames):
    return frames["b0"].angle - LEVEL[0]


def test_a_new_event_is_traced_anew():
    """Its condition is the same function, and may read something that has changed."""

    mechanism, found = pendulums(1), []
    for level in (0.0, -0.05):
        LEVEL[0] = level
        found.append(np.asarray(udk.simulate(mechanism, 5.0 * TS, events=udk.Event(falls_below_level, udk.Stop())).time))
    assert found[0] < found[1] < 5.0 * TS[-1]


@pytest.mark.parametrize("of_run", [None, jax.jacfwd, jax.grad])
def test_a_compiled_run_does_nothing_to_the_outputs_of_machine_code(of_run):
    """JAX hands programs of more than a thousand operations to another thread, which takes 0.05 ms.

    Derivatives only look which outputs are undefined: some operations for each number.
    """
    mechanism = udk.library.parallelogram()

    def operations(outputs: int) -> float:
        def last(mass):
            found = mechanism.with_parameters({"body.coupler.mass": mass})
            return udk.simulate(found, np.linspace(0.0, 1.0, outputs), throw=False).q[-1, 0, 2]

        cost = jax.jit(of_run(last) if of_run else last).lower(1.0).compile().cost_analysis()
        assert cost is not None
        return cost["flops"]

    numbers = 2 * mechanism.q0.size
    added = operations(401) - operations(3)
    assert operations(3) < (1000 if of_run is None else 1500) and (added == 0 if of_run is None else added <= 8 * numbers * 398)


@pytest.mark.parametrize("count, transform", [(2, jax.grad), (3, jax.jacfwd)])
def test_an_eager_derivative_takes_few_programs(compilations, count, transform):
    """All of them are single operations of JAX. NumPy does the rest of the assembly, the run and the reverse pass."""
    mechanism = pendulums(count)

    def last(mass):
        return udk.simulate(mechanism.with_parameters({"body.b0.mass": mass}), TS).q[-1, 0, 2]

    transform(lambda x: 2.0 * x)(1.5)  # what JAX compiles for any function
    assert len([seconds for seconds in compilations(lambda: transform(last)(1.5)) if seconds]) <= 16
    assert compilations(lambda: transform(last)(1.7)) == []


class Stop(udk.ForceElement):
    """An elastic stop at -0.1 rad."""

    def loads(self, t, *frames):
        return [(0.0, 0.0, 1e3 * jnp.maximum(-0.1 - frames[0].angle, 0.0))]


def test_an_eager_derivative_of_a_run_with_kinks_takes_few_programs(compilations):
    """Nor are the events of a run listed by single operations."""
    mechanism = pendulums(1)
    mechanism = udk.Mechanism(mechanism.bodies, mechanism.joints, forces={"stop": Stop(["b0"])})

    def last(mass):
        return udk.simulate(mechanism.with_parameters({"body.b0.mass": mass}), 5.0 * TS).q[-1, 0, 2]

    jax.grad(lambda x: 2.0 * x)(1.5)
    assert len([seconds for seconds in compilations(lambda: jax.grad(last)(1.5)) if seconds]) <= 16


def test_an_eager_batch_takes_few_programs(compilations):
    mechanism = pendulums(4)

    def run(mass):
        return udk.simulate(mechanism.with_parameters({"body.b0.mass": mass}), TS).q

    masses = np.linspace(1.0, 2.0, 3)
    assert len([seconds for seconds in compilations(lambda: jax.vmap(run)(masses)) if seconds]) <= 3


def test_a_batch_at_once_is_its_members():
    mechanism, masses = pendulums(2), np.linspace(1.0, 2.0, 3)
    run = lambda mass: udk.simulate(mechanism.with_parameters({"body.b1.inertia": mass}), TS).q  # noqa: E731
    assert_allclose(jax.vmap(run)(masses), [run(float(x)) for x in masses], rtol=1e-9)


@pytest.mark.slow
def test_a_first_event_and_its_derivative_take_few_programs(compilations):
    """The loop over windows is not compiled, which would take seconds."""
    lowest = udk.Event(lambda t, frames: frames["b0"].angle, udk.Stop())
    mechanism, ts = pendulums(1), np.linspace(0.0, 2.0, 5)

    def time(mass):
        changed = mechanism.with_parameters({"body.b0.mass": mass})
        events = udk.simulate(changed, ts, events=lowest, max_events=1).events
        assert events is not None
        return events.time[0]

    assert len([seconds for seconds in compilations(lambda: time(1.5)) if seconds]) <= 4
    assert len([seconds for seconds in compilations(lambda: jax.grad(time)(1.5)) if seconds]) <= 16


@pytest.mark.skipif(deferred_p is None, reason="this JAX evaluates a program operation by operation")
@pytest.mark.parametrize(
    "simulated",
    [
        lambda a: udk.simulate(udk.library.four_bar(a), TS),
        lambda a: udk.simulate(udk.library.parallelogram(a), TS),
        lambda a: udk.simulate(udk.load(SIX_BAR).with_parameters({"pin.B": a * np.ones(2)}), TS, throw=False),
        lambda a: udk.kinematics(udk.library.four_bar(a), "body.crank.angle", 1.0 + TS),
    ],
    ids=["function of the library", "with redundant rows", "drawing", "kinematics"],
)
def test_eager_transformations_over_a_geometry_take_few_operations(simulated):
    """Each takes some 0.1 ms per call outside jit. Geometry and scales are one operation each, whatever the mechanism."""
    assert len(jax.make_jaxpr(lambda a: simulated(a).q)(1.0).eqns) < 310


@pytest.mark.slow
@pytest.mark.skipif(deferred_p is None, reason="this JAX has another cache")
def test_an_event_that_is_written_in_the_function_it_serves_is_traced_once():
    """Its condition is a new function in each call, and yet the same condition, unless it compares with another level."""
    mechanism, ts = pendulums(1), np.linspace(0.0, 1.0, 5)

    def crossed(inertia, level):
        changed = mechanism.with_parameters({"body.b0.inertia": inertia})
        event = udk.Event(lambda t, frames: frames["b0"].angle - level, udk.Log())
        events = udk.simulate(changed, ts, events=event, max_events=2).events
        assert events is not None
        return events.time[0]

    start = float(udk.assemble(mechanism).q[0, 2])
    slopes = [float(jax.grad(crossed)(0.1, start - 0.01)) for _ in range(2)]
    traced = _trace.cache_info().misses
    slopes.append(float(jax.grad(crossed)(0.1, start - 0.01)))
    assert _trace.cache_info().misses == traced and len(set(slopes)) == 1
    other = float(jax.grad(crossed)(0.1, start - 0.02))
    assert other != slopes[0] and np.isfinite(other)
    h = 1e-5
    difference = (crossed(0.1 + h, start - 0.02) - crossed(0.1 - h, start - 0.02)) / (2 * h)
    assert_allclose(other, difference, rtol=1e-6)


class Told(udk.ForceElement):
    """A constant force that calls `told` whenever it is evaluated."""

    told: Callable[[object], None] = eqx.field(static=True)

    def loads(self, t, body):
        jax.debug.callback(self.told, t)
        return [(0.0, 1.0, 0.0)]


@pytest.mark.slow
def test_a_force_that_calls_back_is_run_by_diffrax():
    """`jax.debug.print` shows what a force is evaluated at, as in any other JAX function."""
    rod, times = udk.library.compound_pendulum(), []
    run = udk.simulate(udk.Mechanism(rod.bodies, rod.joints, forces=[Told(("rod",), times.append)]), TS)
    lifted = udk.simulate(udk.Mechanism(rod.bodies, rod.joints, forces=[udk.Force("rod", (0.0, 1.0))]), TS)
    assert_allclose(run.q, lifted.q, atol=1e-9)
    assert "debug_callback" in run.settings["engine"] and float(np.max(times)) == pytest.approx(TS[-1])
