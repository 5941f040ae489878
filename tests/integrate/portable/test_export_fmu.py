"""FMUs by FMI 3.0: descriptions, co-simulation in the bits of `step`, model exchange on the constraints, states, wrong calls."""

import ctypes
import platform
import shutil
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.command_line import udkjax
from tests.integrate.portable.test_export_c import DRAWINGS, fused, scene
from udkjax.integrate.portable.fmi.compilers import LIBRARY_SUFFIXES, this_platform
from udkjax.integrate.portable.fmi.description import base_unit
from udkjax.integrate.portable.fmi.variables import MeasuredState
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import channel_of

pytestmark = pytest.mark.skipif(shutil.which("cc") is None or platform.system() != "Linux", reason="no C compiler")
OK, DISCARD, ERROR = 0, 2, 3
LOG = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
DRIVE = "force.motor.value"
OUTPUTS = ["body.rod(0.2, 0.1).vx", "joint.pin.angle", "body.rod(0.5, 0.0).y"]


def options(level="-O0"):
    return [level, *filter(None, [fused()])]


def pendulum() -> udk.Mechanism:
    one, motor = udk.library.compound_pendulum(), udk.Torque(["ground", "rod"], 0.0)
    return udk.Mechanism(one.bodies, one.joints, {}, {"motor": motor}, one.gravity, "pendulum")


class Instance:
    """An instance of an FMU, as an importer has it: variables by name, and messages of the log."""

    def __init__(self, file: Path, folder: Path, kind: str):
        with zipfile.ZipFile(file) as archive:
            archive.extractall(folder)
        self.xml = ET.parse(folder / "modelDescription.xml").getroot()
        self.references = {x.get("name"): int(x.get("valueReference", "")) for x in self.xml.iter("Float64")}
        identifier = next(self.xml.iter("CoSimulation")).get("modelIdentifier")
        suffix = LIBRARY_SUFFIXES[this_platform().rpartition("-")[2]]
        self.library = ctypes.CDLL(str(folder / "binaries" / this_platform() / f"{identifier}{suffix}"))
        self.messages: list[str] = []
        self._log = LOG(lambda environment, status, category, text: self.messages.append(text.decode()))
        self.kind, self.token = kind, self.xml.get("instantiationToken", "").encode()
        self.pointer = self.instantiate(self.token)

    def instantiate(self, token: bytes):
        make = getattr(self.library, f"fmi3Instantiate{self.kind}")
        make.restype = ctypes.c_void_p
        further = [False, False, None, ctypes.c_size_t(0)] if self.kind == "CoSimulation" else []
        last = [None] if self.kind == "CoSimulation" else []
        return make(b"one", token, None, False, False, *further, None, self._log, *last)

    def call(self, name: str, *arguments) -> int:
        return getattr(self.library, f"fmi3{name}")(ctypes.c_void_p(self.pointer), *arguments)

    def begin(self, start: float = 0.0, stop: float | None = None):
        times = ctypes.c_double(start), stop is not None, ctypes.c_double(stop or 0.0)
        assert self.call("EnterInitializationMode", False, ctypes.c_double(0.0), *times) == OK
        return self.call("ExitInitializationMode")

    def _access(self, name: str, references, values) -> int:
        count, found = ctypes.c_size_t(len(references)), (ctypes.c_uint32 * len(references))(*references)
        return self.call(name, found, count, values.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(len(values)))

    def get(self, *names: str) -> np.ndarray:
        values = np.zeros(len(names))
        assert self._access("GetFloat64", [self.references[x] for x in names], values) == OK
        return values

    def set(self, **values: float) -> int:
        return self._access("SetFloat64", [self.references[x] for x in values], np.array([*values.values()], float))

    def derivative(self, kind: str, unknowns, knowns, seed) -> np.ndarray:
        """Return the directional derivative along a seed of the knowns, or the adjoint one of a seed of the unknowns."""
        lists = [np.array([self.references[x] for x in names], np.uint32) for names in (unknowns, knowns)]
        found = np.zeros(len(unknowns if kind == "Directional" else knowns))
        arrays = [(x.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(len(x))) for x in (*lists, np.array(seed, float), found)]
        assert self.call(f"Get{kind}Derivative", *(x for pair in arrays for x in pair)) == OK, self.messages
        return found

    def step(self, t: float, dt: float) -> int:
        flags = [ctypes.byref(ctypes.c_bool()) for _ in range(3)]
        reached = ctypes.byref(ctypes.c_double())
        return self.call("DoStep", ctypes.c_double(t), ctypes.c_double(dt), True, *flags, reached)

    def update(self) -> tuple[bool, float | None]:
        """Return whether event mode has changed the state, and the time of the next event."""
        flags, time = [ctypes.c_bool() for _ in range(5)], ctypes.c_double()
        assert self.call("UpdateDiscreteStates", *map(ctypes.byref, flags), ctypes.byref(time)) == OK
        return flags[3].value, time.value if flags[4].value else None

    def vector(self, name: str, n: int) -> np.ndarray:
        found = np.zeros(n)
        assert self.call(name, found.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(n)) == OK
        return found


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    return udk.export_fmu(pendulum(), folder / "pendulum.fmu", stiff=False, outputs=OUTPUTS, options=options())


