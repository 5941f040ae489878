"""Arguments that are wrong: of every public function and class of scenes and events, one or two at a time, traced ones too."""

import functools
import inspect
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.fuzz import Case
from udkjax.equations.states import evaluate
from udkjax.wording import quote

POINTS = [[0.0, 0.0], [0.1, 0.2]]
ELEMENTS: dict[str, dict[str, Any]] = {
    "Body": {"mass": 1.0, "inertia": 0.1, "position": [0.0, 1.0], "angle": 0.1, "velocity": [0.0, 0.0], "angular_velocity": 0.0},
    "Revolute": {"bodies": ["ground", "b"], "points": POINTS},
    "Prismatic": {"bodies": ["ground", "b"], "points": POINTS, "axis": 0.1, "angle": 0.0},
    "Slot": {"bodies": ["ground", "b"], "points": POINTS, "axis": 0.1},
    "Weld": {"bodies": ["ground", "b"], "points": POINTS, "angle": 0.0},
    "Distance": {"bodies": ["ground", "b"], "points": POINTS, "length": 1.0},
    "Angle": {"bodies": ["ground", "b"], "angle": 0.0},
    "Gear": {"bodies": ["ground", "b"], "radii": [0.1, 0.2], "internal": True, "carrier": "c"},
    "Rack": {"bodies": ["ground", "b"], "radius": 0.1, "axis": 0.2},
    "Screw": {"bodies": ["ground", "b"], "points": POINTS, "axis": 0.1, "turning": ["ground", "c"], "lead": 0.1},
    "Coupling": {
        "bodies": ["ground", "b"],
        "to": ["ground", "c"],
        "coefficients": [0.1, 2.0],
        "axis": 0.1,
        "to_axis": 0.2,
        "points": POINTS,
        "to_points": POINTS,
    },
    "KnifeEdge": {"bodies": ["ground", "b"], "point": [0.0, 0.1], "axis": 0.1},
    "Wheel": {"bodies": ["ground", "b"], "point": [0.0, 0.1], "axis": 0.1, "turning": ["b", "c"], "radius": 0.2},
    "Cam": {"bodies": ["ground", "b"], "points": POINTS, "profile": {"angle": [0.0, 2.0, 4.0], "radius": [1.0, 1.1, 1.2]}},
    "Spring": {"bodies": ["ground", "b"], "points": POINTS, "stiffness": 1.0, "length": 0.1, "damping": 0.1},
    "TorsionSpring": {"bodies": ["ground", "b"], "stiffness": 1.0, "damping": 0.1, "angle": 0.1},
    "Force": {"body": "b", "vector": [1.0, 0.0], "point": [0.0, 0.0], "frame": "body"},
    "Torque": {"bodies": ["ground", "b"], "value": 1.0},
    "Friction": {"joint": "pin", "torque": 1.0, "velocity": 0.1},
    "Driver": {"bodies": ["ground", "b"], "coordinate": "angle", "motion": udk.Polynomial([0.0, 1.0]), "points": POINTS},
    "Polynomial": {"coefficients": [0.0, 1.0]},
    "Sine": {"amplitude": 1.0, "frequency": 1.0, "phase": 0.0, "offset": 0.0},
    "Spline": {"times": [0.0, 1.0, 2.0], "values": [0.0, 0.1, 0.2]},
    "Profile": {"angle": [0.0, 2.0, 4.0], "radius": [1.0, 1.1, 1.2]},
}
EVENTS: dict[str, dict[str, Any]] = {
    "Contact": {
        "body": "b",
        "point": [0.0, 0.0],
        "through": [0.0, -9.0],
        "normal": [0.0, 1.0],
        "restitution": 0.5,
        "on": "ground",
    },
    "JointLimit": {"joint": "pin", "lower": -9.0, "upper": 9.0, "restitution": 0.5, "at_rest": "hold"},
    "Lock": {"joint": "pin"},
    "Release": {"name": "pin"},
    "Impact": {"restitution": 0.5, "at_rest": "hold"},
}
# Functions that take long with valid arguments, or that write or show: called less often, or not at all.
SELDOM = {
    "identify",
    "check_gradients",
    "design_experiment",
    "sweep",
    "diagnose",
    "equilibria",
    "branches",
    "workspace",
    "travel",
}
NEVER = {"load", "loads", "save", "animate", "animate_modes", "length", "envelope"}


