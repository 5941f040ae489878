"""C of scenes compiles without a warning, allocates nothing, and equals machine code, in every bit if products are fused."""

import ctypes
import glob
import io
import platform
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.command_line import udkjax
from tests.fused import is_fused
from udkjax.native.code import processor

pytestmark = pytest.mark.skipif(shutil.which("cc") is None or platform.system() != "Linux", reason="no C compiler")
STRICT = "-std=c99 -Wall -Wextra -pedantic -Werror"
DRAWINGS = sorted(glob.glob(str(Path(__file__).parents[3] / "examples" / "drawings" / "*.toml")))
OF_C = {"memcpy", "memset", "sqrt", "fabs", "floor", "ceil", "trunc", "rint", "fma", "copysign"}
TS = np.linspace(0.0, 1.0, 11)


def fused() -> str:
    """Return the option by which C fuses products if machine code of this processor does."""
    return "-march=native" if is_fused() and not processor._setting() else ""


def compiled(folder: Path, flags: str = "-O0") -> ctypes.CDLL:
    sources = " ".join(x.name for x in folder.glob("*.c") if x.name != "main.c")
    subprocess.run(f"cc {STRICT} {flags} -shared -fPIC {sources} -o code.so -lm", shell=True, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "code.so"))


def scene(name: str) -> udk.Mechanism:
    return udk.load(name) if name.endswith(".toml") else getattr(udk.library, name)(*([3] if name == "n_four_bar" else []))


def numbers(x):
    return np.ascontiguousarray(x, float).ctypes.data_as(ctypes.c_void_p)


def flat(*xs):
    return [np.array(x, float).ravel() for x in xs]


def count_of_numbers(code) -> int:
    header = next(x for x in code.files if x.suffix == ".h").read_text()
    return int(re.findall(r"_NUMBERS (\d+)", header)[0])


def scene_numbers(library, prefix):
    return ctypes.byref(ctypes.c_double.in_dll(library, f"{prefix}_numbers"))


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pendulum")
    mechanism = udk.library.compound_pendulum()
    what: Any = ["run", "accelerations", "derivatives", "projection", "positions", "reactions"]
    code = udk.export_c(mechanism, folder, what, TS, ["body.rod.mass", "gravity"], stiff=False)
    return mechanism, code, compiled(folder, f"-O0 {fused()}")


