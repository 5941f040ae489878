"""The rows of the table of functions by models: each calls one public function, and compares it with another way.

A row returns what it was compared with, and raises `WrongError` where the two differ. Where udkjax refuses the model, its error
passes through.
"""

import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.crossing_models import Model

TS = np.linspace(0.0, 0.2, 5)
EXACT: Any = {"rtol": 1e-10, "atol": 1e-10}


class WrongError(Exception):
    """Two ways to one number differ."""


class Case:
    """A model with a run of it, and a twin: the same model, read from its own text or made of its elements."""

    def __init__(self, name: str, model: Model):
        self.name, self.model, self.events = name, model.build(), model.events()

    @cached_property
    def state(self) -> udk.State:
        return udk.assemble(self.model)

    @cached_property
    def run(self) -> udk.Solution:
        return udk.simulate(self.model, TS, self.state, events=self.events, throw=False, **EXACT)

    @cached_property
    def alone(self) -> udk.Solution:
        """A run without events."""
        return self.run if self.events is None else udk.simulate(self.model, TS, self.state, **EXACT)

    @cached_property
    def reached(self) -> int:
        """The number of outputs that the run has reached."""
        return int(np.isfinite(np.asarray(self.run.q)).reshape(len(TS), -1).all(1).sum())

    @cached_property
    def is_system(self) -> bool:
        return isinstance(self.model, udk.ConstrainedSystem)

    @cached_property
    def twin(self) -> tuple[Any, str]:
        m = self.model
        if self.is_system:
            return m.with_parameters(m.parameters()), "a copy"
        if m.drawing is not None:
            return udk.Mechanism(m.bodies, m.joints, m.drivers, m.forces, m.gravity, m.name), "its elements alone"
        try:
            return udk.loads(udk.dumps(m)), "its saved text"
        except udk.SceneError:  # an element of one's own
            return udk.Mechanism(m.bodies, m.joints, m.drivers, m.forces, m.gravity, m.name), "its elements alone"

    @cached_property
    def number(self) -> str:
        """A number of the model: a mass, or what determines one."""
        return next(k for k in self.model.parameters() if k.rpartition(".")[2] in ("mass", "density", "weight", "inertia"))

    @property
    def driver(self) -> Any:
        """A driver, or a coordinate that can drive the model; a system has neither."""
        if self.is_system:
            return "q[0]"
        if self.model.driver_names:
            return self.model.driver_names[0]
        return f"body.{self.model.body_names[0]}.angle"

    def values(self, count: int = 4) -> np.ndarray:
        """Values of the driver near the start."""
        if self.is_system:
            return float(self.state.q[0]) + np.linspace(0.0, 0.05, count)
        if self.model.driver_names:
            motion = self.model.drivers[self.model.driver_names[0]].motion
            return np.array([float(motion(t)) for t in np.linspace(0.0, 0.05, count)])
        return float(self.state.q[0, 2]) + np.linspace(0.0, 0.05, count)


def arrays(tree: Any) -> list[np.ndarray]:
    return [np.asarray(x, float) for x in jax.tree.leaves(tree) if np.asarray(x).dtype.kind in "fiub"]


def agree(found: Any, wanted: Any, by: str, tol: float = 1e-7) -> str:
    """Return `by` if two trees of numbers agree, relative to the largest of each array."""
    found, wanted = arrays(found), arrays(wanted)
    if len(found) != len(wanted):
        raise WrongError(f"{len(found)} arrays, by {by} {len(wanted)}")
    for a, b in zip(found, wanted, strict=True):
        if a.shape != b.shape or (np.isfinite(a) != np.isfinite(b)).any():
            raise WrongError(f"shape {a.shape} or numbers that are not finite, by {by} {b.shape}")
        finite = np.isfinite(a)
        error, size = np.abs(a[finite] - b[finite]).max(initial=0.0), 1e-3 + np.abs(b)[finite].max(initial=0.0)
        if error > tol * size:
            raise WrongError(f"differs by {error:.3g} of {size:.3g} from {by}")
    return by


def by_twin(function: Callable[[Case, Any], Any], tol: float = 1e-7) -> Callable[[Case], str]:
    """Return the row of a function of a model, compared with the same of its twin."""

    def row(case: Case) -> str:
        twin, by = case.twin
        return agree(function(case, case.model), function(case, twin), by, tol)

    return row


