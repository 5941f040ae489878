"""Programs for other devices than the CPU: everything that machine code computes is computed by the host there.

No such device is needed: the programs are only written.
"""

import ctypes
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import mlir

import udkjax as udk
from tests.choices import fast, needs_deferred
from udkjax.native import primitive
from udkjax.native.code import machine
from udkjax.native.host import host_function, host_program
from udkjax.native.host.host_function import call_seldom
from udkjax.programs.deferred import deferred

TS = np.array([0.0, 0.1, 0.2])
PENDULUM, LINKAGE = udk.library.compound_pendulum(), udk.library.four_bar(np.pi / 3)
KNOWN = udk.analyse(PENDULUM)
FLOOR = udk.Contact("ball", restitution=0.8, name="floor")
BALL = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0))})
FALL = np.linspace(0.0, 0.6, 4)


def run(x, **settings):
    mechanism = PENDULUM.with_parameters({"body.rod.inertia": x})
    given = {"analysis": KNOWN, "throw": False} | settings
    return udk.simulate(mechanism, TS, udk.State(PENDULUM.q0, PENDULUM.v0), **given).q[-1, 0, 2]


def closed(x):
    return udk.assemble(LINKAGE.with_parameters({"body.crank.angle": x})).q[1, 2]


def moved(x):
    mechanism = LINKAGE.with_parameters({"gravity": [0.0, x]})
    return udk.kinematics(mechanism, "body.crank.angle", np.linspace(1.0, 1.2, 3)).q[-1, 1, 2]


def bounced(x):
    return udk.simulate(BALL.with_parameters({"body.ball.position[1]": x}), FALL, events=FLOOR, throw=False).q[-1, 0, 1]


def rested(x):
    return udk.equilibrium(PENDULUM.with_parameters({"body.rod.mass": x})).q[0, 2]


def turned(x):
    mechanism = LINKAGE.with_parameters({"pin.D": LINKAGE.parameters()["pin.D"] * x})
    return udk.kinematics(mechanism, "body.crank.angle", np.linspace(1.0, 1.2, 3)).q[-1, 1, 2]


def _eigenvalues(x):
    return jnp.linalg.svd(x * jnp.eye(2), compute_uv=False)


def _root(x):
    return jax.lax.while_loop(lambda r: r**2 > 1.1 * x, lambda r: 0.5 * (r + x / r), x)


DENSE = [udk.SVD(), udk.Householder(), udk.Greville()]
PROGRAMS = {
    "run": run,
    "batch of runs": jax.vmap(lambda k: run(0.3 + 0.1 * k)),
    "forward mode": lambda x: jax.jvp(run, (x,), (1.0,)),
    "second order": jax.jacfwd(jax.jacfwd(run)),
    "reverse mode": jax.grad(run),
    **{f"run by {type(method).__name__}": lambda x, method=method: run(x, method=method) for method in DENSE},
    "events": bounced,
    "closing": closed,
    "closing, forward mode": jax.jacfwd(closed),
    "closing, reverse mode": jax.grad(closed),
    "rarely reached": lambda x: call_seldom(_eigenvalues, x),
}
ON_HOST = [name for name in PROGRAMS if name != "rarely reached"]
# Derivatives of higher order, and those of solves, need the values of the order below, too: these tell what is undefined.
EXPECTED = {"run": 1, "batch of runs": 1, "forward mode": 1, "second order": 2, "reverse mode": 2, "rarely reached": 1}


def given(name):
    return jnp.arange(4.0) if name == "batch of runs" else jnp.asarray(0.35)


def targets(text):
    """The names of the host operations in a program."""
    return re.findall(r"custom_call @(udkjax_\w+)", text)


@pytest.mark.parametrize(
    "name",
    [
        *fast(set(ON_HOST) - {"second order", "run by SVD", "run by Householder", "reverse mode"}, ON_HOST),
        pytest.param("rarely reached", marks=needs_deferred),
    ],
)
def test_the_host_computes_for_a_graphics_card(name):
    """There are as many operations as on the CPU, with handlers that copy, and no other integrator is used."""
    traced = jax.jit(PROGRAMS[name]).trace(given(name))
    cpu, card = (traced.lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "cuda"))
    assert targets(cpu) and len(targets(card)) == len(targets(cpu)) and all(x.endswith("_copied") for x in targets(card))
    assert len(targets(card)) == EXPECTED.get(name, len(targets(card)))
    assert card.count("stablehlo.while") <= cpu.count("stablehlo.while")
    assert not name.startswith("run") or "stablehlo.while" not in card


