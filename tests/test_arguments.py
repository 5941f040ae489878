"""Invalid arguments of public functions are refused by name before anything is computed; traced ones lead to a result code."""

import inspect
import re
import traceback
from types import SimpleNamespace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk

TS = np.linspace(0.0, 0.2, 3)
MECH: Any = udk.library.parallelogram()
OTHER: Any = udk.library.compound_pendulum()
N = len(MECH.body_names)
Q = np.asarray(MECH.q0)
WRONG_SHAPES = [(1, 3), (3,), (2, 3), (3, N), (N + 1, 3), (400, 3), (N, 2), (2, N, 3), (), (0, 3)]


def functions_of(parameter: str) -> list[str]:
    """Return the public functions that have this parameter."""
    found = [name for name in udk.__all__ if inspect.isfunction(getattr(udk, name))]
    found = [name for name in found if parameter in inspect.signature(getattr(udk, name)).parameters]
    assert found
    return found


def call(name: str, **given: Any) -> Any:
    """Call a public function with the given arguments, and with valid ones for all others that it requires."""
    fitting = {
        "mechanism": MECH,
        "ts": TS,
        "t": 0.0,
        "q": Q,
        "v": 0 * Q,
        "solution": SimpleNamespace(ts=TS, q=np.stack([Q] * 3), v=np.zeros((3, N, 3))),
        "motion": SimpleNamespace(ts=TS, q=np.stack([Q] * 3), v=np.zeros((3, N, 3))),
        "driver": "body.link1.angle",
        "values": [0.0, 0.1],
        "value": 0.1,
        "axes": {"rtol": [1e-6]},
        "shapes": np.ones((1, N, 3)),
        "body": "coupler",
        "drivers": {"body.link1.angle": [0.0], "body.link2.angle": [0.0]},
    }
    needed = [p.name for p in inspect.signature(getattr(udk, name)).parameters.values() if p.default is p.empty]
    missing = {p: fitting.get(p) for p in needed if p not in ("choices", "settings")}
    return getattr(udk, name)(**(missing | given))


def message(function, *arguments: Any, **given: Any) -> str:
    """Return the text of the TypeError or ValueError that a call raises."""
    with pytest.raises((TypeError, ValueError)) as error:
        function(*arguments, **given)
    return str(error.value)


@pytest.mark.parametrize("function", [udk.simulate, udk.step, udk.energy, udk.library.four_bar])
def test_arguments_that_do_not_exist_or_are_missing_are_refused_by_the_function_s_name(function):
    given = [] if function is udk.library.four_bar else [MECH] * (1 + (function is udk.simulate))
    with pytest.raises(TypeError, match=rf"^{function.__name__}\(\): .*'?(x0|state|solution|ts)'"):
        function(*given, x0=1.0)


def test_an_argument_that_is_mistyped_is_suggested():
    simulate: Any = udk.simulate
    with pytest.raises(TypeError, match=r"^simulate\(\): .*'rtoll'; did you mean \"rtol\"\?"):
        simulate(MECH, TS, rtoll=1e-6)


@pytest.mark.parametrize("name", functions_of("mechanism"))
def test_what_is_no_mechanism_is_refused(name):
    if name == "animate":  # takes several, too
        return
    for wrong in ("scene.toml", udk.Mechanism, None, 3.0, {"a": MECH}):
        assert "mechanism must be a Mechanism" in message(call, name, mechanism=wrong)


@pytest.mark.parametrize("name", functions_of("state"))
def test_a_state_of_a_wrong_shape_or_type_is_refused(name):
    for shape in WRONG_SHAPES:
        text = message(call, name, state=udk.State(np.full(shape, 7.0), np.zeros(shape)))
        assert "state.q must have the shape" in text and str((N, 3)) in text and str(shape) in text
    assert "state.v must have the shape" in message(call, name, state=udk.State(Q, np.zeros((1, 3))))
    for wrong in ((Q, 0 * Q), Q, udk.State, "rest"):
        assert "state must be a State, such as udk.State(q, v)" in message(call, name, state=wrong)
    bad = Q.copy()
    bad[1, 0] = np.nan
    assert f'state.q[1, 0] is nan (x of "{MECH.body_names[1]}")' in message(call, name, state=udk.State(bad, 0 * Q))
    with pytest.raises(ValueError, match=r"state.q must have the shape"):  # traced
        jax.eval_shape(lambda q: call(name, state=udk.State(q, q)), jnp.zeros((1, 3)))