def by_jit(function: Callable[[Case, Any], Any]) -> Callable[[Case], str]:
    """Return the row of a function of a model within `jit`, compared with an eager call."""
    return lambda case: agree(jax.jit(lambda m: function(case, m))(case.model), function(case, case.model), "an eager call")


def text_by_twin(function: Callable[[Case, Any], Any]) -> Callable[[Case], str]:
    def row(case: Case) -> str:
        text = str(function(case, case.model))
        if len(text) < 20:
            raise WrongError(f"says {text!r}")
        return "printed"

    return row


# --- motion


def simulate(case: Case) -> str:
    twin, by = case.twin
    agree(udk.simulate(twin, TS, case.state, events=case.events, throw=False, **EXACT).q, case.run.q, by, 1e-6)
    return by


def simulate_engine(case: Case) -> str:
    other = udk.simulate(case.model, TS, case.state, events=case.events, throw=False, engine="jax", **EXACT)
    return agree(other.q, case.run.q, "diffrax", 1e-5)


def simulate_jit(case: Case) -> str:
    run = jax.jit(lambda m, s: udk.simulate(m, TS, s, events=case.events, throw=False, **EXACT).q)
    return agree(run(case.model, case.state), case.run.q, "jit", 1e-7)


def simulate_vmap(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])

    def q(x: Any) -> Any:
        changed = case.model.with_parameters({name: x})
        return udk.simulate(changed, TS, case.state, events=case.events, throw=False, **EXACT).q

    several = jax.vmap(q)(jnp.stack([x0, 1.01 * x0, 1.02 * x0]))
    agree(several[0], case.run.q, "vmap", 1e-6)
    return agree(several[2], q(1.02 * x0), "vmap", 1e-6)


def simulate_derivative(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])

    def last(x: Any) -> Any:
        run = udk.simulate(case.model.with_parameters({name: x * x0}), TS, case.state, events=case.events, throw=False, **EXACT)
        return jnp.sum(jnp.sin(run.q[case.reached - 1]))

    h = 1e-4
    wanted = (last(1.0 + h) - last(1.0 - h)) / (2 * h)
    agree(jax.jvp(last, (1.0,), (1.0,))[1], wanted, "differences", 1e-4)
    return agree(jax.grad(last)(1.0), wanted, "differences, forward and reverse", 1e-4)


def step(case: Case) -> str:
    end = udk.step(case.model, case.state, None, TS[1], **EXACT)
    agree(end.q, case.alone.q[1], "simulate", 1e-7)
    if case.is_system:
        return "simulate"
    inputs = dict(case.model.independent_parameters())
    inputs = {k: v for k, v in inputs.items() if not k.endswith(".values")}
    again = udk.step(case.model, case.state, inputs, TS[1], **EXACT)
    return agree(again.q, case.alone.q[1], f"simulate, with {len(inputs)} inputs", 1e-7)


def assemble(case: Case) -> str:
    one = np.asarray(case.state.q)[None], np.asarray(case.state.v)[None]
    psi = udk.violation(case.model, case.alone)
    if np.abs(np.asarray(psi)[0]).max(initial=0.0) > 1e-9 * (1 + np.abs(one[0]).max()):
        raise WrongError("the assembled state violates constraints")
    return agree(udk.assemble(case.twin[0]).q, case.state.q, f"Psi = 0, {case.twin[1]}")


def accelerations(case: Case) -> str:
    a = udk.accelerations(case.model, 0.0, case.state.q, case.state.v)
    h = 1e-4
    v = udk.simulate(case.model, [0.0, h, 2 * h, 3 * h], case.state, rtol=1e-12, atol=1e-12).v
    by_v = (-11 * v[0] + 18 * v[1] - 9 * v[2] + 2 * v[3]) / (6 * h)
    twin, by = case.twin
    agree(udk.accelerations(twin, 0.0, case.state.q, case.state.v), a, by, 1e-8)
    return agree(by_v, np.reshape(a, np.shape(by_v)), f"differences of v, {by}", 1e-3)


def energy(case: Case) -> str:
    found = udk.energy(case.model, case.run)
    agree(udk.energy(case.twin[0], case.run), found, case.twin[1])
    if case.is_system:
        return case.twin[1]
    mass = np.array([[float(b.mass)] * 2 + [float(b.inertia)] for b in case.model.bodies.values()])
    return agree(found.kinetic, 0.5 * np.sum(mass * np.asarray(case.run.v) ** 2, (1, 2)), f"v M v / 2, {case.twin[1]}")