@functools.cache
def scene() -> udk.Mechanism:
    """Return the scene that functions get: a slider-crank of two bodies, one freedom."""
    c, d = np.cos(0.6), np.sin(0.6)
    bodies = {"b": udk.Body(1.0, 0.1, [0.5 * c, 0.5 * d], 0.6), "c": udk.Body(1.0, 0.1, [1.5 * c, 0.5 * d], -0.6)}
    joints = {"pin": udk.Revolute(["ground", "b"], [[0, 0], [-0.5, 0]]), "elbow": udk.Revolute(["b", "c"], [[0.5, 0], [-0.5, 0]])}
    return udk.Mechanism(bodies, joints | {"guide": udk.Slot(["ground", "c"], [[0, 0], [0.5, 0]], 0.0)})


@functools.cache
def chain() -> udk.Mechanism:
    """Return a scene with the bodies of `scene` and two degrees of freedom: a double pendulum."""
    joints = {name: joint for name, joint in scene().joints.items() if name != "guide"}
    return udk.Mechanism(scene().bodies, joints)


@functools.cache
def other() -> udk.Mechanism:
    """Return a scene that is another one."""
    return udk.library.simple_pendulum()


@functools.cache
def fitting() -> dict[str, Any]:
    """Return arguments that fit, by their names."""
    q, ts = np.asarray(scene().q0), np.linspace(0.0, 0.1, 3)
    along = SimpleNamespace(ts=ts, q=np.stack([q] * 3), v=np.zeros((3, 2, 3)), a=np.zeros((3, 2, 3)))
    return {
        "mechanism": scene(),
        "ts": ts,
        "t": 0.0,
        "q": q,
        "v": 0 * q,
        "solution": along,
        "motion": along,
        "driver": "body.b.angle",
        "values": [0.6, 0.7],
        "value": 0.7,
        "axes": {"rtol": [1e-6]},
        "shapes": np.ones((1, 2, 3)),
        "turning": udk.kinematics(scene(), "body.b.angle", [0.6, 0.7]),
        "body": "b",
        "bodies": "b",
        "drivers": {"body.b.angle": [0.0], "body.c.angle": [0.0]},
        "length": 1.0,
        "angle": 0.1,
        "joint": "elbow",
        "output": "body.c.angle",
        "parameters": "body.b.mass",
        "data": {"time": ts, "body.b.angle": 0 * ts},
        "channels": ["body.b.angle"],
        "noise": 0.1,
        "candidates": [{"gravity": [0.0, -1.0]}],
        "state": udk.State(q, 0 * q),
        "analysis": udk.analyse(scene()),
    }


def bad_values() -> list[Any]:
    """Return what nobody means, and some that may be meant."""
    q = np.zeros((2, 3))
    return [
        None,
        "text",
        "",
        b"bytes",
        np.nan,
        np.inf,
        -np.inf,
        -1.0,
        0.0,
        0,
        1e300,
        2.5,
        3,
        2**70,
        True,
        False,
        1j,
        [],
        [[]],
        {},
        (),
        set(),
        object(),
        lambda *_: 0.0,
        int,
        udk.SVD,
        udk.Projection,
        udk.State,
        udk.Augmented,
        udk.Stop,
        udk.SVD(),
        udk.Projection(),
        udk.Augmented(),
        udk.Baumgarte(),
        other(),
        udk.State(q, q),
        udk.State(q[:1], q[:1]),
        udk.State(np.zeros(3), np.zeros(3)),
        (q, q),
        q,
        q[:1],
        q.ravel(),
        q[None],
        np.zeros((2, 3), int),
        np.zeros((2, 3), complex),
        np.full((2, 3), np.nan),
        np.array(["a", "b"]),
        np.array([None, 1.0]),
        np.array(1.0),
        np.array([1e-8, 1e-8]),
        np.zeros(0),
        [1.0, 0.5],
        [0.0, 0.0],
        [0.0, np.nan],
        [0.0, "x"],
        [0.0, None],
        ["b"],
        ["nobody"],
        {"nobody": 1.0},
        {"b": np.nan},
        {"b": {}},
        {"b": []},
        {"b": 1j},
        {3: 1.0},
        udk.Log(),
        udk.Contact("nobody"),
        [udk.Contact("b", [0.0])],
        udk.analyse(other()),
        SimpleNamespace(ts=[0.0], q=np.zeros((1, 1, 3)), v=np.zeros((1, 1, 3))),
        SimpleNamespace(),
        np.datetime64("2020-01-01"),
        range(3),
        "body.b.mass",
        "body.nobody.angle",
        "joint.pin",
        "\x00",
        "b" * 500,
        np.ones(1000),
        jnp.ones((2, 3)),
        np.float32(0.5),
        np.int64(-1),
    ]