SOLVES = {  # with the numbers of calls: the scales, the assembly, the solve, and its derivative
    "kinematics": (moved, 3),
    "kinematics, reverse mode": (jax.grad(turned), 4),
    "equilibrium": (rested, 3),
    "equilibrium, forward mode": (jax.jacfwd(rested), 4),
    "equilibrium, reverse mode": (jax.grad(rested), 4),
    "batch of equilibria": (lambda x: jax.vmap(rested)(x * jnp.arange(1.0, 4.0)), 3),
    "events, reverse mode": (jax.grad(bounced), 7),
    "modes": (lambda x: udk.modes(PENDULUM.with_parameters({"body.rod.mass": x})).omega2, 4),
}
FAST = {"kinematics", "equilibrium"}


@needs_deferred
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x not in FAST)) for x in SOLVES])
def test_a_solve_for_a_graphics_card_is_one_call(name):
    """There are no loops or factorizations on the card. On the CPU the solve is a part of the program."""
    solve, calls = SOLVES[name]
    traced = jax.jit(solve).trace(jnp.asarray(0.35))
    cpu, card = (traced.lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "cuda"))
    assert "stablehlo.while" in cpu and "lapack" in cpu
    assert "stablehlo.while" not in card and "cusolver" not in card
    assert len(targets(card)) == calls and all(x.endswith("_copied") for x in targets(card))


@needs_deferred
@pytest.mark.parametrize(
    ("solve", "most", "word"), [(_eigenvalues, host_program.FEW_MATRICES, "cusolver"), (_root, host_program.FEW_NUMBERS, "while")]
)
def test_large_batches_stay_on_the_card(solve, most, word):
    """Batches of matrices, and of loops that all members run together."""
    for members, is_called in ((most, True), (most + 1, False)):
        card = jax.jit(jax.vmap(deferred(solve))).trace(jnp.ones(members)).lower(lowering_platforms=("cuda",)).as_text()
        assert bool(targets(card)) == is_called and (word in card) != is_called


@needs_deferred
def test_batches_of_loops_one_after_another_do_not():
    one_by_one = deferred(lambda xs: jax.lax.map(_root, xs))
    card = jax.jit(one_by_one).trace(jnp.ones(host_program.FEW_NUMBERS + 1)).lower(lowering_platforms=("cuda",)).as_text()
    assert len(targets(card)) == 1 and "while" not in card


@pytest.mark.parametrize(
    "name", ["run", "reverse mode", "closing", *(pytest.param(x, marks=needs_deferred) for x in ("rarely reached", "deferred"))]
)
def test_programs_are_exported_for_graphics_cards(name):
    """A program for both platforms also runs here."""
    program, x = jax.jit(deferred(_eigenvalues) if name == "deferred" else PROGRAMS[name]), given(name)
    names = targets(program.trace(x).lower(lowering_platforms=("cpu", "cuda")).as_text())
    assert {x.endswith("_copied") for x in names} == {True, False}
    checks = [jax.export.DisabledSafetyCheck.custom_call(x) for x in names]
    exported = jax.export.export(program, platforms=("cpu", "cuda"), disabled_checks=checks)(x)
    assert exported.platforms == ("cpu", "cuda")
    np.testing.assert_array_equal(exported.call(x), program(x))


def test_other_devices_call_the_host_by_jax():
    """The CPU stands in for such a device, for which JAX cannot write calls of Python unless it is present."""
    expected = [np.asarray(jax.jit(PROGRAMS[name])(given(name))) for name in ("run", "reverse mode", "rarely reached")]
    for p, module in LOWERED:
        mlir.register_lowering(p, mlir.lower_fun(module._lower_for_others), platform="cpu")
    jax.clear_caches()
    try:
        for name, known in zip(("run", "reverse mode", "rarely reached"), expected, strict=True):
            np.testing.assert_array_equal(jax.jit(PROGRAMS[name])(given(name)), known)
    finally:
        for p, module in LOWERED:
            mlir.register_lowering(p, mlir.lower_fun(module._lower), platform="cpu")
        jax.clear_caches()


LOWERED = ((primitive.native_p, primitive), (host_function.host_p, host_function))


def test_code_on_windows_finds_the_function_that_probes_the_stack(monkeypatch):
    """On Windows, LLVM has functions with long frames call `__chkstk`, which is part of the system."""
    calls = []
    probe = ctypes.CFUNCTYPE(None)(lambda: calls.append(1))
    monkeypatch.setattr(ctypes, "WinDLL", lambda name: SimpleNamespace(__chkstk=probe), raising=False)
    text = "declare void @__chkstk()\ndefine void @f() {\n  call void @__chkstk()\n  ret void\n}\n"
    code = machine.compile_module(text)
    machine._linker()  # as on this system
    monkeypatch.setattr(machine.sys, "platform", "win32")
    found = machine.Library([code], ["f"])
    machine.function(found["f"])()
    assert calls == [1]
