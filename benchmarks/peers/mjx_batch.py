"""MJX: MuJoCo's model of the linkage in JAX, many trajectories at once."""

from functools import partial
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.mujoco_rk4 import HARD, STEPS, mjcf, stiffened
from benchmarks.peers.peer import SPACING, STARTS, Batch, Coordinates, Peer, Run, coordinates

TRAJECTORIES = 64


def setup(batch: Batch) -> Run:
    """Return one program for all steps, of the step, the number of steps between outputs, and the initial angles."""
    mujoco = import_module("mujoco")
    mjx = import_module("mujoco.mjx")

    plain = mujoco.MjModel.from_xml_string(mjcf())
    plain.opt.iterations, plain.opt.ls_iterations = 1, 4  # without inequalities, one Newton step solves it
    links = [plain.joint(f"link{i + 1}").qposadr[0] for i in range(3)]
    coupler = plain.joint("coupler").qposadr[0]
    outputs = len(batch.problems[0].ts)
    start = np.zeros((len(batch.problems), 4))
    start[:, links] = np.array([[task.angle] for task in batch.problems])
    start[:, coupler] = -start[:, links[0]]
    data = mjx.make_data(plain)

    @jax.jit
    @partial(jax.vmap, in_axes=(None, None, 0))
    def trajectory(model, steps, qpos):
        def output(state, _):
            state = jax.lax.fori_loop(0, steps, lambda _, state: mjx.step(model, state), state)
            return state, state.qpos

        return jnp.concatenate([qpos[None], jax.lax.scan(output, data.replace(qpos=qpos), length=outputs - 1)[1]])

    def run(step: float) -> Coordinates:
        steps = round(SPACING / step)
        model = mjx.put_model(stiffened(plain, SPACING / steps, HARD))
        q = np.asarray(trajectory(model, steps, jnp.asarray(start)))
        return np.stack([coordinates(each[:, links], each[:, links[0]] + each[:, coupler]) for each in q])

    return run


PEERS = (Peer(f"MJX RK4, {TRAJECTORIES} at once", "mujoco-mjx", "step", STEPS[:6], setup, TRAJECTORIES, 10.0, STARTS[:1]),)