@functools.cache
def targets() -> list[tuple[str, Callable[..., Any], dict[str, Any]]]:
    """Return what is called: its name, the function, and arguments that fit."""
    found: list[tuple[str, Callable[..., Any], dict[str, Any]]] = []
    for name in udk.__all__:
        function = getattr(udk, name)
        if name in NEVER or not inspect.isfunction(function):
            continue
        needed = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty and p.kind != p.VAR_KEYWORD]
        if all(fitting().get(p.name) is not None for p in needed):
            given = {p.name: fitting()[p.name] for p in needed}
            if name == "mechanical_advantage":
                given["motion"] = fitting()["turning"]
            if name == "workspace":
                given["mechanism"] = chain()
            if name == "inverse_dynamics":
                given |= {"motion": fitting()["motion"], "drivers": ["body.b.angle"]}
            if name in ("gaps", "layers"):
                given |= {"run": fitting()["solution"], "shapes": {"b": 0.1, "c": 0.1, "ground": np.ones((1, 2))}}
            if name == "gaps":
                given["pairs"] = [("ground", "c")]
            found += [(name, function, given)] * (1 if name in SELDOM else 12)
    found += [("simulate", udk.simulate, {"mechanism": scene(), "ts": fitting()["ts"]})] * 60
    found += [(f"library.{name}", getattr(udk.library, name), {}) for name in udk.library.__all__] * 4
    for name, function in vars(evaluate).items():
        if not hasattr(function, "__wrapped__") or not function.__module__.startswith("udkjax.equations.terms."):
            continue
        needed = list(inspect.signature(function).parameters)
        found += [(f"equations.{name}", function, {p: fitting()[p] for p in needed})] * 4
    found += [(name, functools.partial(_element, name), given) for name, given in ELEMENTS.items()] * 8
    found += [(name, functools.partial(_event, name), given) for name, given in EVENTS.items()] * 4
    found += [
        ("State", _state, {"q": np.zeros((2, 3)), "v": np.zeros((2, 3))}),
        ("Baumgarte", _gains, {"alpha": 1.0, "beta": 1.0}),
    ] * 8
    methods = ("SVD", "Varga", "Greville", "Householder", "GramSchmidt", "Elimination", "Auto")
    found += [(name, functools.partial(_method, name), {"rank_tol": 1e-4}) for name in methods] * 4
    found += [("with_parameters", lambda values: scene().with_parameters(values), {"values": {"body.b.mass": 1.0}})] * 20
    found += [("with_parameters value", lambda value: scene().with_parameters({"body.b.mass": value}), {"value": 1.0})] * 10
    return found


def _element(name: str, **given: Any) -> udk.Mechanism:
    bodies = {"b": udk.Body(1.0, 0.1, [0.5, 0.0]), "c": udk.Body(1.0, 0.1, [1.5, 0.0])}
    joints: dict[str, Any] = {"pin": udk.Revolute(["ground", "b"], [[0, 0], [-0.5, 0]])}
    made = getattr(udk, name)(**given)
    drivers, forces = {}, {}
    if isinstance(made, udk.Body):
        bodies["d"] = made
    elif isinstance(made, udk.Driver | udk.Motion):
        drivers["d"] = made if isinstance(made, udk.Driver) else udk.Driver(["ground", "b"], "angle", made)
    elif isinstance(made, udk.Joint | udk.Profile):
        joints["d"] = made if isinstance(made, udk.Joint) else udk.Cam(["ground", "b"], POINTS, made)
    else:
        forces["d"] = made
    return udk.Mechanism(bodies, joints, drivers, forces)


