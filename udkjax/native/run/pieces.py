"""Steps that leave a piece of the state space in which the motion is smooth (one cubic of a cam's profile)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Value, Variable
from udkjax.native.module.module import Module
from udkjax.native.module.steps import (
    ACROSS_EDGE,
    ACROSS_PIECE,
    AIM_ACROSS,
    AIM_BEFORE,
    AIM_BEYOND,
    EDGE_STEP,
    FACTORS,
    NEAR_END_FRACTION,
    NEAR_ZERO_SHARE,
    NEGLIGIBLE_LOAD,
    PIECE_TRIES,
)
from udkjax.native.run.piece_ends import interpolate_step, locate_end, moves_by_tolerance
from udkjax.native.run.runge_kutta import stage_state


class StepDecision(NamedTuple):
    """Decisions about a step that may end in another piece, each as a mask of lanes."""

    stepping: Value  # the lane takes a step
    is_accurate: Value  # its error is within its tolerance
    leaves: Value  # the step ends in another piece
    repeats: Value  # the step is repeated since it ends in another piece
    shortens: Value  # the step is repeated since one of its stages is in another piece
    turns: Value  # the load of a rolling edge has another sign at the end than at the beginning


def write_end_piece(module: Module):
    """Write `end_piece(work)`: decide to accept or to repeat a step that may end in another piece, in lanes that are `again`.

    A step that ends in another piece is repeated to end just before the end of its piece. A tiny step then crosses the end, and
    the run begins anew: the accelerations of all points of an interpolation must belong to one piece. So must those of all stages
    of a step, since their derivatives jump: a step that ends in its piece, but has a stage near its end in another piece, is
    repeated to end earlier. If states are projected, a jump that follows from constraints may remain between stages: projection
    makes the derivatives of states right.
    """
    end = _EndOfPiece(module)
    end.keep_pieces()
    strays = end.strays()
    end.find_pieces_of_end()
    end.decide(strays)


class _EndOfPiece:
    """Writer of the function `end_piece`."""

    def __init__(self, module: Module):
        self._module, (f, s) = module, module.function("end_piece")
        self._f, self._s = f, s
        self._first_edge = module.pieces - module.edges
        self._goes_across, per_unit = s.aim.is_(float(AIM_ACROSS)), module.entry(f, "inverse unit", f.const(0, INT))
        self._loaded = s.tolerance * NEGLIGIBLE_LOAD * s.omega / ((s.t1 - s.point3_t) * per_unit)  # (m/s^2)

    # --- the pieces at a state

    def _look(self):
        module, s = self._module, self._s
        if module.edges:
            distance, safe = s.distance, s.safe
            module.friction.settle(self._f, "piece a")
            s.distance, s.safe = distance, safe
        module.invoke(self._f, "pieces")

    def _go_to(self, time: Value, state: Callable[[Value], tuple[Value, Value]]):
        f = self._f
        setattr(self._s, "state t", time)
        with f.each(self._module.rowcount) as r:
            for x, value in zip("qv", state(r), strict=True):
                self._module.put(f, f"state {x}", r, value)

    def _edge(self, k: Value) -> Value:
        """Return the load of edge k at the state for which `pieces` was last computed."""
        return self._module.entry(self._f, "pieces", k + self._first_edge)

    def _any_edge(self, meets: Callable[[Value, Value], Value]) -> Value:
        f, module = self._f, self._module
        found = f.variable(f.const(False, BOOL, f.width), BOOL)
        if not module.edges:
            return found.value
        with f.each(module.edges) as k:
            found.value = found.value | meets(self._edge(k), module.entry(f, "edges before", k))
        return found.value

    def _turned(self) -> Value:
        """Return the lanes in which the load of an edge has another sign than at the start of the step.

        A load that was nearly zero at the start is ignored, except in a step across the end of a piece.
        """

        def differs(current: Value, previous: Value) -> Value:
            now, before = current > 0.0, previous > 0.0
            return ((now & ~before) | (before & ~now)) & ((self._f.abs(previous) > self._loaded) | self._goes_across)

        return self._any_edge(differs)

    def _least_load(self) -> Value:
        """Return the smallest ratio of the load of an edge to its load at the start of the step.

        Edges whose loads were nearly zero at the start are ignored; the result is infinite if no edge remains.
        """
        f, module = self._f, self._module
        inf = f.const(np.inf, DOUBLE, f.width)
        least = f.variable(inf)
        if module.edges:
            with f.each(module.edges) as k:
                current, previous = self._edge(k), module.entry(f, "edges before", k)
                least.value = f.min(least.value, f.select(f.abs(previous) > self._loaded, current / previous, inf))
        return least.value

    def _moved(self) -> Value:
        """Return the lanes in which the state is in another piece than the start of the step."""
        f, module = self._f, self._module
        differs = f.variable(self._turned(), BOOL)
        with f.each(self._first_edge) as k:
            current, previous = (module.entry(f, x, k) for x in ("pieces", "pieces before"))
            differs.value = differs.value | current.is_not(previous)
        return differs.value

    # --- the parts of the function

    def keep_pieces(self):
        """Write code that saves the positions and edge loads at the end of the step, and finds the pieces at its start."""
        f, module = self._f, self._module
        with f.each(module.rowcount) as r:
            module.put(f, "corrected q", r, module.vector(f, "state q", r))
        if module.edges:
            module.invoke(f, "pieces")  # the loads at the end of the step have settled last
            with f.each(module.edges) as k:
                module.put_entry(f, "edges", k, self._edge(k))
        if self._first_edge:
            self._go_to(self._s.point3_t, lambda r: (module.vector(f, "point3 q", r), module.vector(f, "point3 v", r)))
            module.invoke(f, "pieces")
            with f.each(self._first_edge) as k:
                module.put_entry(f, "pieces before", k, module.entry(f, "pieces", k))

    def strays(self) -> Variable:
        """Write code that finds the lanes in which a stage near the end of the step is in another piece; return their mask."""
        f, s, module = self._f, self._s, self._module
        strays = f.variable(f.const(False, BOOL, f.width), BOOL)

        def look_at_last_stages(lanes: Value):
            for i in np.flatnonzero(module.method.nodes[: module.method.stages] > 1 - NEAR_END_FRACTION).tolist():
                stage_state(module, f, s, i)
                self._look()
                strays.value = strays.value | (self._moved() & lanes)

        if module.edges:
            is_near = self._any_edge(lambda current, previous: f.abs(current) < f.abs(previous) * NEAR_ZERO_SHARE)
            lanes = (s.again > 0.5) & (is_near | f.const(self._first_edge > 0, BOOL, f.width))
            with f.if_(f.any_of(lanes)):
                look_at_last_stages(lanes)
        elif not module.plan.projected or module.code.has_piecewise_loads:
            look_at_last_stages(s.again > 0.5)
        return strays

    def find_pieces_of_end(self):
        """Write code that finds the pieces at the end of the step; the loads of edges are those that were saved."""
        f, module = self._f, self._module
        self._go_to(self._s.t1, lambda r: (module.vector(f, "corrected q", r), module.vector(f, "result v", r)))
        if self._first_edge:
            module.invoke(f, "pieces")
        if module.edges:
            with f.each(module.edges) as k:
                module.put_entry(f, "pieces", k + self._first_edge, module.entry(f, "edges", k))

    def decide(self, strays: Variable):
        """Write code that locates the end of the piece, and decides where the next step ends.

        `strays`: the lanes in which a stage near the end of the step is in another piece.
        """
        f, s, module = self._f, self._s, self._module
        stepping, step = s.again > 0.5, s.t1 - s.point3_t
        # The polynomial of a step is no motion where its error is so large that the controller shortens it as far as it may.
        is_motion = s.error < FACTORS.shrink**-module.method.order
        can_leave = stepping & (s.begin < 0.5) & is_motion & (self._goes_across | moves_by_tolerance(module, f, s))
        turns = self._turned()
        leaves = can_leave & self._moved()
        again = s.aim.is_not(float(AIM_ACROSS)) & (s.tries < float(PIECE_TRIES))

        def look_at(share: Value) -> tuple[Value, Value]:
            self._go_to(f.fma(share, step, s.point3_t), lambda r: interpolate_step(module, f, share, step, r))
            self._look()
            return self._moved(), self._least_load()

        share = locate_end(f, leaves & again, self._least_load(), look_at)
        setattr(s, "state t", s.t1)
        with f.each(module.rowcount) as r:
            module.put(f, "state q", r, module.vector(f, "corrected q", r))
            module.put(f, "state v", r, module.vector(f, "result v", r))
        aim, is_accurate = s.aim, s.error < 1.0
        repeats, shortens = leaves & again, can_leave & strays.value & ~leaves & again
        self._aim(StepDecision(stepping, is_accurate, leaves, repeats, shortens, turns), aim, share, step)

    def _aim(self, found: StepDecision, aim: Value, share: Value, step: Value):
        """Write code that sets where the next step ends, and the lanes that repeat this one (`again`).

        Args:
            found: The decisions about this step.
            aim: The aim of this step: `AIM_BEYOND`, `AIM_BEFORE` or `AIM_ACROSS`.
            share: An upper bound of the end of the piece, as a fraction of this step.
            step: The length of this step (s).
        """
        f, s, where = self._f, self._s, self._f.select
        stepping, is_accurate, leaves, repeats, shortens, turns = found
        yes, inf = f.const(1.0, DOUBLE, f.width), f.const(np.inf, DOUBLE, f.width)
        is_near_end = f.min(share, yes - share) <= NEAR_END_FRACTION
        s.where(leaves & ~repeats, lands=1.0)
        goes_across = leaves & self._goes_across
        s.where(stepping, crosses=where(goes_across, where(turns, f.const(ACROSS_EDGE, DOUBLE, f.width), ACROSS_PIECE), 0.0))
        short = (s.t1 < s.crossing - s.smallest) & (s.lands < 0.5)
        reached = stepping & is_accurate & ~leaves & ~shortens & ~short & aim.is_(float(AIM_BEFORE))
        across = reached | (repeats & (share <= EDGE_STEP))
        before, beyond = (f.const(float(x), DOUBLE, f.width) for x in (AIM_BEFORE, AIM_BEYOND))
        aim = where(repeats, where(is_near_end, before, beyond), where(short, aim, beyond))
        expected = f.fma(where(is_near_end, share - EDGE_STEP / 2, share + NEAR_END_FRACTION / 2), step, s.point3_t)
        crossing = where(repeats, expected, where(short, s.crossing, inf))
        crossing = where(across, f.fma(s.h, EDGE_STEP, where(reached, s.t1, s.point3_t)), crossing)
        aim = where(shortens, beyond, aim)
        farthest = max(1.0, float(self._module.method.nodes.max()))  # some methods have stages after the end of the step
        crossing = where(shortens, f.fma(step, (1 - NEAR_END_FRACTION) / farthest, s.point3_t), crossing)
        repeats = repeats | shortens
        tries = where(repeats, s.tries + 1.0, where(is_accurate, 0.0, s.tries))
        s.where(stepping, crossing=crossing, aim=where(across, f.const(float(AIM_ACROSS), DOUBLE, f.width), aim), tries=tries)
        s.again = where(repeats, yes, 0.0)