@pytest.fixture
def instance(fmu, tmp_path):
    return lambda kind: Instance(fmu.file, tmp_path / kind, kind)


def states(mechanism: udk.Mechanism) -> list[str]:
    rates = ("vx", "vy", "omega")
    return [f"body.{b}.{x}" for names in (("x", "y", "angle"), rates) for b in mechanism.body_names for x in names]


def test_the_description_has_the_scene_s_names_units_and_roles(fmu, instance):
    xml = instance("CoSimulation").xml
    found = {x.get("name"): x.attrib for x in xml.iter("Float64")}
    assert fmu.inputs == [DRIVE] and found[DRIVE]["unit"] == "N m" and found[DRIVE]["causality"] == "input"
    mass = found["body.rod.mass"]
    assert (mass["causality"], mass["variability"], mass["unit"], mass["start"]) == ("parameter", "fixed", "kg", "2.0")
    assert [found[x]["unit"] for x in ("body.rod.x", "body.rod.omega", "body.rod.alpha")] == ["m", "rad/s", "rad/s2"]
    assert [found[x]["causality"] for x in OUTPUTS] == ["output"] * 3 and fmu.outputs[-3:] == OUTPUTS
    assert found["der(state.body.rod.omega)"]["derivative"] == found["state.body.rod.omega"]["valueReference"]
    assert not any("position" in name or "velocity" in name for name in fmu.parameters)
    units = {x.get("name"): {**x[0].attrib} for x in xml.iter("Unit")}
    assert {x["unit"] for x in found.values() if "unit" in x} == {*units} and units["N m"] == {"kg": "1", "m": "2", "s": "-2"}
    assert base_unit("N m s/rad") == {"kg": "1", "m": "2", "s": "-1", "rad": "-1"}


def test_sources_are_those_of_the_library(fmu):
    with zipfile.ZipFile(fmu.file) as archive:
        names = archive.namelist()
        listed = [x.attrib["name"] for x in ET.fromstring(archive.read("sources/buildDescription.xml")).iter("SourceFile")]
    assert sorted(listed) == sorted(x.removeprefix("sources/") for x in names if x.endswith(".c"))
    assert {f"binaries/{this_platform()}/pendulum.so", "sources/fmi3.h", "sources/model.h"} <= {*names}


def test_co_simulation_equals_steps_with_parameters_and_inputs(instance):
    mechanism, one = pendulum(), instance("CoSimulation")
    assert one.set(**{"body.rod.mass": 1.7, "state.body.rod.angle": 0.3}) == OK
    assert one.begin() == OK
    values = {"body.rod.mass": 1.7}
    names, dt = states(mechanism), 0.1
    start = one.get(*names).reshape(2, 1, 3)
    state = udk.assemble(mechanism.with_parameters({**values, "body.rod.angle": 0.3}))
    assert_allclose(start, np.stack([state.q, state.v]), atol=1e-12)
    state = udk.State(*start)
    for k in range(4):
        torque = 0.5 - 0.2 * k
        assert one.set(**{DRIVE: torque}) == OK and one.step(k * dt, dt) == OK, one.messages
        state = udk.step(mechanism, state, {**values, DRIVE: torque}, dt, k * dt, analysis=udk.analyse(mechanism))
        rtol, atol = (0.0, 0.0) if fused() else (1e-11, 1e-12)
        assert_allclose(one.get(*names), np.ravel([state.q, state.v]), rtol=rtol, atol=atol)
    wanted = udk.accelerations(mechanism.with_parameters({**values, DRIVE: torque}), 0.4, state.q, state.v)
    assert_allclose(one.get("body.rod.ax", "body.rod.ay", "body.rod.alpha"), wanted[0], rtol=1e-12)
    assert_allclose(one.get(*OUTPUTS), measured(mechanism, state.q, state.v), rtol=1e-12, atol=1e-14)