def test_results_that_have_a_state_are_answered_with_it():
    mech = udk.library.four_bar()
    wrong: dict[str, Any] = {"not an Equilibrium; give its state: state=x.state": udk.equilibrium(mech)}
    at_times = "not a {}; give the state at one of its times: state=udk.State(x.q[k], x.v[k])"
    wrong[at_times.format("Solution")] = udk.simulate(mech, [0.0, 0.1])
    wrong[at_times.format("Kinematics")] = udk.kinematics(mech, "body.crank.angle", [1.0, 1.1])
    for text, given in wrong.items():
        with pytest.raises(TypeError, match=re.escape(text)):
            udk.modes(mech, given)


@pytest.mark.parametrize("name", [*functions_of("q"), *(f"equations.{x}" for x in ("psi", "psi_q", "force", "potential_energy"))])
def test_coordinates_of_a_wrong_shape_or_type_are_refused(name):
    function = getattr(udk.equations, name.split(".")[1]) if "." in name else getattr(udk, name)
    known = {"mechanism": MECH, "t": 0.0, "q": Q, "v": 0 * Q, "shapes": np.ones((1, N, 3))}
    known = {p: x for p, x in known.items() if p in inspect.signature(function).parameters}
    for shape in WRONG_SHAPES:
        assert f"q must have the shape {(N, 3)}" in message(function, **(known | {"q": np.zeros(shape)}))
    for wrong in ("q", None, [[1.0], [1.0, 2.0]], 1j * Q, Q > 0, udk.SVD()):
        assert message(function, **(known | {"q": wrong})).startswith("q must be")
    assert "q[0, 2] is inf (angle of" in message(function, **(known | {"q": Q + np.array([0, 0, np.inf])}))
    if "t" in known:
        assert "t must be" in message(function, **(known | {"t": np.zeros(2)}))


NUMBERS = {
    "rtol": [-1e-8, np.nan, np.inf, [1e-8, 1e-6], np.full(50, 1e-8), "1e-8", True, 1j],
    "atol": [-1e-8, np.nan, np.inf, [1e-8, 1e-8], "small"],
    "drift_tol": [-1.0, 0.0, np.nan, [1e-6, 1e-6], "tight"],
    "dt0": [-1.0, 0.0, np.nan, np.inf, [1e-3, 1e-3], "short"],
    "max_steps": [0, -1, 1.5, "many", True, [10, 10]],
    "max_events": [0, -1, 1.5, "many"],
    "ts": [[0.0], 0.0, [], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan], [0.0, np.inf], [[0.0, 1.0]], "0 to 1", [0.0, 1j]],
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_of_a_wrong_shape_sign_or_type_are_refused(name):
    for wrong in NUMBERS[name]:
        if wrong is not None:
            assert name in message(udk.simulate, **({"mechanism": MECH, "ts": TS} | {name: wrong}))


def test_tolerances_below_rounding_are_refused():
    assert "are below rounding" in message(udk.simulate, MECH, TS, rtol=1e-30, atol=0.0)
    assert udk.simulate(OTHER, TS, rtol=0.0, atol=1e-10).result.is_success