def _event(name: str, **given: Any) -> Any:
    made = getattr(udk, name)(**given)
    event = made if hasattr(made, "expand") else udk.Event(lambda t, at: at["b"].y + 3.0, made, -1 if name == "Impact" else 0)
    return udk.simulate(scene(), [0.0, 0.01], events=event, throw=False)


def _state(**given: Any) -> Any:
    return udk.simulate(scene(), [0.0, 0.01], udk.State(**given), throw=False)


def _gains(**given: Any) -> Any:
    return udk.simulate(scene(), [0.0, 0.01], stabilization=udk.Baumgarte(**given), throw=False, max_steps=50)


def _method(name: str, **given: Any) -> Any:
    return getattr(udk, name)(**given).solve(np.eye(2, 3), np.ones(2))


def draw(rng: np.random.Generator) -> Case:
    """Draw a call with one wrong argument, or two."""
    name, function, given = targets()[rng.integers(len(targets()))]
    known = parameters_of(function, given)
    places = rng.choice(known, 1 if rng.random() < 0.8 or len(known) == 1 else 2, replace=False)
    pool = bad_values()
    wrong = {str(place): pool[rng.integers(len(pool))] for place in places}
    traced = [p for p, value in wrong.items() if is_traceable(value)]
    return case_of(name, function, given, wrong, traced[0] if traced and rng.random() < 0.3 else "")


def parameters_of(function: Callable[..., Any], given: dict[str, Any]) -> list[str]:
    """Return the names of the arguments of a target that can be wrong; a wrong `progress`, for example, fails nothing."""
    if isinstance(function, functools.partial) or function in (_state, _gains):
        return list(given)
    known = inspect.signature(function).parameters.values()
    names = [p.name for p in known if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    return [p for p in names if p not in ("progress", "adjoint", "throw")] or names


def is_traceable(value: Any) -> bool:
    """Return True for an array of numbers, which may also be an argument of a function that JAX traces."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "fic"


def case_of(name: str, function: Callable[..., Any], given: dict[str, Any], wrong: dict[str, Any], traced: str = "") -> Case:
    """Return the call of a target with wrong arguments, one of which may be traced."""
    given = given | wrong
    if name == "simulate":
        given.setdefault("max_steps", 100)
    about = f"{name}({', '.join(wrong)})"
    # An argument that is valid alone but does not fit the others may be reported under any name.
    mismatched = any(isinstance(value, udk.Mechanism | udk.Analysis | udk.State | SimpleNamespace) for value in wrong.values())
    mismatched |= name.startswith("library.")  # numbers with which links do not meet: the message names lengths, bodies or pins
    names = [] if mismatched else _names(wrong)
    if traced:
        return Case(f"{about} traced", functools.partial(_traced, function, given, traced), names)
    return Case(about, functools.partial(_call, function, given), names)


def _names(wrong: dict[str, Any]) -> list[str]:
    """Return how a message may call what is wrong: the arguments, texts, keys and items of their values, and what they name."""
    called = {"values": ["parameter"], "bodies": ["body"], "value": ["mass"], "driver": ["drivers"]}
    parts = [part for value in wrong.values() if isinstance(value, dict | list) for part in value]
    texts = [quote(x).strip('"') for x in (*wrong.values(), *parts) if isinstance(x, str) and x.strip()]
    return [*wrong, *texts, *(other for p in wrong for other in called.get(p, ()))]


def _call(function: Callable[..., Any], given: dict[str, Any]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return jax.block_until_ready(function(**given))


def _traced(function: Callable[..., Any], given: dict[str, Any], name: str) -> Any:
    return eqx.filter_eval_shape(lambda x: _call_traced(function, given | {name: x}), jnp.asarray(given[name]))


def _call_traced(function: Callable[..., Any], given: dict[str, Any]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = function(**given)
    return [x for x in jax.tree.leaves(found) if eqx.is_array(x)]