def test_a_state_is_restored_from_its_bytes(instance):
    one, names = instance("CoSimulation"), states(pendulum())
    assert one.begin() == OK and one.step(0.0, 0.1) == OK
    kept, copy, size = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_size_t()
    assert one.call("GetFMUState", ctypes.byref(kept)) == OK
    assert one.call("SerializedFMUStateSize", kept, ctypes.byref(size)) == OK
    data = ctypes.create_string_buffer(size.value)
    assert one.call("SerializeFMUState", kept, data, size) == OK
    ahead = [one.step(0.1, 0.1), one.get(*names)]
    assert one.set(**{DRIVE: 1.0}) == OK and one.call("Reset") == OK and one.begin() == OK
    assert one.call("DeserializeFMUState", data, size, ctypes.byref(copy)) == OK
    assert one.call("SetFMUState", copy) == OK
    assert [one.step(0.1, 0.1), one.get("time", DRIVE).tolist()] == [ahead[0], [0.2, 0.0]]
    assert_array_equal(one.get(*names), ahead[1])
    head = len(one.token) + 1  # the token, as text of C
    for damaged in (b"x" * size.value, data.raw[:head] + b"\0" * (size.value - head)):
        assert one.call("DeserializeFMUState", damaged, size, ctypes.byref(copy)) == ERROR
    for state in (kept, copy):
        assert one.call("FreeFMUState", ctypes.byref(state)) == OK and not state.value


def test_wrong_calls_have_a_status_and_a_message(instance):
    one = instance("CoSimulation")
    calls = [
        (lambda: one.step(0.0, 0.1), "fmi3DoStep must not be called in the state: instantiated"),
        (lambda: one.set(**{DRIVE: np.nan}), f"{DRIVE} must be finite, not nan"),
        (lambda: one.set(**{"body.rod.mass": -1.0}), "body.rod.mass must be > 0, not -1"),
        (lambda: one.set(**{"body.rod.inertia": 0.0}), "body.rod.inertia must be > 0, not 0"),
        (lambda: one.set(**{"body.rod.x": 1.0}), "variable 1 cannot be set"),
        (lambda: one._access("GetFloat64", [10_000], np.zeros(1)), "there is no variable 10000"),
        (lambda: one._access("GetFloat64", [1], np.zeros(2)), "2 values of 1 variables"),
        (lambda: one._access("GetInt32", [1], np.zeros(1)), "no variables of type Int32"),
        (lambda: one.call("SetFMUState", None), "there is no state"),
        (lambda: one.begin() or one.set(**{"body.rod.mass": 2.0}), "body.rod.mass can be set before the run only"),
        (lambda: one.step(0.0, -0.1), "a step must be finite and > 0 s, not -0.1"),
        (lambda: one.step(3.0, 0.1), "a step from 3 s, but the FMU is at 0 s"),
        (lambda: one.call("SetTime", ctypes.c_double(1.0)), "fmi3SetTime must not be called in the state: step mode"),
        (lambda: one.call("EnterConfigurationMode"), "no structural parameters"),
    ]
    for call, message in calls:
        assert call() == ERROR
        assert message in one.messages[-1]
    assert one.step(0.0, 1e4) == DISCARD and "try a shorter one" in one.messages[-1]
    assert one.step(0.0, 0.1) == OK and np.isfinite(one.get("body.rod.x")).all()
    assert one.instantiate(b"other") is None and "instantiation token" in one.messages[-1]
    closed = len(one.messages)
    assert one.call("Reset") == OK and one.begin(stop=1.0) == OK and one.step(0.0, 1.1) == ERROR
    assert len(one.messages) == closed + 1 and "beyond the stop time" in one.messages[-1]