CHOICES = [
    ("stabilization", udk.Projection, "stabilization=udk.Projection()"),
    ("stabilization", "projection", "stabilization=udk.Projection()"),
    ("stabilization", 5.0, "a Baumgarte, such as udk.Baumgarte(alpha, beta)"),
    ("method", udk.SVD, "method=udk.SVD()"),
    ("method", "SVD", "method=udk.SVD()"),
    ("method", "greville", "method=udk.Greville()"),
    ("method", udk.Projection(), "method must be a Pseudoinverse"),
    ("formulation", udk.Augmented, "formulation=udk.Augmented()"),
    ("formulation", udk.SVD(), "formulation must be a Formulation"),
    ("engine", "Diffrax", 'engine must be one of "auto", "native", "diffrax", "jax", not "Diffrax"; did you mean "diffrax"?'),
    ("engine", None, "engine must be one of"),
    ("solver", diffrax.Tsit5, "solver must be an instance"),
    ("solver", "Tsit5", "solver=diffrax.Tsit5()"),
    ("solver", udk.SVD(), "solver must be an instance"),
    ("adjoint", diffrax.ForwardMode, "adjoint must be an instance"),
    ("throw", "no", "throw must be True or False"),
    ("progress", print, "progress must be True, False or a diffrax progress meter"),
    ("analysis", "rank 11", "analysis must be an Analysis"),
    ("analysis", OTHER, "analysis must be an Analysis"),
]


@pytest.mark.parametrize(("name", "wrong", "text"), CHOICES, ids=[f"{x[0]}-{k}" for k, x in enumerate(CHOICES)])
def test_choices_of_a_wrong_type_are_refused(name, wrong, text):
    assert text in message(udk.simulate, MECH, TS, **{name: wrong})


RECORD: dict[str, Any] = {"times": TS, "values": {"body.coupler.angle": 0 * TS}}
WRONG_KINDS: list[Any] = [object(), 1j, np.zeros((2, 3), complex), [object()], np.array(2.5 + 1j)]
SOLVERS = udk.Adams, udk.BDF
QUANTITY: dict[str, Any] = {"name": "height", "function": lambda mechanism, solution: solution.q[:, 0, 1]}
PATH: dict[str, Any] = {"point": "coupler", "targets": [[0.0, 0.0], [1.0, 1.0]], "values": [0.0, 1.0]}
POSE: dict[str, Any] = {"body": "coupler", "targets": np.zeros((2, 3)), "values": [0.0, 1.0]}
FUNCTION: dict[str, Any] = {"output": "body.coupler.angle", "values": [0.0, 1.0], "targets": [0.0, 1.0]}
TOLERANCE: dict[str, Any] = {"point": "coupler", "tolerances": {"body.coupler.mass": 0.1}, "most": 1.0}
CONSTRUCTORS: list[tuple[Any, dict[str, Any], str, str]] = [
    (udk.Record, RECORD, "values", "values: must map channels to numbers"),
    (udk.Record, RECORD, "noise", "noise of .*: must be real numbers|noise of .*: must be an array of numbers"),
    (udk.Record, RECORD, "initial_state", "initial_state: must be a State or a Start"),
    (udk.Record, RECORD, "t0", "t0: must be"),
    (udk.Record, RECORD, "conditions", "conditions: must map names of parameters to values"),
    (udk.Start, {}, "state", "initial_state: must be a State or a Start"),
    (udk.Start, {}, "estimate", "estimate must be one of"),
    (udk.Axis, {"values": [1.0]}, "of", "of must be a name, a list of names or a function"),
    (udk.Sobol, {"n": 4}, "n", "n must be"),
    (udk.Random, {"n": 4}, "seed", "seed must be"),
    (udk.Adams, {}, "min_order", "min_order must be"),
    (udk.BDF, {}, "max_order", "max_order must be"),
    (udk.Coordinate, {}, "bodies", "bodies must be a name, or a list of names"),
    (udk.Coordinate, {"bodies": ["ground", "coupler"]}, "coordinate", "coordinate must be one of"),
    *((solver, {}, "root_find_max_steps", "root_find_max_steps must be") for solver in SOLVERS),
    (udk.Parameter, {}, "of", "of must be a name, a list of names, a length or a function"),
    *((udk.Parameter, {"of": "gravity"}, name, f"{name} must be") for name in ("guess", "bounds", "prior", "scale")),
    *((udk.Parameter, {"of": "gravity"}, name, f"{name} must be") for name in ("name", "transform", "share")),
    *((udk.Quantity, QUANTITY, name, f"{name} must be") for name in ("name", "function", "units")),
    *((udk.PathGoal, PATH, name, f"{name} must be") for name in ("point", "targets", "values", "start", "line", "at")),
    *((udk.PoseGoal, POSE, name, f"{name} must be") for name in ("body", "targets", "arm", "pin", "values", "start", "line")),
    *((udk.FunctionGoal, FUNCTION, name, f"{name} must be") for name in ("output", "values", "targets", "output_start")),
    *((udk.ToleranceGoal, TOLERANCE, name, f"{name} must ") for name in ("point", "tolerances", "most", "weight", "samples")),
    (udk.RobustGoal, {"goal": udk.EnergyGoal(most=1.0), "tolerances": {"gravity": 0.1}}, "sigmas", "sigmas must "),
    (udk.LoadGoal, {"most": 1.0}, "joint", "joint must be"),
    (udk.MotionGoal, {"most": 1.0}, "function", "function must be"),
]


