"""Fallback steps: where elimination must not trust a pivot, a rank-revealing method on all rows takes its place."""

from typing import Any

import numpy as np

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Lane
from udkjax.native.least_norm import LEAST_NORM
from udkjax.native.manifold import iterate_newton, with_threshold
from udkjax.native.module import Module
from udkjax.native.steps import ROUNDING_PIVOT


def entries(t: Module, f: Function) -> Any:
    """What is done for every entry of D: its row, column, place among the values, and sign."""
    table = Value(f, "@entries", POINTER)
    with f.each(len(t.code.pattern.entries)) as e:
        yield tuple(f.load(table, e * 4 + j, base=INT) for j in range(4))


def write_solve(t: Module):
    """`solve`: x = D^+ right of one lane, with the rows weighted; D is that of R."""
    n, m = t.n, t.m
    table = [x for e in t.code.pattern.entries for x in (e.row, e.column, e.value, e.sign)]
    t.loops.globals.append(f"@entries = private constant [{len(table)} x i64] [{', '.join(f'i64 {x}' for x in table)}]")
    arguments = [(POINTER, "work"), (INT, "lane"), (POINTER, "right"), (POINTER, "x"), (DOUBLE, "tol")]
    f, s = t.function("solve", arguments)
    k, right = f.given["lane"], f.given["right"]
    D, b = (Value(f, f.reserve(DOUBLE, max(c, 1)), POINTER) for c in (m * n, m))
    with f.each(m * n) as i:
        f.store(0.0, D, i)
    length = f.lane(s.length, k)
    with f.each(m) as i:
        f.store(f.load(right, i) * length / t.lane_number(f, "rows", k, i), b, i)
    for row, column, slot, sign in entries(t, f):
        weight = length / t.lane_number(f, "rows", k, row)
        f.store(t.lane_number(f, "R", k, slot) * weight * sign, D, row * n + column)
    rank = f.at(f.given["work"], k + t.places["rank"] * f.width)
    f.call(LEAST_NORM, D, b, f.given["x"], *(f.const(c, INT) for c in (m, n)), f.given["tol"], rank)


