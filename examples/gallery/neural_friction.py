"""The friction of a pin, learned by a neural network through the simulation.

A pendulum swings with dry friction, whose law the network does not know. The network is a force element like any other;
its weights are found by gradient descent through the equations of motion.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show.style import COLOURS, plain

TS = np.linspace(0.0, 2.0, 21)
STEPS = 150


class Network(udk.ForceElement):
    """A torque on a body: an odd function of its angular velocity (rad/s)."""

    law: eqx.nn.MLP

    def torque(self, omega):
        """Return the torque (N m)."""
        return self.law(jnp.stack([omega]))[0] - self.law(jnp.stack([-omega]))[0]

    def loads(self, t, *frames):
        """Return loads that act only on the body's rotation."""
        (body,) = frames
        return [(0.0, 0.0, self.torque(body.omega))]


def pendulum(element):
    """Return a rod on a pin with a law of friction."""
    plain = udk.library.compound_pendulum(1.2)
    return udk.Mechanism(plain.bodies, plain.joints, forces={"friction": element}, name="pendulum with friction")


def make():
    """Return the errors of the learned law, the player, and both laws."""
    (joint,) = udk.library.compound_pendulum().joint_names
    (rod,) = udk.library.compound_pendulum().body_names
    truth = pendulum(udk.Friction(joint, torque=2.0, velocity=0.5))
    measured = udk.simulate(truth, TS, rtol=1e-6, atol=1e-6)
    network = pendulum(Network([rod], eqx.nn.MLP(1, 1, 8, 1, activation=jnp.tanh, key=jax.random.key(2))))
    analysis = udk.analyse(network)

    def with_law(law):
        return eqx.tree_at(lambda mech: mech.forces["friction"].law, network, law)

    @eqx.filter_jit
    def step(law, state):
        def loss(law):
            found = udk.simulate(with_law(law), TS, rtol=1e-6, atol=1e-6, analysis=analysis, throw=False).q
            return jnp.mean((found[:, 0, 2] - measured.q[:, 0, 2]) ** 2)

        value, slope = eqx.filter_value_and_grad(loss)(law)
        change, state = optimizer.update(slope, state)
        return eqx.apply_updates(law, change), state, value

    law, optimizer = network.forces["friction"].law, optax.adam(0.03)
    state, losses = optimizer.init(eqx.filter(law, eqx.is_array)), []
    for _ in range(STEPS):
        law, state, value = step(law, state)
        losses.append(float(value))
    learned = with_law(law)
    omega = np.linspace(-3.0, 3.0, 121)
    found = jax.vmap(learned.forces["friction"].torque)(omega)
    true = -2.0 * np.tanh(omega / 0.5)
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = plain(figure.subplots())
    axes.plot(omega, true, color=COLOURS[0], lw=1.6, label="true")
    axes.plot(omega, found, "--", color=COLOURS[1], lw=1.6, label="learned")
    axes.set(xlabel="angular velocity (rad/s)", ylabel="torque (N m)")
    axes.legend(frameon=False)
    facts = {
        "root-mean-square error of the angle (rad)": losses[-1] ** 0.5,
        "root-mean-square error of the angle before training (rad)": losses[0] ** 0.5,
        "root-mean-square error of the law (N m)": float(np.sqrt(np.mean((found - true) ** 2))),
    }
    untrained = udk.simulate(network, TS, rtol=1e-6, atol=1e-6)
    runs = {"measured": measured, "learned": udk.simulate(learned, TS, rtol=1e-6, atol=1e-6), "before": untrained}
    angle = {"angle (rad)": {label: run.q[:, 0, 2] for label, run in runs.items()}}
    mechs = {"measured": truth, "learned": learned, "before": network}
    return facts, {"motion": udk.animate(mechs, runs, measures=angle), "law": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("neural_friction.html")
