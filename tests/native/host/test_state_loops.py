"""Programs of scenes at single states: by machine code, which Python calls, they are what they are on Python's floats."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.elements import BODIES, FORCES, JOINTS
from udkjax.equations.programs import scene_arrays
from udkjax.equations.programs.scene_arrays import SceneArrays, arrays_in_time
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.terms.rest_program import CURVATURE, OF_LOADS
from udkjax.expressions.loops import array_loops, compiled_loops
from udkjax.native import primitive  # noqa: F401  # registers the compiler

OUTPUTS = ("psi_q", "psi", "psi_dot"), ("terms",), ("energy",), OF_LOADS, (CURVATURE,)
SCENES = {
    "joints and forces": lambda: udk.Mechanism(BODIES, JOINTS, forces=FORCES),
    "redundant rows": udk.library.parallelogram,
    "no joints": lambda: udk.Mechanism(BODIES, forces={k: f for k, f in FORCES.items() if not isinstance(f, udk.Friction)}),
}


def values_at(at: SceneArrays, t: float, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """Return everything that `SceneArrays` computes at a state."""
    found = dict(zip(("psi", "rate", "entries"), at.geometry(t, q, v), strict=True))
    found |= dict(zip(("free", "b"), at.loads(t, q, v), strict=True)) | at.element_loads(t, q, v)
    multipliers = np.cos(np.arange(at.programs.row_count))
    return found | {"energy": at.energy(t, q, v), "curvature": at.curvature(t, q, multipliers)}


def evaluated(scene: udk.Mechanism, calls: int) -> tuple[list[dict[str, np.ndarray]], SceneArrays]:
    """Return values at several states by programs that are compiled after so many calls."""
    at = SceneArrays(scene_programs(scene), arrays_in_time(scene)(0.0).numbers, np)
    for outputs in OUTPUTS:  # evaluators of its own: others keep theirs
        at._evaluators[outputs] = own = scene_arrays._evaluator.__wrapped__(at.programs, np, *outputs)  # pyright: ignore
        own.loops._calls = calls
    rng, q, n = np.random.default_rng(3), np.array(scene.q0).ravel(), scene.q0.size
    return [values_at(at, 0.1 * k, q + 0.1 * rng.standard_normal(n), rng.standard_normal(n)) for k in range(4)], at


@pytest.mark.parametrize("name", SCENES)
def test_machine_code_is_what_floats_are(name):
    scene = SCENES[name]()
    (by_floats, _), (by_code, at) = evaluated(scene, -(10**6)), evaluated(scene, array_loops.WORTH_COMPILING - 1)
    assert at._evaluator(("psi_q", "psi", "psi_dot"))[0].compiled is not None
    assert by_floats[0].keys() == by_code[0].keys()
    for floats, code in zip(by_floats, by_code, strict=True):
        for key, x in floats.items():
            assert_allclose(code[key], x, rtol=1e-12, atol=1e-12 * np.max(np.abs(x), initial=1.0), err_msg=key)


def test_threads_share_the_code_and_not_the_results():
    scene = udk.library.four_bar()
    at = evaluated(scene, array_loops.WORTH_COMPILING - 1)[1]
    places = [np.array(scene.q0).ravel() + 0.01 * k for k in range(40)]
    expected, interval = [at.psi(0.0, q) for q in places], sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            for _ in range(5):
                for found, x in zip(pool.map(lambda q: at.geometry(0.0, q, q)[0], places), expected, strict=True):
                    assert_allclose(found, x, rtol=1e-12, atol=1e-13)
    finally:
        sys.setswitchinterval(interval)


def test_states_that_are_not_finite_have_no_values():
    scene = udk.library.four_bar()
    at = evaluated(scene, array_loops.WORTH_COMPILING - 1)[1]
    q = np.array(scene.q0).ravel()
    before = at.geometry(0.0, q, q)[0]
    assert np.isnan(at.geometry(0.0, np.inf * q, q)[0]).any()
    assert_allclose(at.geometry(0.0, q, q)[0], before, rtol=0)  # nothing is left in memory


def test_nothing_is_compiled_without_a_compiler(monkeypatch):
    monkeypatch.setattr(compiled_loops, "_COMPILERS", [])
    found, at = evaluated(udk.library.four_bar(), array_loops.WORTH_COMPILING - 1)
    assert at._evaluator(("terms",))[0].compiled is None and np.isfinite(found[0]["psi"]).all()
