"""Friction that admits no motion: the joints whose friction, as it depends on their own load, jams a mechanism."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.textbook import prepare
from udkjax.integrate.causes.failed_run import FailedRun
from udkjax.pinv import SVD
from udkjax.scene.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote

JAMMING_TIMES = 0.0, 1e-9, 1e-6, 1e-4  # times after the end of a run, as fractions of its span


def explain_jamming(run: FailedRun) -> str:
    """Name the joints that jam at the end of a run, or just ahead; empty if friction admits a motion there."""
    mechanism = run.mechanism.without_origin
    joints = prepare(mechanism, analysis=run.analysis).rubbing_joints
    if not joints or not run.states:
        return ""
    t, q, v = run.states[0]
    span = float(run.ts[-1] - run.ts[0])
    for share in JAMMING_TIMES:
        state = t + share * span, q + share * span * v, v
        if not _jams(run, mechanism, state):
            continue
        alone = [name for name in joints if _jams(run, _with_friction_in(mechanism, name), state)]
        listed = ", ".join(map(quote, alone or joints))
        return (
            f"friction jams joint {listed} at {state[0]:.6g} s: the load that would balance its friction grows with the "
            "friction; make the coefficient smaller, or the guide longer"
        )
    return ""


def _jams(run: FailedRun, mechanism: Mechanism, state: tuple[float, np.ndarray, np.ndarray]) -> bool:
    equations = prepare(mechanism, SVD(), analysis=run.analysis)
    with jax.ensure_compile_time_eval():
        found = equations.multipliers(*map(jnp.asarray, state))
    return not bool(np.all(np.isfinite(np.asarray(found))))


def _with_friction_in(mechanism: Mechanism, joint: str) -> Mechanism:
    """Return the mechanism with friction that depends on loads in one joint only."""
    forces = {
        name: replace(force, coefficient=0.0, static_coefficient=None, viscous=None)
        if isinstance(force, Friction) and force.rubs and force.joint != joint
        else force
        for name, force in mechanism.forces.items()
    }
    return Mechanism(mechanism.bodies, mechanism.joints, mechanism.drivers, forces, mechanism.gravity, mechanism.name)
