"""Each operation of the layer above LLVM IR does what its docstring says, for one state and for lanes of states."""

import operator

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.fused import is_fused
from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, literal

NUMBERS = np.array([-2.5, -1.0, -0.0, 0.0, 0.25, 1.0, 3.75, 1e300, -np.inf, np.inf, np.nan, 5e-324])


def binary(code, width, write, x, y, wholes=False):
    """The results of `write(f, a, b)` for pairs of numbers, `width` at a time."""
    f = Function("pairs", [(POINTER, "x"), (POINTER, "y"), (POINTER, "out")], width)
    base = INT if wholes else DOUBLE
    a, b = (f.load(f.given[name], 0, width, base) for name in "xy")
    found = write(f, a, b)
    f.store(found if found.base == base else f.like(found, base, width), f.given["out"], 0, width, base)
    run, out = code(f), []
    for k in range(0, len(x), width):
        kind = np.int64 if wholes else float
        parts = [np.resize(np.asarray(z[k : k + width], kind), width) for z in (x, y)]
        some = np.zeros(width, kind)
        run(*parts, some)
        out.append(some[: len(x) - k])
    return np.concatenate(out)


def pairs():
    return (z.ravel() for z in np.meshgrid(NUMBERS, NUMBERS))


@pytest.mark.parametrize("name", ["add", "sub", "mul", "truediv", "lt", "le", "gt", "ge"])
def test_operators_of_numbers_are_those_of_float64(code, width, name):
    x, y = pairs()
    with np.errstate(all="ignore"):
        expected = getattr(operator, name)(x, y)
    assert_array_equal(binary(code, width, lambda f, a, b: getattr(operator, name)(a, b), x, y), expected)


def test_what_is_not_a_number_is_unlike_everything(code, width):
    x, y = pairs()
    assert_array_equal(binary(code, width, lambda f, a, b: a.is_(b), x, y), x == y)
    assert_array_equal(binary(code, width, lambda f, a, b: a.is_not(b), x, y), x != y)
    assert_array_equal(binary(code, width, lambda f, a, b: f.is_finite(a), x, y), np.isfinite(x))


@pytest.mark.parametrize("name", ["add", "sub", "mul", "lt", "le", "gt", "ge", "and_", "or_"])
def test_operators_of_whole_numbers(code, width, name):
    x, y = (z.ravel() for z in np.meshgrid(*[np.array([-7, -1, 0, 1, 2, 12, 2**40])] * 2))
    expected = getattr(operator, name)(x, y)
    assert_array_equal(binary(code, width, lambda f, a, b: getattr(operator, name)(a, b), x, y, True), expected)


def test_whole_numbers_are_divided_towards_zero(code):
    x, y = np.array([7, -7, 7, -7, 6]), np.array([2, 2, -2, -2, 3])
    assert_array_equal(binary(code, 1, lambda f, a, b: f.arithmetic("div", a, b), x, y, True), [3, -3, -3, 3, 2])


def test_numbers_stand_on_either_side(code, width):
    x = NUMBERS
    with np.errstate(all="ignore"):
        for write, expected in (
            (lambda f, a, b: 2.0 - a, 2.0 - x),
            (lambda f, a, b: a - 2.0, x - 2.0),
            (lambda f, a, b: 1.0 / a, 1.0 / x),
            (lambda f, a, b: a / 4, x / 4.0),
            (lambda f, a, b: 3 * a + 1, 3.0 * x + 1.0),
            (lambda f, a, b: -a, -x),
        ):
            found = binary(code, width, write, x, x)
            assert_array_equal(found, expected)
            assert_array_equal(np.signbit(found[~np.isnan(found)]), np.signbit(expected[~np.isnan(expected)]))


@pytest.mark.parametrize("number", [0.0, -0.0, 0.1, -1e-310, np.inf, -np.inf, np.nan, 1e22])
def test_a_number_is_written_to_its_last_bit(code, number):
    found = binary(code, 1, lambda f, a, b: f.const(number), np.zeros(1), np.zeros(1))
    assert found.tobytes() == np.array([number]).tobytes()
    assert literal(True, BOOL) == "true" and literal(-3, INT) == "-3"


def test_the_larger_is_the_second_where_one_is_no_number(code, width):
    """With this order of arguments a running maximum ignores NaN."""
    x, y = pairs()
    assert_array_equal(binary(code, width, lambda f, a, b: f.max(a, b), x, y), np.where(x > y, x, y))
    assert_array_equal(binary(code, width, lambda f, a, b: f.min(a, b), x, y), np.where(x < y, x, y))
    assert binary(code, 1, lambda f, a, b: f.max(a, b), np.array([np.nan]), np.array([1.0])) == 1.0


def test_conditions_are_combined(code, width):
    x, y = pairs()
    for write, expected in (
        (lambda f, a, b: (a < 1.0) & (b < 1.0), (x < 1.0) & (y < 1.0)),
        (lambda f, a, b: (a < 1.0) | (b < 1.0), (x < 1.0) | (y < 1.0)),
        (lambda f, a, b: ~(a < 1.0), ~(x < 1.0)),
        (lambda f, a, b: f.select(a < b, a, 7.0), np.where(x < y, x, 7.0)),
        (lambda f, a, b: f.select(a < b, 1.0, 2.0), np.where(x < y, 1.0, 2.0)),
        (lambda f, a, b: f.select(f.const(True, BOOL), a, b), x),
    ):
        assert_array_equal(binary(code, width, write, x, y), expected)