def violation(case: Case) -> str:
    psi = np.asarray(udk.violation(case.model, case.alone))
    if np.abs(psi).max(initial=0.0) > 1e-7:
        raise WrongError(f"Psi {np.abs(psi).max():.2g}")
    return "Psi = 0"


def reactions(case: Case) -> str:
    found = udk.reactions(case.model, case.alone)
    by = agree(udk.reactions(case.twin[0], case.alone), found, case.twin[1])
    if case.is_system or case.model.forces or case.model.driver_names:
        return by
    bodies, g = case.model.body_names, np.asarray(case.model.gravity)
    total = np.zeros(np.shape(case.alone.q))
    for loads in found.values():
        for body, x in loads.items():
            if body in bodies:
                total[:, bodies.index(body)] += np.asarray(x)
    for k, b in enumerate(case.model.bodies.values()):
        total[:, k, :2] += float(b.mass) * g
        total[:, k] /= [float(b.mass), float(b.mass), float(b.inertia)]
    a = np.array([udk.accelerations(case.model, t, q, v) for t, q, v in zip(TS, case.alone.q, case.alone.v, strict=True)])
    return agree(total, a.reshape(total.shape), f"Newton's law, {by}", 1e-6)


def power(case: Case) -> str:
    relative = float(udk.power_balance(case.model, case.alone).relative)
    if relative > 1e-6:
        raise WrongError(f"power is not balanced: {relative:.2g}")
    return "balance of power"


def inverse(case: Case) -> str:
    needed = udk.inverse_dynamics(case.model, TS)
    if not case.model.driver_names:
        return agree(udk.inverse_dynamics(case.twin[0], TS).efforts, needed.efforts, case.twin[1])
    return agree(needed.efforts, udk.efforts(case.model, case.alone), "efforts of the run", 1e-4)


def equilibrium(case: Case) -> str:
    found = udk.equilibrium(case.model)
    rest = udk.accelerations(case.model, 0.0, found.state.q, 0.0 * found.state.v)
    scale = 9.81 + np.abs(np.asarray(udk.accelerations(case.model, 0.0, case.state.q, 0.0 * case.state.v))).max()
    if np.abs(np.asarray(rest)).max() > 1e-5 * scale:
        raise WrongError(f"accelerates by {np.abs(np.asarray(rest)).max():.2g}")
    return "a = 0"


def kinematics(case: Case) -> str:
    values = case.values(5)
    found = udk.kinematics(case.model, case.driver, values)
    twin, by = case.twin
    return agree(udk.kinematics(twin, case.driver, values).q, found.q, by)


def on_kinematics(function: Callable[[Case, Any, Any], Any]) -> Callable[[Case], str]:
    return by_twin(lambda case, m: function(case, m, udk.kinematics(m, case.driver, case.values(), rate=1.0)))


# --- studies


def channel(case: Case) -> dict[str, Any]:
    if case.is_system:
        return {"q[0]": np.asarray(case.alone.q[:, 0])}
    return {f"body.{case.model.body_names[0]}.angle": np.asarray(case.alone.q[:, 0, 2])}


def identify(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])
    found = udk.identify(case.model.with_parameters({name: 1.05 * x0}), {"time": TS, **channel(case)}, [name], progress=False)
    value, spread = np.asarray(found.values, float)[0], np.ptp(next(iter(channel(case).values())))
    again = udk.simulate(case.model.with_parameters({name: value}), TS, case.state, **EXACT)
    first = np.asarray(again.q).reshape(len(TS), -1)[:, 0 if case.is_system else 2]
    if np.abs(first - next(iter(channel(case).values()))).max() > 1e-5 * (spread + 1e-3):
        raise WrongError(f"{name} = {value:.6g}, not {x0:.6g}, and the motion is another")
    return "the motion that made the record"


def check_gradients(case: Case) -> str:
    found = udk.check_gradients(case.model, {"time": TS, **channel(case)}, [case.number])
    return "differences" if getattr(found, "success", True) else _raise(f"{found}"[:200])


def design_experiment(case: Case) -> str:
    name = case.number
    candidate = udk.Candidate(name="rest"), udk.Candidate({name: 1.1 * np.asarray(case.model.parameters()[name])}, name="heavy")
    other = next(k for k in case.model.parameters() if k != name)
    found = udk.design_experiment(case.model, candidate[:1], [other], list(channel(case)), noise=1e-3, ts=TS)
    return "runs" if len(str(found)) > 20 else _raise(str(found))


