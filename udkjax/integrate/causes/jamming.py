"""Friction that admits no motion: joints jam a mechanism if their friction grows with the loads that it causes itself."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from udkjax.equations.states.quantities import accelerations, equations_of
from udkjax.integrate.causes.failed_run import FailedRun
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Prismatic, Slot
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote

JAMMING_TIMES = 0.0, 1e-9, 1e-6, 1e-4  # times after the end of a run, as fractions of its span


def explain_jamming(run: FailedRun) -> str:
    """Name the joints that jam at the end of a run or shortly after; "" if friction admits a motion there."""
    mechanism = run.mechanism.without_origin
    joints = equations_of(mechanism, analysis=run.analysis).rubbing_joints
    if not joints or not run.states:
        return ""
    t, q, v = run.states[0]
    span = float(run.ts[-1] - run.ts[0])
    for share in JAMMING_TIMES:
        state = t + share * span, q + share * span * v, v
        if not _jams(run, _sliding(mechanism), state):
            continue
        alone = [name for name in joints if _jams(run, _sliding(mechanism, name), state)]
        return _description(mechanism, alone or joints, state[0])
    return ""


def _description(mechanism: Mechanism, names: Sequence[str], t: float) -> str:
    kinds = {isinstance(mechanism.joints[name], Prismatic | Slot) for name in names}
    pins, guides = False in kinds, True in kinds
    one = len(names) == 1
    cure = f"make the coefficient{' or the radius of the pin' if pins else ''} smaller{', or the guide longer' if guides else ''}"
    return (
        f"friction jams joint{'' if one else 's'} {', '.join(map(quote, names))} at {t:.6g} s: the load that would balance "
        f"{'its' if one else 'their'} friction grows with the friction; {cure}"
    )


def _jams(run: FailedRun, mechanism: Mechanism, state: tuple[float, np.ndarray, np.ndarray]) -> bool:
    t, q, v = state
    shape = mechanism.state_shape()
    return not np.isfinite(accelerations(mechanism, t, q.reshape(shape), v.reshape(shape), analysis=run.analysis)).all()


def _sliding(mechanism: Mechanism, joint: str | None = None) -> Mechanism:
    """Return the mechanism with only that part of its friction which depends on loads: in all joints, or in `joint` alone.

    The smooth law replaces the set-valued one, since joints slide, and decisions whether they stick would take long.
    """
    forces = {}
    for name, force in mechanism.forces.items():
        if not isinstance(force, Friction):
            forces[name] = force
        elif force.rubs:
            rubs = joint in (None, force.joint)
            changed = (
                {"coefficient": force.coefficient, "viscous": force.viscous} if rubs else {"coefficient": 0.0, "viscous": None}
            )
            forces[name] = replace(force, law="smooth", torque=None, velocity=None, static_coefficient=None, **changed)
    return Mechanism(mechanism.bodies, mechanism.joints, mechanism.drivers, forces, mechanism.gravity, mechanism.name)
