"""Fallback steps: if a pivot is too small for elimination, a rank-revealing method on all rows takes the step.

Two functions with the argument `work` evaluate the states of lanes that are `wanted`:

    fallback                 compute the accelerations, and q and v after one Newton step, as `fallback a`, `q` and `v`
    fallback_tangent_part    compute the tangent parts of `state dq` and `state dv`, as `fallback dq` and `dv`

The classes of all_rows.py, one for each method, write these functions.
"""

from abc import abstractmethod
from collections.abc import Callable

from udkjax.native.language.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import FallbackPart, Shortened
from udkjax.native.module.steps import FACTORS, NEAREST_STAGE, OPEN_OUTPUT, OUTPUT_PIVOT_TOL
from udkjax.native.parts.manifold import iterate_newton, largest_violation, with_threshold
from udkjax.native.parts.singular import limit_of_error, retry_or_fall_back, step_across, step_around, time_to_singularity

FALLBACK_RESULTS = ("a", "q", "v", "dq", "dv")  # of the fallback


class RankRevealing(FallbackPart):
    """Base of the fallbacks: steps with pivots that are too small are repeated by a rank-revealing method."""

    finds_dependent_rows = True
    shared = ("couplings", "rates")

    def __init__(self, module: Module):
        self._in = module

    def reserve(self):
        for name in FALLBACK_RESULTS:
            self._in.places.add(f"fallback {name}", self._in.n)

    @abstractmethod
    def write_evaluations(self):
        """Hook: write the functions `fallback` and `fallback_tangent_part`, by the method of the subclass."""

    def write(self):
        module = self._in
        self.write_evaluations()
        # Accelerations of lanes whose pivots were not safe.
        f, s = module.function("accelerate_by_fallback", [(POINTER, "work"), (POINTER, "out")])
        mask = (s.stepping > 0.5) & (s.fallback > 0.5) & (s.safe < 0.5)
        self._invoke(f, s, mask)
        module.copy(f, "fallback a", "out", mask)
        # The end of a fallback step: the tangent part of the errors and, if the pivots are not safe, Newton's method for
        # positions, velocities and accelerations.
        f, s = module.function("finish_by_fallback", [(POINTER, "work"), (POINTER, "out")])
        fallback = (s.stepping > 0.5) & (s.fallback > 0.5)
        unsafe = fallback & (s.ok < 0.5)
        self._close_position(f, s, unsafe)
        with f.if_(f.any_of(unsafe)):
            self._invoke(f, s, unsafe)
            for to in ("state v", "result v"):
                module.copy(f, "fallback v", to, unsafe)
            self._invoke(f, s, unsafe)
            module.copy(f, "fallback a", "result a", unsafe)
        self._invoke(f, s, fallback, "fallback_tangent_part")
        for x in ("dq", "dv"):
            module.copy(f, f"fallback {x}", f"result {x}", fallback)
        # An output that still violates Psi after projection by elimination.
        f, s = module.function("close_output")
        self._close_position(f, s, s.open > 0.5)
        self._invoke(f, s, s.open > 0.5)
        module.copy(f, "fallback v", "result v", s.open > 0.5)
        module.invoke(f, "psi")

    def _invoke(self, f: Function, s: Lane, mask: Value, name: str = "fallback"):
        s.wanted = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
        self._in.invoke(f, name)

    def _close_position(self, f: Function, s: Lane, mask: Value):
        def correct(active: Value):
            self._invoke(f, s, active)
            self._in.copy(f, "fallback q", "corrected q")

        iterate_newton(self._in, f, s, mask, correct)

    # --- steps

    def choose_lanes(self, f: Function, s: Lane, due: Value, is_due: Value):
        yes = f.const(1.0, DOUBLE, f.width)
        s.fallback = f.select(is_due, yes, 0.0)
        s.stepping = f.select(is_due, f.select(due, yes, 0.0), s.active)

    def check_pivots(self, f: Function, s: Lane, name: str):
        unsafe = (s.stepping > 0.5) & (s.safe < 0.5)
        with f.if_(f.any_of(unsafe)):
            f.choose(
                f.any_of(unsafe & (s.fallback > 0.5)),
                lambda: self._in.invoke(f, "accelerate_by_fallback", name),
                lambda: s.where(unsafe, ok=0.0),
            )

    def note_unsafe(self, s: Lane, unsafe: Value):
        s.where(unsafe, ok=0.0)

    def finish_step(self, f: Function, s: Lane):
        by_fallback = (s.stepping > 0.5) & (s.fallback > 0.5)
        with f.if_(f.any_of(by_fallback)):
            self._in.invoke(f, "finish_by_fallback")
            self._in.accelerations.accelerate_end(f)
            s.where(by_fallback, ok=1.0)

    def retry(self, f: Function, s: Lane, stepping: Value, failed: Value, tries: Value | None) -> Shortened:
        return retry_or_fall_back(f, s, failed, tries)

    @property
    def _plans(self) -> bool:
        # Friction by loads that grow without bounds needs nodes near a singular configuration: its errors are no rounding errors.
        return not self._in.friction.settles

    def limit_of_error(self, f: Function, s: Lane, time_left: Value) -> Value | float:
        return limit_of_error(f, s, self._in.method, time_left, self._in.projection.drift(f)) if self._plans else 1.0

    def step_around(
        self, f: Function, s: Lane, accept: Value, lanes: Callable[[], Value], time_left: Value, step: Value, otherwise: Value
    ) -> Value:
        method = self._in.method
        if not self._plans:
            across = step_across(f, method, time_left, step)
            is_similar = (across > step * FACTORS.shrink) & (across < step * FACTORS.safety)
            return f.select(lanes() & ~accept & is_similar, across, otherwise)
        start = f.select(accept, s.distance, s.distance2)
        ahead = f.select(accept, time_to_singularity(s, accepted=True), time_left)
        return f.select(lanes(), step_around(f, s, method, start, ahead, otherwise), otherwise)

    # --- outputs

    def close_output(self, f: Function, s: Lane, mask: Value):  # rows with small pivots are left out and may be violated
        s.open = f.select(mask & (s.violated > OPEN_OUTPUT), f.const(1.0, DOUBLE, f.width), 0.0)
        with f.if_(f.any_of(s.open > 0.5)):
            f.call("close_output", f.given["work"])
            s.where(s.open > 0.5, violated=largest_violation(self._in, f))

    def keeping_rows(self, f: Function, do: Callable[[], None]):
        with_threshold(f, self._in.drop_tol_place, f.const(OUTPUT_PIVOT_TOL, DOUBLE, f.width), do)

    # --- loads of joints with friction

    def with_loads(self, f: Function, do: Callable[[], None], lanes: Value | None = None):
        """Run `do` with a higher threshold of pivots: rows without a safe pivot carry no loads of joints with friction.

        Towards a singular configuration the loads of joints may grow without bounds, and the friction that they cause may jam the
        mechanism in a range that a step crosses. Therefore steps of the fallback, and their derivatives, omit these loads.

        `lanes`: the lanes with this threshold; None: all lanes.
        """
        module = self._in
        if not module.friction.settles:
            do()
            return
        safe = (module.unrolled or module.code).safe_tol_index
        assert safe is not None  # the accelerations report whether pivots are safe
        safe_tol = f.load(f.given["work"], (module.places["constants"] + safe) * f.width, f.width)
        place = module.drop_tol_place
        if lanes is not None and place is not None:
            safe_tol = f.select(lanes, safe_tol, f.load(f.given["work"], place * f.width, f.width))
        with_threshold(f, place, safe_tol, do)

    def evaluate_settled(self, f: Function, s: Lane, settle: Callable[[], None], evaluate: Callable[[], None]):
        if not self._in.friction.settles:
            evaluate()
            return
        unsafe = s.safe < 0.5

        def settle_and_evaluate():
            with f.if_(f.any_of(unsafe)):
                settle()
            evaluate()

        self.with_loads(f, settle_and_evaluate, unsafe)

    def with_lost_loads(self, s: Lane, accept: Value, lost: Value) -> Value:
        return lost | (accept & (s.fallback > 0.5)) if self._in.friction.settles else lost

    # --- single states

    def if_safe(self, s: Lane, mask: Value) -> Value:
        return mask & (s.safe > 0.5)

    def accelerate_state(self, f: Function, s: Lane):
        s.stepping = s.active
        s.fallback = s.active
        with f.if_(f.any_of((s.active > 0.5) & (s.safe < 0.5))):
            self._in.invoke(f, "accelerate_by_fallback", "result a")

    def find_tangent_part(self, f: Function, s: Lane):
        is_near = (s.active > 0.5) & ~(s.distance > NEAREST_STAGE)
        with f.if_(f.any_of(is_near)):
            self._invoke(f, s, is_near, "fallback_tangent_part")
            for x in ("dq", "dv"):
                self._in.copy(f, f"fallback {x}", f"result {x}", is_near)