def test_model_exchange_evaluates_the_projected_state_and_lets_drift_decay(instance):
    mechanism, one, names = pendulum(), instance("ModelExchange"), states(pendulum())
    assert one.begin() == OK and one.update() == (False, None) and one.call("EnterContinuousTimeMode") == OK
    on = one.vector("GetContinuousStates", 6)
    for size, returns in ((1e-8, False), (1e-4, True)):
        off = on + size * np.array([1.0, 2.0, -1.0, 0.5, 0.3, 0.2])
        assert one.call("SetContinuousStates", off.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(6)) == OK
        q, v = (x.reshape(1, 3) for x in np.split(one.get(*names), 2))
        assert_allclose(q[0, :2], 0.75 * np.array([np.cos(q[0, 2]), np.sin(q[0, 2])]), atol=1e-12)  # m, from the pin
        rates, drift = one.vector("GetContinuousStateDerivatives", 6), one.get(*names) - off
        plain = np.concatenate([np.ravel(v), np.ravel(udk.accelerations(mechanism, 0.0, q, v))])
        decay = (rates - plain) @ drift / (drift @ drift)
        assert_allclose(rates, plain + decay * drift, rtol=1e-9, atol=1e-9)
        assert decay > 1.0  # 1/s
        event, end = ctypes.c_bool(), ctypes.c_bool()
        assert one.call("CompletedIntegratorStep", True, ctypes.byref(event), ctypes.byref(end)) == OK
        assert event.value is returns
    assert one.call("EnterEventMode") == OK and one.update() == (True, None)
    assert_array_equal(one.vector("GetContinuousStates", 6), one.get(*names))


def measured(mechanism: udk.Mechanism, q, v):
    """Return the further outputs at a state."""
    motion = MeasuredState(jnp.zeros(1), jnp.reshape(q, (1, -1, 3)), jnp.reshape(v, (1, -1, 3)))
    return measure(mechanism, motion, [channel_of(mechanism, x) for x in OUTPUTS])[0]


def closed(mechanism: udk.Mechanism, state):
    """Return a state near the constraints, projected onto them to first order, with accelerations and further outputs."""
    (q, v), of = state.reshape(2, -1), udk.equations
    mass = of.mass(mechanism)

    def corrected(x, left, at):
        rows = of.psi_q(mechanism, 0.0, at)
        return x - (rows / mass).T @ jnp.linalg.solve((rows / mass) @ rows.T, left)

    q = corrected(q, of.psi(mechanism, 0.0, q), q)
    v = corrected(v, of.psi_dot(mechanism, 0.0, q, v), q)
    return jnp.concatenate([q, v, jnp.ravel(udk.accelerations(mechanism, 0.0, q, v)), measured(mechanism, q, v)])


def test_derivatives_equal_those_of_jax_forward_and_adjoint(instance):
    mechanism, rng, names = pendulum(), np.random.default_rng(0), states(pendulum())
    knowns, a = [*(f"state.{x}" for x in names), DRIVE], ["body.rod.ax", "body.rod.ay", "body.rod.alpha", *OUTPUTS]
    rates = [f"der(state.{x})" for x in names]
    one, other = instance("ModelExchange"), instance("CoSimulation")
    for x in (one, other):
        assert x.set(**{"body.rod.mass": 1.7, "state.body.rod.angle": 0.3, "state.body.rod.omega": 2.0}) == OK

    def begun(p):
        given = {"body.rod.mass": p[0], DRIVE: p[1], "gravity": p[2:4], "body.rod.angle": p[4], "body.rod.angular_velocity": p[5]}
        changed = mechanism.with_parameters(given)
        state = udk.assemble(changed)
        a = udk.accelerations(changed, 0.0, state.q, state.v)
        return jnp.concatenate([*map(jnp.ravel, (state.q, state.v, a)), measured(changed, state.q, state.v)])

    p, seed = np.array([1.7, 0.0, 0.0, -9.81, 0.3, 2.0]), rng.normal(size=6)
    assert (
        one.call("EnterInitializationMode", False, ctypes.c_double(0.0), ctypes.c_double(0.0), False, ctypes.c_double(0.0)) == OK
    )
    of = ["body.rod.mass", DRIVE, "gravity[0]", "gravity[1]", "state.body.rod.angle", "state.body.rod.omega"]
    found, wanted = one.derivative("Directional", [*names, *a], of, seed), jax.jit(lambda p: jax.jvp(begun, (p,), (seed,)))(p)[1]
    assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    assert one.call("ExitInitializationMode") == OK and one.update() == (False, None)
    assert one.call("EnterContinuousTimeMode") == OK and other.begin() == OK

    start = one.get(*(f"state.{x}" for x in names))
    values = jax.jit(jax.jacfwd(lambda x: closed(mechanism.with_parameters({"body.rod.mass": 1.7, DRIVE: x[6]}), x[:6])))
    jacobian = np.asarray(values(np.append(start, 0.0)))
    drift = (one.derivative("Directional", rates, knowns, seed := rng.normal(size=7)) - jacobian[3:9] @ seed) / (
        jacobian[:6] @ seed - seed[:6]
    )
    assert_allclose(drift, drift[0], rtol=1e-9)  # the rate at which it decays
    found = np.transpose([one.derivative("Directional", [*names, *a], knowns, x) for x in np.eye(7)])
    assert_allclose(found, jacobian, rtol=0.0, atol=1e-12 * np.abs(jacobian).max())
    assert_allclose(
        one.derivative("Adjoint", [*names, *a], knowns, seed := rng.normal(size=12)), seed @ found, rtol=1e-13, atol=1e-12
    )
    step = other.derivative("Directional", [*names, *a], [DRIVE], [1.0])  # an input does not move the state at once
    assert_allclose(step, [0.0] * 6 + [*jacobian[6:9, 6]] + [0.0] * 3, rtol=0.0, atol=1e-12 * np.abs(jacobian).max())
    with pytest.raises(AssertionError, match="no derivative with respect to variable 0"):
        one.derivative("Directional", a, ["time"], [1.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(udk.library.__all__), *DRAWINGS], ids=lambda x: Path(x).stem)