def sweep(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])
    data = udk.sweep(case.model, {name: [x0, 1.02 * x0]}, TS, ["final"], rtol=1e-10, atol=1e-10, progress=False)
    ends = [udk.simulate(case.model.with_parameters({name: x}), TS, **EXACT).q[-1] for x in (x0, 1.02 * x0)]
    return agree(data["q_end"].values, np.stack(ends), "simulate", 1e-6)


def _raise(text: str) -> str:
    raise WrongError(text)


# --- files and pictures


def dumps(case: Case) -> str:
    again = udk.loads(udk.dumps(case.model))
    agree(udk.simulate(again, TS, case.state, **EXACT).q, case.alone.q, "the motion")
    return agree(list(again.parameters().values()), list(case.model.parameters().values()), "numbers and motion", 1e-12)


def save(case: Case) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        udk.save(case.model, file)
        return agree(udk.simulate(udk.load(file), TS, case.state, **EXACT).q, case.alone.q, "the motion")


def mjcf(case: Case) -> str:
    again = udk.read_mjcf(udk.mjcf_text(case.model))
    energies = [udk.energy(m, udk.simulate(m, TS, **EXACT)).kinetic for m in (again, case.model)]
    return agree(energies[0], energies[1], "the kinetic energy", 1e-5)


def animate(live: bool) -> Callable[[Case], str]:
    def row(case: Case) -> str:
        more: Any = {"live": [next(iter(case.model.parameters()))]} if live else {}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "page.html"
            udk.animate(case.model, None if live else case.run, **more).save(file)
            if file.stat().st_size < 10_000:
                raise WrongError("an empty page")
        return "a page"

    return row


def animate_modes(case: Case) -> str:
    shown = udk.animate_modes(case.model, case.state.q, np.ones((1, *np.shape(case.state.q))))
    return "a page" if len(shown.html()) > 10_000 else _raise("an empty page")


def modes(case: Case, m: Any) -> Any:
    found = udk.modes(m)
    return [x for x in (getattr(found, "frequencies", None), getattr(found, "damping", None)) if x is not None]


def pin(m: Any) -> str:
    joints = getattr(m, "joints", {})
    return next((n for n, j in joints.items() if isinstance(j, udk.Revolute)), next(iter(joints), "none"))


def cam(m: Any) -> str:
    return next((n for n, j in getattr(m, "joints", {}).items() if type(j) is udk.Cam), "no cam")


def first_body(m: Any) -> str:
    return getattr(m, "body_names", ("none",))[0]


def design(case: Case) -> str:
    free = [k for k in case.model.parameters() if k.startswith("pin.")][:2]
    point = next((k[4:] for k in free), "P")
    goal = udk.PathGoal(point, [[0.0, 0.05], [0.01, 0.06], [0.02, 0.05]])
    found = udk.design(case.model, goal, free=free or None, starts=1)
    return f"{len(found)} designs" if hasattr(found, "__len__") else "runs"


def design_all(case: Case) -> str:
    pin = next((k[4:] for k in case.model.parameters() if k.startswith("pin.")), None)
    goal = udk.PoseGoal(first_body(case.model), [[0.0, 0.0, 0.1 * k] for k in range(5)], pin=pin)
    udk.design_all(case.model, goal)
    return "runs"