@pytest.mark.parametrize(("make", "given", "name", "text"), CONSTRUCTORS, ids=[f"{x[0].__name__}-{x[2]}" for x in CONSTRUCTORS])
def test_values_of_the_wrong_kind_are_refused_by_constructors(make, given, name, text):
    for wrong in WRONG_KINDS:
        assert re.search(text, message(lambda wrong=wrong: make(**(given | {name: wrong}))))


@pytest.mark.parametrize("name", ["condition", "action", "direction", "name"])
def test_values_of_the_wrong_kind_are_refused_in_events(name):
    given: dict[str, Any] = {"condition": lambda t, at: at["coupler"].y - 9.0}
    for wrong in WRONG_KINDS:
        text = message(udk.simulate, MECH, TS, events=[udk.Event(**(given | {name: wrong}))])
        assert re.match(rf"events\[0\]: .*{name} must be", text)


def test_axes_of_the_wrong_kind_are_refused_in_a_sweep():
    for wrong in (*WRONG_KINDS, {}, {3: [1.0]}, "body.coupler.mass", None):
        assert "Zipped" in message(udk.sweep, MECH, {"loads": udk.Zipped(wrong)}, ts=TS)  # pyright: ignore[reportArgumentType]


def test_a_solver_without_an_error_estimate_is_refused_with_the_cure():
    for choices in ({}, {"dt0": 1e-3}):
        assert "Euler does not estimate any; give a solver such as" in message(
            udk.simulate, MECH, TS, solver=diffrax.Euler(), **choices
        )


def test_thresholds_and_gains_of_no_use_are_refused():
    wrongs: list[Any] = [[1e-3, 1e-4], -1.0, np.nan]
    for wrong in wrongs:
        assert "method.rank_tol must be" in message(udk.simulate, MECH, TS, method=udk.SVD(wrong))
        assert "method.branch_tol must be" in message(udk.accelerations, MECH, 0.0, Q, 0 * Q, method=udk.Auto(branch_tol=wrong))
        assert "stabilization.alpha must be" in message(udk.simulate, MECH, TS, stabilization=udk.Baumgarte(wrong))


def test_a_batch_of_mechanisms_is_refused_and_mapped_over_it_is_not():
    batch = jax.tree.map(lambda *x: np.stack(x), OTHER, OTHER)
    for name in functions_of("mechanism"):
        if name not in ("animate", "save", "dumps"):
            assert "mechanism is a batch of mechanisms" in message(call, name, mechanism=batch)
    assert jax.vmap(lambda m: udk.accelerations(m, 0.0, OTHER.q0, OTHER.v0))(batch).shape == (2, 1, 3)


def test_the_analysis_of_another_mechanism_is_refused_and_that_of_other_numbers_is_not():
    assert "analysis belongs to another mechanism" in message(udk.simulate, MECH, TS, analysis=udk.analyse(OTHER))
    lighter = MECH.with_parameters({"body.coupler.mass": 1.0})
    assert udk.simulate(lighter, TS, analysis=udk.analyse(MECH)).result.is_success