def test_derivatives_of_every_scene_equal_those_of_jax(name, tmp_path):
    """Directional and adjoint, of closed states and accelerations with respect to the states, redundant rows included."""
    mechanism, rng = scene(name), np.random.default_rng(0)
    file = udk.export_fmu(mechanism, tmp_path / "a.fmu", options=options()).file
    one, names = Instance(file, tmp_path / "a", "ModelExchange"), states(mechanism)
    a = [f"body.{b}.{x}" for b in mechanism.body_names for x in ("ax", "ay", "alpha")]
    assert one.begin() == OK and one.update()[0] is False and one.call("EnterContinuousTimeMode") == OK
    start, seed = one.get(*(f"state.{x}" for x in names)), rng.normal(size=len(names))

    def found_by_jax(x):
        (q, v), of = x.reshape(2, -1), udk.equations
        root = jnp.sqrt(of.mass(mechanism))

        def corrected(x, left, at):
            return x - jnp.linalg.pinv(of.psi_q(mechanism, 0.0, at) / root, rcond=1e-9) @ left / root

        q = corrected(q, of.psi(mechanism, 0.0, q), q)
        v = corrected(v, of.psi_dot(mechanism, 0.0, q, v), q)
        # By SVD they would lose digits: 2e-12 of the door closer's.
        a = udk.accelerations(mechanism, 0.0, q.reshape(-1, 3), v.reshape(-1, 3), udk.Elimination())
        return jnp.concatenate([q, v, jnp.ravel(a)])

    wanted = np.asarray(jax.jit(lambda x: jax.jvp(found_by_jax, (x,), (seed,))[1])(jnp.asarray(start)))
    known = [f"state.{x}" for x in names]
    found = one.derivative("Directional", [*names, *a], known, seed)
    size = np.abs([*wanted, *seed]).max()  # of a driven scene nothing moves
    assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * size)
    back = rng.normal(size=len(found))
    assert_allclose(
        one.derivative("Adjoint", [*names, *a], known, back) @ seed, back @ found, rtol=0.0, atol=1e-12 * size * len(found)
    )


def test_a_drawing_s_pins_move_the_start(tmp_path):
    mechanism = udk.library.slider_crank()
    found = udk.export_fmu(mechanism, tmp_path / "a.fmu", ["co-simulation"], ["pin.P"], stiff=False, options=["-O0"])
    one, values = Instance(found.file, tmp_path / "a", "CoSimulation"), {"pin.P[0]": 0.4, "pin.P[1]": 0.9}
    assert one.set(**values) == OK and one.begin() == OK, one.messages
    state = udk.assemble(mechanism.with_parameters({"pin.P": [0.4, 0.9]}))
    assert_allclose(one.get(*states(mechanism)), np.ravel([state.q, state.v]), atol=1e-9)