FUNCTIONS: dict[str, dict[str, Callable[[Case], str]]] = {
    "simulate": {
        "": simulate,
        "engine": simulate_engine,
        "jit": simulate_jit,
        "vmap": simulate_vmap,
        "derivative": simulate_derivative,
    },
    "step": {"": step},
    "assemble": {"": assemble},
    "accelerations": {
        "": accelerations,
        "jit": by_jit(lambda case, m: udk.accelerations(m, 0.0, case.state.q, case.state.v)),
    },
    "analyse": {"": by_twin(lambda case, m: [*(udk.analyse(m).redundant_rows or ()), udk.analyse(m).length])},
    "singular_values": {"": by_twin(lambda case, m: udk.singular_values(m, 0.0, case.state.q))},
    "energy": {
        "": energy,
        "jit": by_jit(lambda case, m: udk.energy(m, case.run)),
    },
    "violation": {
        "": violation,
        "jit": by_jit(lambda case, m: udk.violation(m, case.run)),
    },
    "reactions": {
        "": reactions,
        "jit": by_jit(lambda case, m: udk.reactions(m, case.alone)),
    },
    "efforts": {"": by_twin(lambda case, m: udk.efforts(m, case.alone))},
    "friction_loads": {"": by_twin(lambda case, m: udk.friction_loads(m, case.alone))},
    "unique_reactions": {"": by_twin(lambda case, m: udk.unique_reactions(m, case.alone))},
    "uniqueness": {"": by_twin(lambda case, m: jax.tree.leaves(udk.uniqueness(m, 0.0, case.state.q)))},
    "power_balance": {"": power},
    "inverse_dynamics": {"": inverse},
    "feed_forward": {"": by_twin(lambda case, m: udk.simulate(udk.feed_forward(m, udk.inverse_dynamics(m, TS)), TS).q, 1e-5)},
    "equilibrium": {"": equilibrium},
    "equilibria": {"": by_twin(lambda case, m: len(udk.equilibria(m, starts=2)))},
    "holding_efforts": {"": by_twin(lambda case, m: jax.tree.leaves(udk.holding_efforts(m, case.driver, case.values())))},
    "modes": {"": by_twin(modes)},
    "kinematics": {"": kinematics},
    "branches": {"": by_twin(lambda case, m: len(udk.branches(m, case.driver, case.values()[0], starts=40)))},
    "characteristics": {"": text_by_twin(lambda case, m: udk.characteristics(m))},
    "instant_centres": {"": by_twin(lambda case, m: jax.tree.leaves(dict(udk.instant_centres(m, case.state.q, case.state.v))))},
    "travel": {"": by_twin(lambda case, m: jax.tree.leaves(udk.travel(m, case.driver)), 1e-5)},
    "motion_ranges": {"": text_by_twin(lambda case, m: udk.motion_ranges(m, udk.kinematics(m, case.driver, case.values())))},
    "motion_at": {"": by_twin(lambda case, m: len(str(udk.motion_at(m, case.values()[0])).split()))},
    "pin_motion": {"": on_kinematics(lambda case, m, k: len(str(udk.pin_motion(m, k))))},
    "pressure_angle": {
        "": on_kinematics(
            lambda case, m, k: udk.pressure_angle(m, k, cam(m))
        )
    },
    "coupler_curve": {"": by_twin(lambda case, m: udk.coupler_curve(m, case.driver, case.values(), first_body(m), [0.01, 0.02]))},
    "mechanical_advantage": {
        "": on_kinematics(lambda case, m, k: udk.mechanical_advantage(m, k, f"body.{first_body(m)}.angle"))
    },
    "transmission_angle": {"": on_kinematics(lambda case, m, k: udk.transmission_angle(m, k, pin(m)))},
    "workspace": {
        "": by_twin(lambda case, m: jax.tree.leaves(udk.workspace(m, {case.driver: case.values()}, first_body(m)))),
    },
    "check": {"": text_by_twin(lambda case, m: udk.check(m))},
    "path": {"": lambda case: agree(udk.path(case.model, case.run, f"body.{first_body(case.model)}"), case.run.q[:, 0, :2], "q")},
    "pin_reactions": {"": by_twin(lambda case, m: udk.pin_reactions(m, case.alone))},
    "reaction_peaks": {"": text_by_twin(lambda case, m: udk.reaction_peaks(m, case.alone))},
    "envelope": {"": text_by_twin(lambda case, m: udk.envelope([udk.reaction_peaks(m, case.alone)] * 2))},
    "diagnose": {"": text_by_twin(lambda case, m: udk.diagnose(m))},
    "explain": {"": text_by_twin(lambda case, m: udk.explain(m))},
    "identify": {"": identify},
    "check_gradients": {"": check_gradients},
    "design_experiment": {"": design_experiment},
    "sweep": {"": sweep},
    "design": {"": design},
    "design_all": {"": design_all},
    "dumps": {"": dumps},
    "loads": {"": dumps},
    "save": {"": save},
    "load": {"": save},
    "mjcf_text": {"": mjcf},
    "read_mjcf": {"": mjcf},
    "animate": {"": animate(False), "live": animate(True)},
    "animate_modes": {"": animate_modes},
    "with_length": {"": by_twin(lambda case, m: udk.with_length(m, first_body(m), 0.3).q0)},
    "with_angle": {"": by_twin(lambda case, m: udk.with_angle(m, first_body(m), 0.2).q0)},
}  # fmt: skip
# Public functions that take no model: they make parts of drawings, or choices of other functions, which rows above use.
WITHOUT_MODEL = {"circles": "drawn", "polar": "drawn", "on_line": "drawings", "on_rail": "drawings", "stacked": "drawings"}
WITHOUT_MODEL |= {"length": "Parameter"}