def test_functions_of_a_state_equal_those_of_the_package(pendulum):
    mechanism, code, library = pendulum
    state, given = udk.assemble(mechanism), scene_numbers(library, code.prefix)
    q, v = flat(state.q, state.v)
    v = v + np.asarray(udk.simulate(mechanism, TS).v[-1]).ravel()
    q = np.asarray(udk.simulate(mechanism, TS).q[-1]).ravel().copy()
    a, memory = np.zeros_like(q), {k: np.full(x // 8, np.nan) for k, x in code.memory.items()}
    getattr(library, f"{code.prefix}_accelerations")(
        given, ctypes.c_double(0.0), numbers(q), numbers(v), numbers(a), numbers(memory["accelerations"])
    )
    assert_allclose(a, np.ravel(udk.accelerations(mechanism, 0.0, q, v)), rtol=1e-12, atol=1e-12)
    loads, efforts = np.zeros(3), np.zeros(1)  # no driver
    getattr(library, f"{code.prefix}_reactions")(
        given, ctypes.c_double(0.0), *map(numbers, (q, v, loads, efforts, memory["reactions"]))
    )
    body = mechanism.bodies["rod"]
    assert_allclose(loads[:2], float(body.mass) * (a[:2] - np.asarray(mechanism.gravity)), rtol=1e-12)
    assert_allclose(loads[2], float(body.inertia) * a[2], rtol=1e-12)
    close = getattr(library, f"{code.prefix}_close")
    close.restype = ctypes.c_double
    p, w = q + 1e-3, v.copy()
    assert close(given, ctypes.c_double(0.0), numbers(p), numbers(w), numbers(memory["positions"])) < 1e-9
    p, w = q + 1e-4, v + 1e-4
    getattr(library, f"{code.prefix}_project")(given, ctypes.c_double(0.0), numbers(p), numbers(w), numbers(memory["projection"]))
    assert np.abs(p - q).max() < 1e-3
    assert float(close(given, ctypes.c_double(0.0), numbers(p), numbers(w), numbers(memory["positions"]))) < 1e-9


def derivative_in_c(library, code, numbers_of_scene, changes, q, v, dq, dv, t=0.0):
    """Return accelerations and their derivative along changes, by C."""
    found, memory = np.zeros((2, len(q))), np.full(code.memory["derivatives"] // 8, np.nan)
    arrays = [numbers(x) for x in (q, v, changes, dq, dv)]
    getattr(library, f"{code.prefix}_accelerations_along")(
        numbers_of_scene, ctypes.c_double(t), *arrays, numbers(found[0]), numbers(found[1]), numbers(memory)
    )
    return found


def test_derivatives_in_c_equal_those_of_jax(pendulum):
    mechanism, code, library = pendulum
    rng, state = np.random.default_rng(0), udk.assemble(mechanism)
    q, v, dq, dv = *flat(state.q, state.v), *rng.normal(size=(2, 3))
    parameters, changes = np.array([float(mechanism.bodies["rod"].mass), 0.0, -9.81]), rng.normal(size=3)
    dnumbers = np.full(count_of_numbers(code), np.nan)
    getattr(library, f"{code.prefix}_set_parameters_along")(numbers(np.concatenate([parameters, changes])), numbers(dnumbers))
    found = derivative_in_c(library, code, scene_numbers(library, code.prefix), dnumbers, q, v, dq, dv)

    def accelerations(p, q, v):
        changed = mechanism.with_parameters({"body.rod.mass": p[0], "gravity": p[1:]})
        return jax.numpy.ravel(udk.accelerations(changed, 0.0, q, v))

    assert_allclose(found, jax.jvp(accelerations, (parameters, q, v), (changes, dq, dv)), rtol=1e-12, atol=1e-12)


def test_a_step_with_other_parameters_equals_that_of_the_package(pendulum):
    mechanism, code, library = pendulum
    state, memory = udk.assemble(mechanism), np.full(code.memory["run"] // 8, np.nan)
    own = np.array((ctypes.c_double * count_of_numbers(code)).in_dll(library, f"{code.prefix}_numbers"))
    for values in ({}, {"body.rod.mass": 1.3, "gravity": np.array([0.5, -9.0])}):
        if values:
            getattr(library, f"{code.prefix}_set_parameters")(
                numbers(np.concatenate(flat(*values.values()), axis=None)), numbers(own)
            )
        q, v = flat(state.q, state.v)
        step = getattr(library, f"{code.prefix}_step")
        assert step(numbers(own), ctypes.c_double(0.0), ctypes.c_double(0.05), numbers(q), numbers(v), numbers(memory)) == 0
        wanted = udk.step(mechanism, state, values, 0.05, analysis=udk.analyse(mechanism))
        assert_allclose(np.concatenate([q, v]), np.concatenate(flat(wanted.q, wanted.v)), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("scene", ["compound_pendulum", pytest.param("parallelogram", marks=pytest.mark.slow)])
def test_the_program_prints_the_table_of_the_command(scene, tmp_path, capsys):
    arguments = ("--t1", "0.5", "--dt", "0.1", "--json")
    assert udkjax("export", scene, "--c", tmp_path / "c", "--what", "run", "--no-stiff", *arguments) == 0
    assert udkjax("simulate", scene, "--out", tmp_path / "run.csv", *arguments) == 0
    capsys.readouterr()
    wanted = (tmp_path / "run.csv").read_text().splitlines()
    subprocess.run(f"cc {STRICT} -O0 {fused()} *.c -o run -lm", shell=True, cwd=tmp_path / "c", check=True)
    found = subprocess.run(["./run"], cwd=tmp_path / "c", check=True, capture_output=True, text=True).stdout.splitlines()
    assert found[0] == wanted[0]
    pairs = [np.array([[float(x) for x in line.split(",")] for line in lines[1:]]) for lines in (found, wanted)]
    assert_allclose(*pairs, rtol=0.0, atol=0.0 if fused() and processor.lanes() > 1 else 1e-9)
    called = subprocess.run(["nm", "-u", "run"], cwd=tmp_path / "c", check=True, capture_output=True, text=True).stdout.split()
    own = {x.partition("@")[0] for x in called if "@GLIBC" in x and not x.startswith("__")}
    assert own <= OF_C | {"puts", "putchar", "printf", "fprintf", "stderr", "fputc", "fputs", "putc", "fwrite"}


def test_scenes_without_c_are_refused_by_name(tmp_path):
    mechanism = udk.library.compound_pendulum()
    with pytest.raises(ValueError, match="what must be"):
        udk.export_c(mechanism, tmp_path, [])
    with pytest.raises(ValueError, match="ts must be at least two increasing times"):
        udk.export_c(mechanism, tmp_path, ts=[0.0, 0.0])
    joint = next(iter(mechanism.joints))
    sticking = udk.Mechanism(
        mechanism.bodies,
        mechanism.joints,
        {},
        {"rub": udk.Friction(joint, coefficient=0.2, radius=0.01, law="set-valued")},
        mechanism.gravity,
        "rubbing",
    )
    with pytest.raises(ValueError, match=f'no C for joints that stick .*{joint}.*law="smooth"'):
        udk.export_c(sticking, tmp_path)
    (tmp_path / "main.c").write_text("int main(void) { return 0; }")
    with pytest.raises(ValueError, match=r"has main\.c, which udkjax did not write: choose another folder"):
        udk.export_c(mechanism, tmp_path, ["run"], stiff=False)
    (tmp_path / "main.c").unlink()
    assert not list(tmp_path.iterdir())


def test_names_are_what_they_are_and_further_exports_replace_files(tmp_path):
    odd = 'a "b", \\ %d ??/ */ /*'
    bodies = {odd: udk.Body(1.0, 0.1, velocity=[1.0, 2.0]), "\u6881\u00e9a": udk.Body(1.0, 0.1)}
    mechanism = udk.Mechanism(bodies, name='return */ "\u00e9"\n??/')
    udk.export_c(mechanism, tmp_path, ["run", "step_derivatives"], TS, stiff=False)
    udk.export_c(mechanism, tmp_path, ["run"], TS, stiff=False)
    assert not list(tmp_path.glob("*step_derivatives*"))
    subprocess.run(f"cc {STRICT} -O0 *.c -o run -lm", shell=True, cwd=tmp_path, check=True)
    table = subprocess.run(["./run"], cwd=tmp_path, check=True, capture_output=True, encoding="utf-8").stdout
    found = pandas.read_csv(io.StringIO(table))
    assert [*found][1:7:3] == [f"body.{name}.x [m]" for name in bodies]
    assert_allclose(found[f"body.{odd}.x [m]"], TS, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(udk.library.__all__), *DRAWINGS], ids=lambda x: Path(x).stem)
def test_every_scene_runs_in_c(name, tmp_path):
    mechanism = scene(name)
    ts = np.linspace(0.0, 0.03 if name == "andrews_squeezer" else 20.0, 401)
    code = udk.export_c(mechanism, tmp_path, ["run", "accelerations", "projection", "positions"], ts)
    assert code.flops < 4000 or len(mechanism.bodies) > 12
    subprocess.run(f"cc {STRICT} -O1 {fused()} *.c -o run -lm", shell=True, cwd=tmp_path, check=True)
    lines = subprocess.run(["./run"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.splitlines()[1:]
    found = np.array([[float(x) for x in line.split(",")] for line in lines])[:, 1:]
    run = udk.simulate(mechanism, ts)
    wanted = np.hstack([np.asarray(x).reshape(len(ts), -1) for x in (run.q, run.v)])
    if fused():
        assert_array_equal(found, wanted)
    else:
        assert_allclose(found[1], wanted[1], atol=1e-9 * np.abs(wanted).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted(udk.library.__all__), *DRAWINGS], ids=lambda x: Path(x).stem)
def test_every_scene_has_reactions_and_derivatives_in_c(name, tmp_path):
    """Changes of the state are projected onto the constraints, which keeps redundant ones compatible."""
    what: Any = ["step_derivatives", "derivatives", "position_derivatives", "reactions"]
    mechanism, mass = scene(name), udk.equations.mass(scene(name))
    code, dt = udk.export_c(mechanism, tmp_path, what), 0.003
    library, run, analysis = compiled(tmp_path, fused()), udk.simulate(mechanism, [0.0, dt, 2 * dt]), udk.analyse(mechanism)
    q, v, given = *flat(run.q[1], run.v[1]), scene_numbers(library, code.prefix)
    changes, t, zeros = np.random.default_rng(0).normal(size=(2, len(q))), ctypes.c_double(float(run.ts[1])), np.zeros(10_000)

    def call(name, what, *arguments):
        memory = numbers(np.full(code.memory[what] // 8, np.nan))
        return getattr(library, f"{code.prefix}_{name}")(given, t, *arguments, memory)

    def close_to(found, wanted, what, of):
        difference = np.abs(found - np.asarray(wanted)).max(initial=0.0) / np.abs(of).max()
        print(f"{Path(name).stem}, {what}: relative difference {difference:.1e}")  # shown by pytest -s
        assert difference < 1e-12

    def of(function):
        def states(q, v):
            state = function(udk.State(q.reshape(-1, 3), v.reshape(-1, 3)))
            return jax.numpy.stack([state.q.ravel(), state.v.ravel()])

        return states

    closed = np.zeros((2, len(q)))
    call("close_along", "position_derivatives", *map(numbers, (q, v, zeros, *changes, closed)))
    wanted = jax.jvp(of(lambda x: udk.assemble(mechanism, run.ts[1], x)), (q, v), tuple(changes))[1]
    close_to(closed, wanted, "derivatives of closed positions", [changes, wanted])
    along = closed + [v, np.ravel(udk.accelerations(mechanism, run.ts[1], q, v))]  # drivers allow their motion only
    found = derivative_in_c(library, code, given, zeros, q, v, *along, t=float(run.ts[1]))
    wanted = jax.jvp(lambda q, v: jax.numpy.ravel(udk.accelerations(mechanism, run.ts[1], q, v)), (q, v), tuple(along))
    # Loads on light links that the constraints oppose cancel in their accelerations, and leave their rounding errors.
    free = jax.jvp(lambda q, v: udk.equations.force(mechanism, run.ts[1], q, v) / mass, (q, v), tuple(along))
    close_to(found, wanted, "accelerations and their derivatives", [*wanted, *free])
    state, moved = np.stack([q, v]), along.copy()
    arguments = [ctypes.c_double(dt), *map(numbers, (*state, zeros, *moved))]
    assert call("step_along", "step_derivatives", *arguments) == 0
    wanted = jax.jvp(of(lambda x: udk.step(mechanism, x, None, dt, run.ts[1], analysis=analysis)), (q, v), tuple(along))
    close_to(moved, wanted[1], "derivatives of a step", [along, wanted[1]])
    reactions = [x[1] for bodies in udk.reactions(mechanism, run).values() for x in bodies.values()]
    efforts = [x[1] for x in udk.efforts(mechanism, run).values()]
    found = [np.zeros(3 * len(reactions)), np.zeros(len(efforts))]
    call("reactions", "reactions", *map(numbers, (q, v, *found)))
    close_to(np.concatenate(found), np.concatenate([np.ravel(reactions), efforts]), "reactions and efforts", reactions)
    undefined = subprocess.run(["nm", "-u", "code.so"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.split()
    assert {x.partition("@")[0] for x in undefined if "@GLIBC" in x and not x.startswith("__")} <= OF_C