@pytest.mark.parametrize("name", [x for x in functions_of("solution") if x != "animate"])
def test_the_solution_of_another_mechanism_or_of_a_batch_is_refused(name):
    if inspect.signature(getattr(udk, name)).parameters["solution"].default is None:
        assert "solution" in message(call, name, solution=7.0)
    other = udk.simulate(OTHER, TS)
    assert 'solution belongs to another mechanism: its bodies are "rod"' in message(call, name, solution=other)
    batch = SimpleNamespace(ts=np.stack([TS] * 2), q=np.zeros((2, 3, N, 3)), v=np.zeros((2, 3, N, 3)))
    assert "solution is a batch of 2 solutions" in message(call, name, solution=batch)
    cut = SimpleNamespace(ts=TS, q=np.zeros((2, N, 3)), v=np.zeros((2, N, 3)))
    assert "solution must have ts (T,), q and v (T, bodies, 3)" in message(call, name, solution=cut)
    for wrong in (udk.Solution, "run.nc", Q):
        assert "solution must have times and states" in message(call, name, solution=wrong)


def test_settings_of_studies_are_those_of_simulate():
    for wrong in ({"rtol": -1.0}, {"method": "SVD"}, {"stabilization": udk.Projection}, {"dt0": np.nan}):
        name = next(iter(wrong))
        assert name in message(udk.sweep, MECH, {"body.coupler.mass": [1.0]}, TS, **wrong)
    for axis in ({"rtol": [1e-6, np.nan]}, {"drift_tol": [0.0, 1.0]}, {"max_steps": [0]}):
        assert next(iter(axis)) in message(udk.sweep, MECH, axis, TS)
    record = {"t": TS, "body.link1.angle": np.zeros(3)}
    assert "method must be" in message(udk.identify, MECH, record, "body.link1.mass", method=udk.SVD)


def test_a_member_with_a_number_that_is_not_finite_is_an_invalid_argument():
    """For masses, points, gravity, motions of drivers and stiffnesses; other members are unaffected."""
    crank = udk.library.slider_crank()
    springs = {"spring": udk.Spring(["ground", "slider"], [[3.0, 0.0], [0.0, 0.0]], stiffness=1.0, length=0.5, damping=0.1)}
    driver = {"motor": udk.Driver(["ground", "crank"], "angle", udk.Polynomial([crank.q0[0, 2], 1.0]))}
    scene = udk.Mechanism(crank.bodies, crank.joints, driver, springs, crank.gravity)
    right = {name: np.asarray(x) for name, x in scene.parameters().items()}
    rows = [right]
    for name, x in right.items():
        for bad in (np.nan, np.inf):
            rows.append(right | {name: np.where(np.arange(x.size).reshape(x.shape) == x.size - 1, bad, x)})
    rows.append(right)
    run = lambda values: udk.simulate(scene.with_parameters(values), TS, throw=False)  # noqa: E731
    found = jax.jit(jax.vmap(run))(jax.tree.map(lambda *x: np.stack(x), *rows))
    good, invalid = udk.Result.successful, udk.Result.invalid_argument
    assert found.code.tolist() == [good, *[invalid] * (len(rows) - 2), good]
    np.testing.assert_allclose(np.asarray(found.q)[[0, -1]], np.stack([udk.simulate(scene, TS).q] * 2), rtol=0, atol=1e-12)