def test_what_cannot_be_exported_is_refused(tmp_path, capsys):
    mechanism, file = pendulum(), tmp_path / "a.fmu"
    refused = [
        ({"kinds": []}, "kinds must be a list of"),
        ({"t1": -1.0}, "t1 must be later than t0 = 0 s, not -1 s"),
        ({"parameters": [DRIVE], "inputs": [DRIVE]}, f"{DRIVE}: an input is no parameter as well"),
        ({"inputs": ["force.nothing.value"]}, "force.nothing.value"),
        ({"outputs": ["body.rod.ax"]}, "outputs are positions and velocities of moving points: leave out body.rod.ax"),
        ({"outputs": ["pin.nothing.x"]}, "nothing"),
        ({"options": ["-no-such-option"]}, "cc.* failed for .*no-such-option"),
    ]
    for given, message in refused:
        with pytest.raises(ValueError, match=message):
            udk.export_fmu(mechanism, file, stiff=False, **given)
    held = mechanism.with_parameters({DRIVE: udk.Held(np.array([1.0, 2.0]), 0.5)})
    with pytest.raises(ValueError, match=r"no model exchange: .*tables over time.*kinds=\['co-simulation'\]"):
        udk.export_fmu(held, file)
    assert not file.exists()
    assert udkjax("export", "compound_pendulum") == 2 and "--fmu FILE" in capsys.readouterr().err
    assert udkjax("export", "compound_pendulum", "--fmu", file, "--kinds", "co-simulation", "--no-stiff", "--json") == 0
    assert file.exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(udk.library.__all__), *DRAWINGS], ids=lambda x: Path(x).stem)
def test_every_scene_runs_in_an_importer(name, tmp_path):
    fmpy = pytest.importorskip("fmpy")
    from fmpy.validation import validate_fmu  # pyright: ignore[reportMissingImports]

    mechanism, file = scene(name), str(tmp_path / "a.fmu")
    end = 0.03 if name == "andrews_squeezer" else 2.0
    found = udk.export_fmu(mechanism, file, t1=end, dt=end / 40, options=options("-O1"))
    assert validate_fmu(file) == []
    names, dt = found.outputs[: 6 * len(mechanism.bodies)], end / 40
    given = {"stop_time": end, "output_interval": dt, "output": names}
    table = fmpy.simulate_fmu(file, fmi_type="CoSimulation", **given)
    state, analysis, wanted = udk.assemble(mechanism), udk.analyse(mechanism), []
    for k, t in enumerate(table["time"]):
        wanted.append(np.ravel([state.q, state.v]))
        state = udk.step(mechanism, state, None, table["time"][min(k + 1, 40)] - t or dt, t, analysis=analysis)
    values = np.array([[row[x] for x in names] for row in table])
    if fused():
        assert_allclose(values, wanted, rtol=0.0, atol=np.finfo(float).tiny)  # XLA's threads have no subnormal numbers
    else:
        assert_allclose(values[1], wanted[1], atol=1e-9 * np.abs(wanted).max())
    given |= {"output_interval": dt / 4}  # FMPy takes at most 500 steps between two outputs
    exchange = fmpy.simulate_fmu(file, fmi_type="ModelExchange", relative_tolerance=1e-10, record_events=False, **given)
    error = np.abs(np.array([[row[x] for x in names] for row in exchange])[::4] - wanted)
    assert error.max() < 1e-4 * np.abs(wanted).max()


@pytest.mark.slow
def test_model_exchange_stays_closed_through_singular_poses(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    mechanism = udk.library.parallelogram(angular_velocity=7.0)  # rad/s: it turns 16 times, through two singular poses each time
    found = udk.export_fmu(mechanism, tmp_path / "a.fmu", ["model-exchange"], options=options("-O1"))
    ts, names, errors = np.linspace(0.0, 20.0, 401), ["body.link1.angle", "body.coupler.x", "body.coupler.angle"], []
    angle = udk.simulate(mechanism, ts, rtol=1e-12, atol=1e-12).q[:, 0, 2]
    for tolerance in (1e-8, 1e-10):
        given = {"stop_time": 20.0, "output_interval": 0.05, "output": names, "record_events": False}
        table = fmpy.simulate_fmu(str(found.file), fmi_type="ModelExchange", relative_tolerance=tolerance, **given)
        link, x, coupler = (np.array([row[name] for row in table]) for name in names)
        errors.append(np.abs(link - angle).max())
        gap = np.abs(np.cos(link) - (x - np.cos(coupler))).max()  # m, at the pin B1
        print(f"CVODE at {tolerance:g}, 20 s: error {errors[-1]:.1e} rad, gap {gap:.1e} m")  # shown by pytest -s
        assert gap < 1e-12
    assert errors[0] < 1e-3 and errors[1] < 1e-5  # rad; CVODE's errors with the pendulum equation of this motion are half of it
