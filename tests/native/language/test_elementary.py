"""Elementary functions in LLVM IR: their errors, special values, and independence of functions outside the module."""

import math
import re
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.calls import calls_of
from tests.fused import is_fused
from tests.native.language.test_program import ONE, TWO
from udkjax.expressions import Graph, ScalarProgram, trace
from udkjax.native.code import machine, processor
from udkjax.native.gpu.target import ptx
from udkjax.native.language import elementary
from udkjax.native.language.ir import POINTER, Function
from udkjax.native.language.program import write
from udkjax.native.language.text import external_functions, text_of_module

COUNT = 4_000  # arguments per function, which are 80,000 in all
INF, NAN = math.inf, math.nan
RNG = np.random.default_rng(7)
# More digits than float64, except on Windows and on Apple's processors
LONG = np.longdouble
IS_LONG = np.finfo(LONG).eps < 2.0**-60
TWICE_ROUNDED = 0.75  # units in the last place by which errors are larger without fused multiply-add


def signed(x):
    return x * RNG.choice([-1.0, 1.0], len(x))


def between(start, end, count=COUNT // 4):
    return RNG.uniform(start, end, count)


def of_sizes(start, end, count=COUNT // 4):
    """Numbers of all sizes from 2^start to 2^end."""
    return 2.0 ** RNG.uniform(start, end, count)


def all_sizes():
    return signed(RNG.integers(0, 0x7FF << 52, COUNT // 4).view(float))


class Case(NamedTuple):
    exact: Callable
    ulps: float  # maximum error
    arguments: tuple[np.ndarray, ...]


ALL, UNIT = all_sizes(), np.concatenate([between(-1, 1), signed(of_sizes(-60, 0)), signed(1.0 - of_sizes(-53, -1))])
POSITIVE = np.concatenate([of_sizes(-1074, 1024), between(0.5, 2), 1.0 + signed(of_sizes(-52, -1)), np.abs(ALL)])
SMALL = signed(of_sizes(-60, 9))
ODD = np.concatenate([between(-3, 3), SMALL, ALL])
BASES = np.concatenate([of_sizes(-1074, 1024), between(0.5, 2), 1.0 + signed(of_sizes(-40, -1)), of_sizes(-8, 8)])
SPREAD = np.concatenate([between(-1, 1), signed(of_sizes(-1074, 1024)), signed(of_sizes(-4, 4)), signed(of_sizes(-1070, -1000))])
with np.errstate(over="ignore", divide="ignore"):
    EXPONENTS = between(-1076, 1026, len(BASES)) / np.log2(BASES)
    EXPONENTS[-COUNT // 4 :] = between(-100, 100)
DIVISORS = signed(of_sizes(-30, 30, len(SPREAD)))
QUOTIENTS = np.rint(between(-9, 9, len(SPREAD))) * DIVISORS
CASES = {
    "exp": Case(np.exp, 1.0, (np.concatenate([between(-746, 710), between(-1, 1), ODD]),)),
    "exp2": Case(np.exp2, 1.0, (np.concatenate([between(-1076, 1025), between(-1, 1), ODD]),)),
    "expm1": Case(np.expm1, 1.0, (np.concatenate([between(-40, 710), between(-1, 1), ODD]),)),
    "log": Case(np.log, 1.0, (POSITIVE,)),
    "log2": Case(np.log2, 1.0, (POSITIVE,)),
    "log1p": Case(np.log1p, 1.0, (np.concatenate([POSITIVE, between(-1, 1), signed(of_sizes(-60, 0))]),)),
    "sinh": Case(np.sinh, 2.0, (np.concatenate([between(-711, 711), ODD]),)),
    "cosh": Case(np.cosh, 1.5, (np.concatenate([between(-711, 711), ODD]),)),
    "tanh": Case(np.tanh, 1.5, (np.concatenate([between(-25, 25), ODD]),)),
    "asin": Case(np.arcsin, 1.0, (UNIT,)),
    "acos": Case(np.arccos, 1.0, (UNIT,)),
    "atan": Case(np.arctan, 1.0, (ODD,)),
    "atan2": Case(np.arctan2, 1.0, (SPREAD, RNG.permutation(SPREAD))),
    "tan": Case(np.tan, 1.0, (np.concatenate([ODD, between(-1e5, 1e5), np.round(between(-6e5, 6e5)) * (math.pi / 2)]),)),
    "asinh": Case(np.arcsinh, 1.5, (ODD,)),
    "acosh": Case(np.arccosh, 2.0, (np.concatenate([between(1, 3), of_sizes(0, 1023), 1.0 + of_sizes(-52, 0)]),)),
    "atanh": Case(np.arctanh, 1.0, (UNIT,)),
    "cbrt": Case(np.cbrt, 1.0, (np.concatenate([between(-8, 8), signed(of_sizes(-1074, 1023)), ALL]),)),
    "erf": Case(np.vectorize(math.erf), 2.0, (np.concatenate([between(-6, 6), SMALL]),)),
    "erfc": Case(np.vectorize(math.erfc), 4.0, (np.concatenate([between(-6, 26), between(-1, 2)]),)),  # the other's own included
    "pow": Case(np.power, 1.0, (BASES, EXPONENTS)),
    "rem": Case(np.fmod, 0.0, (np.concatenate([SPREAD, QUOTIENTS]), np.concatenate([RNG.permutation(SPREAD), DIVISORS]))),
}
SPECIAL = [0.0, -0.0, 1.0, -1.0, INF, -INF, NAN, 5e-324, -5e-324, 1.7976931348623157e308]
HUGE_ANGLES = {  # and their tangents
    1e22: -1.6287782256068988,
    5.319372648326541e255: -2.133485385753704e18,
    1.7976931348623157e308: -0.004962015874444895,
    -1.0715086071862673e301: 0.16125837995065806,
    1e200: -0.8417321552123704,
    3145728.0: 1.5938973911767604,
    1647099.3291652855: -6.420676210313675e-11,
}


def program(name, width):
    """A function `apply(x, y, out)` on groups of numbers."""
    f = Function("apply", [(POINTER, "x"), (POINTER, "y"), (POINTER, "out"), ("i64", "groups")], width)
    with f.each(f.given["groups"]) as k:
        given = [f.load(f.given[x], k * width, width) for x in ("x", "y")[: len(CASES[name].arguments)]]
        f.store(elementary.call(f, name, *given), f.given["out"], k * width, width)
    return f


@pytest.fixture(scope="module")
def evaluate(code):
    def evaluated(name, width, *arguments):
        count = -(-len(arguments[0]) // width) * width
        x, y = (np.resize(np.asarray(z, float), count) for z in (arguments[0], arguments[-1]))
        out = np.full(count, NAN)
        code(program(name, width))(x, y, out, count // width)
        return out[: len(arguments[0])]

    return evaluated


def errors(found, exact):
    """Errors in units in the last place of the exact result. Results that are not finite must be equal."""
    with np.errstate(over="ignore"):
        rounded = exact.astype(float)
    is_finite = np.isfinite(rounded)
    assert_array_equal(np.isfinite(found), is_finite)
    assert_array_equal(found[~is_finite], rounded[~is_finite])
    return np.abs(found[is_finite].astype(LONG) - exact[is_finite]) / np.spacing(np.abs(rounded[is_finite]))


def exact_results(name):
    with np.errstate(all="ignore"):
        return np.asarray(CASES[name].exact(*(x.astype(LONG) for x in CASES[name].arguments)), LONG)


def test_every_function_has_a_case():
    assert set(CASES) == elementary.FUNCTION_NAMES


@pytest.mark.parametrize("name", CASES)
def test_errors_are_small_for_numbers_of_all_sizes(evaluate, name):
    case = CASES[name]
    found = evaluate(name, 1, *case.arguments)
    most = case.ulps + (0.0 if is_fused() or not case.ulps else TWICE_ROUNDED) + (0.0 if IS_LONG else 1.0)
    assert np.max(errors(found, exact_results(name)), initial=0.0) <= most


def special_arguments(name):
    """All special numbers, or all pairs of them."""
    grid = np.meshgrid(*[SPECIAL] * len(CASES[name].arguments))
    return [x.ravel() for x in grid]


@pytest.mark.parametrize("name", CASES)
def test_lanes_compute_the_bits_of_single_numbers(evaluate, name):
    pairs = zip(CASES[name].arguments, special_arguments(name), strict=True)
    arguments = [np.concatenate([special, x[:: len(x) // 200]]) for x, special in pairs]
    single = evaluate(name, 1, *arguments)
    for width in {2, processor.lanes()}:
        found = evaluate(name, width, *arguments)
        is_number = ~np.isnan(single)
        assert_array_equal(np.isnan(found), ~is_number)
        assert_array_equal(found[is_number].view(np.int64), single[is_number].view(np.int64))


@pytest.mark.parametrize("name", CASES)
def test_special_values_are_those_of_c(evaluate, name):
    arguments = special_arguments(name)
    found = evaluate(name, 1, *arguments)
    with np.errstate(all="ignore"):
        expected = np.asarray(CASES[name].exact(*arguments), float)
    is_number = ~np.isnan(expected)
    assert_array_equal(np.isnan(found), ~is_number)
    is_special = is_number & (~np.isfinite(expected) | (np.abs(expected) < 1e-300) | (expected == np.rint(expected)))
    assert_array_equal(found[is_special], expected[is_special])
    assert_array_equal(np.signbit(found[is_number]), np.signbit(expected[is_number]))


def test_powers_of_integers_and_of_halves_are_exact(evaluate):
    x, y = (z.ravel() for z in np.meshgrid(np.arange(-12.0, 13.0), np.arange(-6.0, 12.0)))
    is_exact = (y >= 0) & (x != 0) | (np.abs(x) == 1)
    assert_array_equal(evaluate("pow", 1, x, y)[is_exact], [float(a) ** b for a, b in zip(x[is_exact], y[is_exact], strict=True)])
    k = np.arange(-1074.0, 1024.0)
    assert_array_equal(evaluate("exp2", 1, k), 2.0**k)
    assert_array_equal(evaluate("log2", 1, 2.0**k), k)
    assert_array_equal(evaluate("cbrt", 1, k**3), k)


def test_tangents_of_huge_angles(evaluate, width):
    x, expected = np.array(list(HUGE_ANGLES)), np.array(list(HUGE_ANGLES.values()))
    assert np.max(np.abs(evaluate("tan", width, x) - expected) / np.spacing(np.abs(expected))) <= 1.0


def test_errors_are_small_without_fused_multiply_add(monkeypatch, evaluate):
    llvm = processor.llvm()
    if not llvm.get_default_triple().startswith("x86_64"):
        pytest.skip("other processors have fused multiply-add only")
    target = llvm.Target.from_default_triple().create_target_machine(
        cpu="x86-64-v2", opt=machine.OPTIMIZATION_LEVEL, reloc="pic", codemodel="small", jit=True
    )
    monkeypatch.setattr(machine, "_target_machine", lambda level: target)
    for name, case in CASES.items():
        found, exact = evaluate(name, 1, *case.arguments), exact_results(name)
        assert np.max(errors(found, exact), initial=0.0) <= case.ulps + TWICE_ROUNDED * (case.ulps > 0), name


@pytest.mark.parametrize("name", [*ONE, *TWO])
def test_no_operation_needs_a_function_outside_of_its_module(name):
    graph, function = Graph(), (ONE | TWO)[name]
    inputs = [graph.input(k, "argument", np.dtype(float)) for k in range(1 + (name in TWO))]
    arrays = [np.array(x, object) for x in inputs]
    outputs = [x for result in trace(function, *[0.5] * len(inputs))(graph, *arrays) for x in result.flat]
    places = [("x", k) for k in range(len(inputs))], [("y", k) for k in range(len(outputs))]
    f = write(ScalarProgram(graph, inputs, outputs), "program", 1, ("x", "y"), *places)
    assert external_functions(text_of_module([f])) == frozenset()


class Everything(udk.ForceElement):
    """A torque on a body that depends on its angle through many elementary functions."""

    def loads(self, t, *frames):
        (body,) = frames
        x = 0.3 * jnp.sin(body.angle)
        y = jnp.exp(x) + jnp.log(x + 2.0) + jnp.tan(x) + jnp.arcsin(x) + jnp.arctan2(x, 1.0 + x) + jnp.tanh(x) + jnp.cosh(x)
        y = y + jnp.power(x + 2.0, 1.0 + x) + jnp.cbrt(x + 2.0) + jax.scipy.special.erf(x) + jnp.arcsinh(x) + jnp.expm1(x)
        return [(0.0, 0.0, 0.2 * y + 0.1 * (x + 5.0) % 0.7 + 0.1 * jnp.log1p(x) * jnp.exp2(x) * jnp.arccos(x))]


@pytest.mark.slow
def test_modules_of_runs_and_derivatives_need_memory_management_alone():
    plain = udk.library.compound_pendulum()
    mechanism = udk.Mechanism(plain.bodies, plain.joints, forces={"all": Everything(plain.body_names)})
    inertia = float(mechanism.bodies["rod"].inertia)

    @jax.jit
    def angle(x):
        return udk.simulate(mechanism.with_parameters({"body.rod.inertia": x}), np.array([0.0, 0.2, 0.4]), rtol=1e-10).q[-1, 0, 2]

    step = 1e-3
    slope = (angle(inertia + step) - angle(inertia - step)) / (2.0 * step)
    curvature = (angle(inertia + step) - 2.0 * angle(inertia) + angle(inertia - step)) / step**2
    with calls_of(machine.split_module) as splits:
        jax.clear_caches()
        assert_allclose([jax.grad(angle)(inertia), jax.jacfwd(angle)(inertia)], slope, rtol=1e-4)
        assert_allclose(jax.jacfwd(jax.jacfwd(angle))(inertia), curvature, rtol=1e-3)
    texts = [call.arguments["text"] for call in splits]
    assert any("@erf_f64" in text for text in texts)
    assert frozenset().union(*map(external_functions, texts)) <= {"malloc", "free", "realloc"}


def test_graphics_cards_round_as_processors_do():
    """PTX neither calls outside functions nor fuses additional products and sums."""
    functions = [program(name, 1) for name in CASES]
    for k, f in enumerate(functions):
        f.name = f"apply{k}"
    text = text_of_module(functions)
    code = ptx(text)
    assert ".extern" not in code and not re.search(r"(add|sub|mul|fma|div|sqrt)\.f64", code)
    assert len(re.findall(r"fma\.rn\.f64", code)) == len(re.findall(r"call double @llvm\.fmuladd", text))


def test_functions_outside_of_a_module_are_named():
    f = Function("apply", [(POINTER, "x"), (POINTER, "y")])
    f.store(f.intrinsic("exp", f.abs(f.load(f.given["x"]))), f.given["y"])
    text = text_of_module([f], declared=["declare ptr @malloc(i64)"])
    assert external_functions(text) == {"malloc", "llvm.exp.f64"}


def test_a_function_is_written_once_for_each_number_of_lanes():
    f, g = program("exp", 2), program("exp", 1)
    with g.each(1):
        elementary.call(g, "exp", 1.0 + elementary.call(g, "exp", g.load(g.given["x"])))
    text = text_of_module([f, g])
    assert text.count("define double @exp_f64(") == text.count("define <2 x double> @exp_v2f64(") == 1
