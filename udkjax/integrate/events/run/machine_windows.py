"""Windows of runs with events by machine code and NumPy, for members whose conditions vary too quickly, or are NaN.

Runs to the next crossing give up there, and these members go on window by window (windows.py), with the same machine code for
their motion and for their conditions at the nodes of each window.
"""

import numpy as np
from jaxtyping import Bool, Float

from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.run.phase_code import PhaseCode
from udkjax.integrate.events.run.windows import WindowUnits
from udkjax.integrate.problem import IntegratorOutput


class MachineMotion:
    """The motion of one member in its present phase, a `windows.WindowMotion`.

    Args:
        plan: the phases and events.
        code: the machine code of the mechanism of the phase.
        member: the index of the member.
        ts: output times of the member (s).
        units: units and tolerances of the member.
        coordinates: the units of its coordinates.
        watched: mask of the conditions, then of the forces, that are watched.

    Attributes:
        lacks_forces: whether a watched force could not be computed, as a pivot was too small.
    """

    xp = np

    def __init__(
        self,
        plan: EventPlan,
        code: PhaseCode,
        member: int,
        ts: Float[np.ndarray, "T"],
        units: WindowUnits,
        coordinates: Float[np.ndarray, "n"],
        watched: Bool[np.ndarray, "2E"],
    ):
        self.plan, self.ts, self.units, self.projects = plan, ts, units, code.plan.projected
        self._code, self._member, self._coordinates, self._holds = code, member, coordinates, watched[plan.count :]
        self.breakpoints, self.lacks_forces = code.breakpoints(member), False

    def size(self, v: Float[np.ndarray, "n"]) -> np.float64:
        """Return the largest component of a change of coordinates, in units of the scene."""
        return np.max(np.abs(v) / self._coordinates, initial=0.0)

    def flow(self, times: Float[np.ndarray, "T"], state: RunState) -> IntegratorOutput:
        """Integrate from a state over times."""
        return self._code.flow(self._member, times, _repeated(state, times[:1], state.q[None], state.v[None]))

    def watch(
        self, state: RunState, t: Float[np.ndarray, "G"], q: Float[np.ndarray, "G n"], v: Float[np.ndarray, "G n"]
    ) -> tuple[Float[np.ndarray, "G E"], ...]:
        """Return conditions, their rates, and forces at times in the phase of a state; forces that are not watched are 1."""
        values = self._code.at(np.full(len(t), self._member), _repeated(state, t, q, v))
        is_known = np.isfinite(q).all(1) & np.isfinite(v).all(1)
        self.lacks_forces = bool(self._holds.any() and (is_known & ~values.has_safe_forces).any())
        return values.g, values.rate, np.where(self._holds, values.forces, 1.0)


def _repeated(state: RunState, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> RunState:
    """Return states at several times, in the phase and with the joints of one state."""
    return RunState(t, q, v, np.broadcast_to(state.phase, (len(t), *state.phase.shape)), state.joints)
