"""Fallback steps: where elimination must not trust a pivot, a rank-revealing method on all rows takes its place.

It has two functions of `work`, for the lanes that are `wanted`, at the state in X:

    fallback                 accelerations a, and q and v after a Newton step each, in arrays of their own
    fallback_tangent_part    what is within the manifold of X dq and X dv, in arrays of their own

For small scenes the method is the pseudoinverse by singular values (least_norm.py), lane by lane; for large ones elimination
of all rows, without those that depend on others, which near singular configurations has about half as many digits.
"""

from collections.abc import Iterator

import numpy as np

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Lane
from udkjax.native.least_norm import LEAST_NORM, least_norm
from udkjax.native.manifold import iterate_newton, with_threshold
from udkjax.native.module import Module
from udkjax.native.steps import ROUNDING_PIVOT


def write_fallback(t: Module):
    """Write what a fallback step does besides: accelerations, the end of a step, outputs that elimination leaves open."""
    (_write_singular_values if t.written_out else _write_elimination)(t)

    def invoke(f: Function, s: Lane, mask: Value, name: str = "fallback"):
        s.wanted = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
        t.invoke(f, name)

    def close_position(f: Function, s: Lane, mask: Value):
        def closer(active: Value):
            invoke(f, s, active)
            t.copy(f, "fallback q", "C")

        iterate_newton(t, f, s, mask, closer)

    # The accelerations of lanes whose pivots were not safe.
    f, s = t.function("accelerate_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    mask = (s.stepping > 0.5) & (s.fallback > 0.5) & (s.safe < 0.5)
    invoke(f, s, mask)
    t.copy(f, "fallback a", "out", mask)
    # The end of a fallback step: Newton's method in position, velocities and accelerations there where the pivots are
    # not safe; and, whether they are or not, what projection leaves of the errors.
    f, s = t.function("finish_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    fallback = (s.stepping > 0.5) & (s.fallback > 0.5)
    unsafe = fallback & (s.ok < 0.5)
    close_position(f, s, unsafe)
    with f.if_(f.any_of(unsafe)):
        invoke(f, s, unsafe)
        for to in ("X v", "O v"):
            t.copy(f, "fallback v", to, unsafe)
        invoke(f, s, unsafe)
        t.copy(f, "fallback a", "O a", unsafe)
    invoke(f, s, fallback, "fallback_tangent_part")
    for x in ("dq", "dv"):
        t.copy(f, f"fallback {x}", f"O {x}", fallback)
    # An output that elimination leaves open.
    f, s = t.function("close_output")
    close_position(f, s, s.open > 0.5)
    invoke(f, s, s.open > 0.5)
    t.copy(f, "fallback v", "O v", s.open > 0.5)
    t.invoke(f, "psi")


def _write_elimination(t: Module):
    """Write `fallback` and `fallback_tangent_part` by elimination, with constants of their own: another threshold."""
    every = t.code.with_all_rows
    at = t.arrays | {x: ("work", t.places[f"fallback {x}"]) for x in (*every.scratch, "constants", "a")}
    at |= {f"{x}1": ("work", t.places[f"fallback {x}"]) for x in ("q", "v", "dq", "dv")}
    at |= dict.fromkeys(("safe", "distance"), ("work", t.places["rank"]))
    t.loops.write(every.corrections_and_accelerations, "fallback", ("work", "out"), at)
    t.loops.write(every.tangent_part, "tangent_part_of_all_rows", ("work", "out"), at)
    t.write_prologue("fallback_prologue", None)
    f, _ = t.function("fallback_tangent_part", [(POINTER, "work"), (POINTER, "out")])
    place = t.places["fallback constants"] + t.code.drop_tol_index
    threshold = f.const(ROUNDING_PIVOT, DOUBLE, f.width)
    with_threshold(f, place, threshold, lambda: t.invoke(f, "tangent_part_of_all_rows"))


def _write_singular_values(t: Module):
    """Write `fallback` and `fallback_tangent_part` by singular values."""
    n, m = t.n, t.m
    t.functions.append(least_norm())
    rows, columns, places, factors = t.code.psi_q_entries
    entries = ", ".join(f"i64 {x}" for entry in zip(rows, columns, places, strict=True) for x in entry)
    t.loops.globals.append(f"@entries = private constant [{3 * len(rows)} x i64] [{entries}]")
    numbers = ", ".join(f"double {float(x)}" for x in factors)
    t.loops.globals.append(f"@factors = private constant [{len(rows)} x double] [{numbers}]")

    def each_lane(f: Function, s: Lane) -> Iterator[Value]:
        t.invoke(f, "rows_and_loads")
        with f.each(f.width) as k, f.if_(f.lane(s.wanted, k) > 0.5):
            yield k

    def each_entry(f: Function, k: Value) -> Iterator[tuple[Value, Value, Value]]:
        """The row, the column and the value of each entry of Psi_q."""
        with f.each(len(rows)) as e:
            row, column, place = (f.load(Value(f, "@entries", POINTER), e * 3 + j, base=INT) for j in range(3))
            value = t.lane_number(f, "psi_q", k, place) * f.load(Value(f, "@factors", POINTER), e)
            yield row, column, value

    def solve(f: Function, s: Lane, k: Value, right: Value, count: int, tol: Value, x: Value):
        """Solve D y = W right for so many right-hand sides, with D = W Psi_q M^(-1/2)."""
        D = Value(f, f.reserve(DOUBLE, m * n), POINTER)
        with f.each(m * n) as i:
            f.store(0.0, D, i)
        length = f.lane(s.length, k)
        for row, column, value in each_entry(f, k):
            weight = length / t.lane_number(f, "rows", k, row)
            f.store(value * weight * t.lane_number(f, "root", k, column), D, row * n + column)
        with f.each(m) as i:
            weight = length / t.lane_number(f, "rows", k, i)
            with f.each(count) as j:
                place = i * count + j
                f.store(f.load(right, place) * weight, right, place)
        rank = f.at(f.given["work"], k + t.places["rank"] * f.width)
        f.call(LEAST_NORM, D, right, x, *(f.const(c, INT) for c in (m, n, count)), tol, rank)

    def put(f: Function, name: str, k: Value, i: Value, x: Value):
        f.store(x, f.given["work"], (i + t.places[name]) * f.width + k)

    f, s = t.function("fallback", [(POINTER, "work"), (POINTER, "out")])
    right, x = (Value(f, f.reserve(DOUBLE, 3 * c), POINTER) for c in (m, n))
    for k in each_lane(f, s):
        with f.each(m) as i:
            for j, (name, start) in enumerate((("terms", n), ("psi", 0), ("psi_dot", 0))):
                f.store(t.lane_number(f, name, k, i + start), right, i * 3 + j)
        solve(f, s, k, right, 3, t.lane_number(f, "fallback_tol", k, 0), x)
        with f.each(n) as i:
            root = t.lane_number(f, "root", k, i)
            for j, (name, start, sign) in enumerate((("a", "terms", 1.0), ("q", "X q", -1.0), ("v", "X v", -1.0))):
                part = root * f.load(x, i * 3 + j) * sign
                put(f, f"fallback {name}", k, i, t.lane_number(f, start, k, i) + part)
    f, s = t.function("fallback_tangent_part", [(POINTER, "work"), (POINTER, "out")])
    right, x = (Value(f, f.reserve(DOUBLE, 2 * c), POINTER) for c in (m, n))
    for k in each_lane(f, s):
        with f.each(2 * m) as i:
            f.store(0.0, right, i)
        for row, column, value in each_entry(f, k):
            for j, name in enumerate(("X dq", "X dv")):
                place = row * 2 + j
                f.store(f.fma(value, t.lane_number(f, name, k, column), f.load(right, place)), right, place)
        solve(f, s, k, right, 2, f.const(np.sqrt(ROUNDING_PIVOT)), x)
        with f.each(n) as i:
            root = t.lane_number(f, "root", k, i)
            for j, name in enumerate(("dq", "dv")):
                put(f, f"fallback {name}", k, i, t.lane_number(f, f"X {name}", k, i) - root * f.load(x, i * 2 + j))