@pytest.mark.parametrize("events", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_turns_out_to_be_of_no_use_is_the_result_of_a_member(events):
    """Only the shapes of traced numbers are known in advance: the affected run, and no other, returns the result."""
    listed = udk.Event(lambda t, at: at["rod"].angle - 10.0, udk.Log()) if events else None
    state = udk.assemble(OTHER)

    def run(ts, rtol, q, drift_tol, mass, lower):
        given = udk.State(q, state.v)
        known = [listed, udk.JointLimit("pin", lower, 9.0)] if events else None
        scene = OTHER.with_parameters({"body.rod.mass": mass})
        found = udk.simulate(scene, ts, given, rtol=rtol, drift_tol=drift_tol, events=known, throw=False)
        return found.code, found.q, found.ts

    right = (TS, 1e-8, state.q, 1e-6, 2.0, -9.0)
    wrong = [(0, TS[::-1]), (0, TS * np.nan), (1, -1e-8), (1, np.nan), (2, state.q * np.nan), (3, -1e-6), (4, -1.0), (4, np.nan)]
    wrong += [(5, 10.0)] * events
    rows = [right, *((*right[:k], x, *right[k + 1 :]) for k, x in wrong)]
    code, q, ts = jax.jit(jax.vmap(run))(*(np.stack([np.asarray(row[k]) for row in rows]) for k in range(len(right))))
    assert code.tolist() == [udk.Result.successful, *[udk.Result.invalid_argument] * (len(rows) - 1)]
    np.testing.assert_allclose(q[0], udk.simulate(OTHER, TS, state).q, rtol=1e-12)
    assert np.isnan(q[1:, 1:]).all()
    np.testing.assert_array_equal(ts, np.stack([row[0] for row in rows]))


def _with_length(p):
    pins = {"O": (0, 0), "C": (0.1, 0), "A": udk.polar("O", 0.04, 1.0), "B": udk.circles(("A", "C"), (0.12, 0.08), "left")}
    ends = {"crank": ["O", "A"], "coupler": ["A", "B"], "rocker": ["C", "B"]}
    links = {name: {"pins": pair, "mass": 1} for name, pair in ends.items()}
    return udk.Drawing(pins=pins, links=links, ground=["O", "C"]).mechanism().with_parameters({"pin.A.length": p})


_STATE = udk.assemble(udk.library.four_bar())
_USES = {
    "simulate": lambda m: udk.simulate(m, [0.0, 1.0]).q[-1, 0, 2],
    "assemble": lambda m: udk.assemble(m).q[0, 2],
    "kinematics": lambda m: udk.kinematics(m, "body.crank.angle", [1.0]).q[0, 0, 2],
    "equilibrium": lambda m: udk.equilibrium(m).q[0, 2],
    "modes": lambda m: udk.modes(m).omega2.sum(),
    "step": lambda m: udk.step(m, _STATE, {}, 0.01).q[0, 2],
    "accelerations": lambda m: udk.accelerations(m, 0.0, _STATE.q, _STATE.v).sum(),
    "energy": lambda m: udk.energy(m, udk.simulate(m, [0.0, 1.0])).kinetic.sum(),
}
_WRONG = {
    "length": _with_length,
    "mass": lambda p: udk.library.four_bar().with_parameters({"body.coupler.mass": -p}),
}


@pytest.mark.parametrize("wrong", _WRONG.values(), ids=_WRONG)
@pytest.mark.parametrize("use", _USES.values(), ids=_USES)
def test_eager_derivatives_raise_the_errors_of_the_call(use, wrong):
    """Their numbers are concrete, although JAX traces them."""
    run, messages = (lambda p: use(wrong(p))), []
    for call in (run, jax.grad(run), jax.jacfwd(run)):
        with pytest.raises((ValueError, udk.SimulationError)) as error:
            call(0.5)
        messages.append(f"{error.type.__name__} {error.value}")
    assert messages[0] == messages[1] == messages[2]


@pytest.mark.parametrize(
    "call",
    [
        lambda m: udk.step(m, _STATE, {"nothing": 1.0}, 0.01),
        lambda m: jax.grad(lambda x: udk.step(m, _STATE, {"nothing": x}, 0.01).q.sum())(1.0),
        lambda m: udk.kinematics(m, "nothing", [1.0]),
    ],
)
def test_a_refusal_is_short(call):
    """It names the place and the cure; the frames of JAX in which it was found say nothing to the user."""
    with pytest.raises(udk.SceneError) as error:
        call(udk.library.four_bar())
    lines = "".join(traceback.format_exception(error.value)).splitlines()
    assert "nothing" in str(error.value) and len(lines) < 20 and sum(line.startswith("Traceback") for line in lines) == 1
