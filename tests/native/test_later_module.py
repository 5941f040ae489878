"""The module with the implicit method, which is loaded when a run first needs it."""

import re
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module

import jax
import numpy as np
import pytest

import udkjax as udk
from tests.native.test_implicit_stages import damped
from udkjax.native import loaded_code
from udkjax.native.code import machine
from udkjax.native.module import leaving, loading

TS = np.linspace(0.0, 0.5, 3)
STIFF, SOFT = 1e5, 0.1


@pytest.fixture
def motion(monkeypatch, tmp_path):
    """The motion of a damped pendulum, whose modules nobody has loaded; after the test they are forgotten."""
    mechanism = damped(1.0, scene=udk.library.compound_pendulum())
    analysis, state = udk.analyse(mechanism), udk.assemble(mechanism)

    def forget():
        loaded_code.generate.cache_clear()
        loaded_code.machine_code.cache_clear()
        jax.clear_caches()

    def of_damping(damping):
        moved = mechanism.with_parameters({"force.damper.damping": damping})
        found = udk.simulate(moved, TS, state=state, analysis=analysis, rtol=1e-6, atol=1e-6, throw=False)
        return found.q, found.v, found.stats["implicit"]

    forget()
    monkeypatch.setattr(machine, "_compiler", lambda: str(tmp_path))  # whose code nobody has loaded
    monkeypatch.setattr(loading, "_LOADED", {})
    yield of_damping
    forget()


def later_codes():
    return [code.later.code for code in loading._LOADED.values() if code.later]


def assert_equal(found, expected):
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y)


def test_it_is_loaded_when_a_run_needs_it(motion):
    jitted = jax.jit(motion)
    assert jitted(SOFT)[2] == 0
    assert later_codes() == [None]
    found = jitted(STIFF)
    assert found[2] > 0
    assert sum(x is not None for x in later_codes()) == 1
    assert_equal(found, jitted(STIFF))  # by the later module from the beginning
    assert_equal(found, motion(STIFF))
    assert_equal(jitted(SOFT), motion(SOFT))


@pytest.mark.slow
def test_members_in_lanes_leave_together(motion):
    """Members before them are complete, and members after them have not begun: all are run once."""
    dampings = np.array([*[SOFT] * 11, STIFF, *[SOFT] * 5, 10 * STIFF, *[SOFT] * 3])
    found = jax.jit(jax.vmap(motion))(dampings)
    for k, damping in enumerate(dampings):
        assert_equal([x[k] for x in found], motion(damping))


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    [lambda f: f, jax.vmap, lambda f: jax.grad(lambda x: f(x)[0].sum()), lambda f: jax.jacfwd(lambda x: f(x)[0])],
    ids=["run", "lanes", "gradient", "forward"],
)
def test_both_modules_share_code(motion, way):
    """Their functions are equal but for those that know of the implicit method, and compiled once."""
    jax.block_until_ready(jax.jit(way(motion))(np.full(4, STIFF) if way is jax.vmap else STIFF))
    first_code = next(code for code in loading._LOADED.values() if code.later and code.later.code)
    texts = dict(zip((leaving.LATER_POINTER, leaving.RESUME), first_code.texts(), strict=True))
    first, later = (
        {body[: body.index("(")]: body for body in re.findall(r"^define .*?^}$", texts[name], re.MULTILINE | re.DOTALL)}
        for name in (leaving.LATER_POINTER, leaving.RESUME)
    )
    different = {name.partition("@")[2] for name, body in first.items() if later[name] != body}
    assert different <= leaving.DIFFERENT_FUNCTIONS
    parts = [set(machine.split_module(texts[name])) for name in (leaving.LATER_POINTER, leaving.RESUME)]
    assert len(parts[0] & parts[1]) >= len(parts[0]) / 2


def test_threads_load_it_once(motion):
    jitted = jax.jit(motion).lower(STIFF).compile()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(jitted, [STIFF] * 4))
    assert sum(x is not None for x in later_codes()) == 1
    for other in found[1:]:
        assert_equal(other, found[0])


def test_if_it_cannot_be_loaded_the_call_is_refused(motion, monkeypatch, capfd):
    def fail(*arguments):
        raise OSError("no module")

    monkeypatch.setattr(loaded_code, "_load_later", fail)
    jitted = jax.jit(motion)
    assert jitted(SOFT)[2] == 0
    with pytest.raises((ValueError, jax.errors.JaxRuntimeError), match="no memory for a computation by machine code"):
        jax.block_until_ready(jitted(STIFF))
    assert "no module" in capfd.readouterr().err


def test_the_first_module_has_no_implicit_method():
    scene = udk.library.double_pendulum()
    engine = import_module("udkjax.integrate.compiled_mechanism")
    operation = engine.compile_concrete(scene, udk.analyse(scene), udk.Auto(), udk.Projection()).plan.operation
    assert operation.changes and not operation.leaves
    first, later = (loaded_code.generate(x, 1, 1).written_text for x in (operation.first, operation))
    assert "@take_stages_from_point3(" in later and "@take_stages_from_point3(" not in first
    assert "_slopes(" in later and "_slopes(" not in first
    assert len(first) < 0.8 * len(later)