def test_a_number_is_repeated_in_all_lanes_of_which_there_may_be_one(code, width):
    x = np.linspace(0.1, 3.0, 11)
    assert_array_equal(binary(code, width, lambda f, a, b: a * f.repeat(f.const(3.0, DOUBLE, 1), width), x, x), 3.0 * x)


def test_intrinsics_are_called_lane_by_lane(code, width):
    x = np.linspace(0.1, 3.0, 11)
    for name, expected in (("sqrt", np.sqrt(x)), ("floor", np.floor(x)), ("fabs", x)):
        assert_array_equal(
            binary(code, width, lambda f, a, b, name=name: f.intrinsic(name, -a if name == "fabs" else a), x, x), expected
        )
    found = binary(code, width, lambda f, a, b: f.fma(a, b, -1.0), 1 + np.spacing(1.0) * np.arange(5), np.full(5, 1 - 2**-52))
    assert_array_equal(found != 0.0, [True, is_fused(), True, True, True])  # fused, the product is not rounded


def test_lanes_are_told_apart_and_taken_together(code, width):
    f = Function("together", [(POINTER, "x"), (POINTER, "out")], width)
    x, out = f.load(f.given["x"], 0, width), f.given["out"]
    one = f.const(1.0)
    for k, mask in enumerate((f.any_of(x > 2.0), f.all_of(x > 2.0))):
        f.store(f.select(mask, one, 0.0), out, k)
    f.store(f.reduce("fmax", x), out, 2)
    with f.each(width) as k:
        f.store(f.lane(x, k), out, k + 3)
        f.store(f.select(f.only(k), x, 0.0), out, k * width + (3 + width), width)
    run = code(f)
    for values in ([1.0] * width, [3.0] * width, [3.0] + [1.0] * (width - 1), [1.0] * (width - 1) + [9.0]):
        found, x = np.full(3 + width + width**2, np.nan), np.array(values)
        run(x, found)
        assert_array_equal(found, [(x > 2).any(), (x > 2).all(), x.max(), *x, *np.diag(x).ravel()])


def test_one_lane_is_set_where_a_mask_says(code, width):
    f = Function("some", [(POINTER, "x"), (POINTER, "out")], width)
    x = f.load(f.given["x"], 0, width)
    kept = f.variable(5.0)
    kept.where(x > 0.0, x * 2.0)
    f.store(kept.value, f.given["out"], 0, width)
    x, out = np.arange(width) - 0.5, np.zeros(width)
    code(f)(x, out)
    assert_array_equal(out, np.where(x > 0, 2 * x, 5.0))


def test_loops_and_branches(code):
    """Sums over pairs i < j in [0, n) of different parity; and the number of Collatz steps of n."""
    f = Function("loops", [(POINTER, "out"), (INT, "n")])
    n, pairs_, steps = f.given["n"], f.variable(0, INT), f.variable(0, INT)
    with f.each(n) as i, f.each(n, i + 1) as j, f.if_(f.logic("and", i + j, 1).is_(1)):
        pairs_.value = pairs_.value + i * 100 + j
    m = f.variable(n, INT)
    with f.while_(lambda: m.value > 1):
        even = f.logic("and", m.value, 1).is_(0)

        def half():
            m.value = f.arithmetic("div", m.value, 2)

        def threefold():
            m.value = m.value * 3 + 1

        f.choose(even, half, threefold)
        steps.value = steps.value + 1
    f.store(pairs_.value, f.given["out"], 0, base=INT)
    f.store(steps.value, f.given["out"], 1, base=INT)
    run = code(f)
    for n, count in ((0, 0), (1, 0), (6, 8), (27, 111)):
        out = np.zeros(2, np.int64)
        run(out, n)
        assert_array_equal(out, [sum(i * 100 + j for i in range(n) for j in range(i + 1, n) if (i + j) % 2), count])


def test_functions_call_one_another_with_memory_of_their_own(code):
    """Memory reserved within a loop is reserved once: a thousand iterations take no more stack than one."""
    inner = Function("inner", [(POINTER, "x"), (INT, "k")])
    place = inner.reserve(DOUBLE, 100_000)
    inner.store(1.0, inner.at(place, 99_999))
    inner.store(
        inner.load(inner.given["x"], inner.given["k"]) + inner.load(inner.at(place, 99_999)), inner.given["x"], inner.given["k"]
    )
    outer = Function("outer", [(POINTER, "x")])
    with outer.each(1000) as _, outer.each(3) as k:
        outer.variable(0.0)
        outer.call("inner", outer.given["x"], k)
    x = np.array([1.0, 2.0, 3.0])
    code(inner, outer)(x)
    assert_array_equal(x, [1001.0, 1002.0, 1003.0])


def test_types_that_do_not_go_together_are_refused():
    f = Function("wrong", [(INT, "k"), (DOUBLE, "x")], 4)
    with pytest.raises(TypeError, match="double for i64"):
        f.like(f.given["x"], INT, 1)
    with pytest.raises(TypeError, match="4 lanes for 2"):
        f.like(f.const(1.0, DOUBLE, 4), DOUBLE, 2)
