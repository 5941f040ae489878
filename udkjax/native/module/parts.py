"""The parts of a module, which the algorithms of a run call: here those of a module that needs none.

A part says which programs of the scene it needs, which memory it reserves, and which functions it writes. Modules that run choose
theirs from parts/.
"""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value
from udkjax.native.module.layout import Lane

Shortened = tuple[Value, Value, Value]  # lanes whose attempt is complete, lanes that shorten it, time to a singular configuration


class Part:
    """A part that needs nothing."""

    shared: Collection[str] = ()
    """Arrays that parts share (`Module.SHARED`)."""
    programs: Sequence[str] = ()
    """The names of its programs."""
    arrays: Sequence[str] = ()
    """The arrays of programs in its memory."""

    def reserve(self):
        """Reserve its own memory."""

    def write(self):
        """Write its functions."""


class Fallback(Part):
    """The steps that elimination cannot take; this one leaves all steps to the solver."""

    finds_dependent_rows = False  # whether rows that depend on others show by their pivots

    def enter(self, f: Function, lane: Value, numbers: Value):
        """Compute its constants in a lane from the numbers of the scene."""

    def choose_lanes(self, f: Function, s: Lane, due: Value, is_due: Value):
        """Choose the lanes of the next attempt: if any are `due` for a fallback, only these."""
        s.stepping = s.active

    def check_pivots(self, f: Function, s: Lane, name: str):
        """Compute the accelerations `name` of a stage again, or abandon the attempt, in lanes whose pivots are too small."""

    def note_unsafe(self, s: Lane, unsafe: Value):
        """Abandon the attempt in lanes whose pivots at the end of a step are too small."""

    def finish_step(self, f: Function, s: Lane):
        """Finish steps by the fallback."""

    def retry(self, f: Function, s: Lane, stepping: Value, failed: Value, tries: Value | None) -> Shortened:
        """Shorten attempts of `stepping` lanes that encountered too small a pivot, or leave them to the fallback."""
        s.fallback_due = f.const(0.0, DOUBLE, f.width)
        return stepping, f.const(False, BOOL, f.width), f.const(np.inf, DOUBLE, f.width)

    def step_around(
        self, f: Function, s: Lane, failed: Callable[[], Value], time_left: Value, step: Value, otherwise: Value
    ) -> Value:
        """Return the next step: one around a singular configuration in lanes that `failed`."""
        return otherwise

    def close_output(self, f: Function, s: Lane, mask: Value):
        """Close outputs that still violate Psi."""

    def keeping_rows(self, f: Function, do: Callable[[], None]):
        """Run `do`, which projects an output, with rows that a step would leave out."""
        do()

    def with_loads(self, f: Function, do: Callable[[], None], lanes: Value | None = None):
        """Run `do` with the loads that friction has in steps of the fallback; `lanes`: where only some pivots are unsafe."""
        do()

    def evaluate_settled(self, f: Function, s: Lane, settle: Callable[[], None], evaluate: Callable[[], None]):
        """Run `evaluate`, with loads that `settle` has found, and finds again in steps of the fallback."""
        evaluate()

    def with_lost_loads(self, s: Lane, accept: Value, lost: Value) -> Value:
        """Return the lanes that are `lost`, and those whose accepted step left unbounded loads of joints out."""
        return lost

    def if_safe(self, s: Lane, mask: Value) -> Value:
        """Return the lanes of a mask whose latest pivots are safe."""
        return mask

    def accelerate_state(self, f: Function, s: Lane):
        """Compute `result a` again in lanes whose pivots are too small."""

    def find_tangent_part(self, f: Function, s: Lane):
        """Compute the tangent parts `result dq` and `result dv` again near singular configurations."""