def write_fallback(t: Module):
    """What a rank-revealing method on all rows finds, of lanes that fall back on it, one after the other."""
    code, p, n, m, width = t.code, t.places, t.n, t.m, t.plan.width
    slots, number, one = code.pattern.value_count, t.lane_number, lambda f: f.const(1.0, DOUBLE, width)

    def put(f: Function, name: str, k: Value, i: Value, x: Value):
        f.store(x, f.given["work"], (i + p[name]) * width + k)

    def each_lane(f: Function, mask: Value) -> Any:
        marked = f.select(mask, one(f), 0.0)
        right, x = (Value(f, f.reserve(DOUBLE, c), POINTER) for c in (m, n))
        with f.each(width) as k, f.if_(f.lane(marked, k) > 0.5):
            yield k, right, x

    def solved(f: Function, k: Value, right: Value, x: Value, name: str, start: int = 0):
        """`x` of a lane, with D and what else is in R of the state in X."""
        with f.each(m) as i:
            f.store(number(f, name, k, i + start), right, i)
        f.call("solve", f.given["work"], k, right, x, number(f, "fallback_tol", k, 0))

    def root(f: Function, k: Value, i: Value) -> Value:
        return number(f, "R", k, i + (slots + m + n))

    def close_in_position(f: Function, s: Lane, mask: Value):
        """Newton's method in positions, of some lanes."""

        def closer(active: Value):
            t.invoke(f, "equation_terms")
            t.invoke(f, "psi")
            with f.each(t.rowcount) as r:
                t.put(f, "C", r, t.vector(f, "X q", r))
            for k, right, x in each_lane(f, active):
                solved(f, k, right, x, "psi")
                with f.each(n) as i:
                    put(f, "C", k, i, number(f, "X q", k, i) - root(f, k, i) * f.load(x, i))

        iterate_newton(t, f, s, mask, closer)
        t.invoke(f, "equation_terms")

    def close_in_velocity(f: Function, mask: Value):
        """X v, as the constraints allow it, in O v, of some lanes."""
        t.invoke(f, "psi_dot")
        for k, right, x in each_lane(f, mask):
            solved(f, k, right, x, "psi")
            with f.each(n) as i:
                put(f, "O v", k, i, number(f, "X v", k, i) - root(f, k, i) * f.load(x, i))

    # The accelerations of lanes whose pivots were not safe.
    f, s = t.function("accelerate_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    t.invoke(f, "equation_terms")
    for k, right, x in each_lane(f, (s.stepping > 0.5) & (s.fallback > 0.5) & (s.safe < 0.5)):
        solved(f, k, right, x, "R", slots)
        with f.each(n) as i:
            a = f.fma(root(f, k, i), f.load(x, i), number(f, "R", k, i + (slots + m)))
            f.store(a, f.given["out"], i * width + k)
    # The end of a fallback step: Newton's method in position, velocities and accelerations there where the pivots are
    # not safe; and, whether they are or not, what projection leaves of the errors.
    f, s = t.function("finish_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    fallback = (s.stepping > 0.5) & (s.fallback > 0.5)

    close_in_position(f, s, fallback & (s.ok < 0.5))
    due_for_fallback = fallback & (s.ok < 0.5)
    with f.if_(f.any_of(due_for_fallback)):
        close_in_velocity(f, due_for_fallback)
        with f.each(t.rowcount) as r:
            t.put(f, "X v", r, f.select(due_for_fallback, t.vector(f, "O v", r), t.vector(f, "X v", r)))
        t.invoke(f, "accelerations", "C")
        with f.each(t.rowcount) as r:
            t.put(f, "O a", r, f.select(due_for_fallback, t.vector(f, "C", r), t.vector(f, "O a", r)))
        with f.if_(f.any_of(due_for_fallback & (s.safe < 0.5))):
            f.call("accelerate_by_fallback", f.given["work"], t.address(f, "O a"))
    for k, right, x in each_lane(f, fallback):
        for d in ("dq", "dv"):
            with f.each(m) as i:
                f.store(0.0, right, i)
            for row, column, slot, sign in entries(t, f):
                part = number(f, "R", k, slot) * sign * number(f, f"X {d}", k, column) / root(f, k, column)
                f.store(f.load(right, row) + part, right, row)
            f.call("solve", f.given["work"], k, right, x, f.const(np.sqrt(ROUNDING_PIVOT)))
            with f.each(n) as i:
                put(f, f"O {d}", k, i, number(f, f"X {d}", k, i) - root(f, k, i) * f.load(x, i))
    # An output that elimination leaves open.
    f, s = t.function("close_output")
    close_in_position(f, s, s.open > 0.5)
    close_in_velocity(f, s.open > 0.5)
    t.invoke(f, "psi")


def write_fallback_by_loops(t: Module):
    """As `write_fallback`, of a large scene: by elimination of all rows, without those whose pivots are small."""
    f, s = t.function("accelerate_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    t.invoke(f, "fallback_accelerations")
    select_lanes(t, f, (s.stepping > 0.5) & (s.fallback > 0.5) & (s.safe < 0.5), "fallback a", "out")
    f, s = t.function("finish_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    fallback, due_for_fallback = (s.stepping > 0.5) & (s.fallback > 0.5), s.ok < 0.5
    iterate_newton(t, f, s, fallback & due_for_fallback, lambda active: t.invoke(f, "fallback_newton_q"))
    with f.if_(f.any_of(fallback & due_for_fallback)):
        t.invoke(f, "fallback_project_and_accelerate")
        for x in "va":
            select_lanes(t, f, fallback & due_for_fallback, f"fallback {x}", f"O {x}")
    with_threshold(t, f, s, f.const(ROUNDING_PIVOT, DOUBLE, f.width), lambda: t.invoke(f, "fallback_tangent_part"))


def select_lanes(t: Module, f: Function, mask: Value, source: str, to: str):
    """An array of coordinates from another, in some lanes."""
    start = 0 if to == "out" else t.places[to] * f.width
    pointer = f.given["out" if to == "out" else "work"]
    with f.each(t.rowcount) as r:
        place = r * t.plan.vector + start
        old = f.load(pointer, place, t.plan.vector)
        f.store(f.select(mask, t.vector(f, source, r), old), pointer, place, t.plan.vector)
