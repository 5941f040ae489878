"""Mechanisms with known numbers, the measurements of their motion, and the numbers that these determine.

The sets were chosen by the singular values of the derivatives of the channels with respect to the logarithms of the parameters,
each channel in units of its own size, as the root mean square over all samples: the smallest is at least 2e-3 in every set.
Motion alone never determines the common scale of all masses, stiffnesses and dampings: one of them has to be known.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import channel_of
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.problem.unknowns import Unknowns, apply_values

LINKS = ("link1", "link2", "link3")
CYLINDERS = ("boom cylinder", "stick cylinder", "bucket cylinder")
PINS = ("joint.foot.angle", "joint.tip.angle", "joint.bucket pin.angle")
EXACT = 1e-12  # tolerance of the measured run


class Measurement(NamedTuple):
    """Measurements of a mechanism for `end` seconds at a `rate` (Hz), and the parameters to find from them."""

    mechanism: udk.Mechanism
    parameters: tuple[Any, ...]
    channels: tuple[str, ...]
    end: float
    rate: float

    @property
    def ts(self) -> np.ndarray:
        """Return the times of the samples."""
        return np.linspace(0.0, self.end, round(self.end * self.rate) + 1)

    @property
    def unknowns(self) -> Unknowns:
        """Return the parameters: `names`, and their true values, `start`."""
        return unknowns_of(self.mechanism, self.parameters)

    def with_values(self, x: np.ndarray) -> udk.Mechanism:
        """Return the mechanism with other values of the parameters."""
        return apply_values(self.mechanism, self.unknowns.targets, jnp.asarray(x))

    def predictor(self) -> Callable[[Any, Any], tuple[Any, Any]]:
        """Return the compiled function (values, tolerance) -> channels (T, C) and result, a single run without derivatives."""
        targets, ts = self.unknowns.targets, self.ts
        channels = tuple(channel_of(self.mechanism, text) for text in self.channels)

        @jax.jit
        def predicted(x, tol):
            mechanism = apply_values(self.mechanism, targets, x)
            solution = udk.simulate(mechanism, ts, rtol=tol, atol=tol, throw=False)
            return measure(mechanism, solution, channels), solution.code

        return predicted

    def starts(self, count: int, spread: float, seed: int = 0) -> np.ndarray:
        """Return first guesses (count, P): each parameter uniformly within `spread` of its true value."""
        truth = self.unknowns.guess
        return truth * np.random.default_rng(seed).uniform(1 - spread, 1 + spread, (count, len(truth)))


def linkage(degrees: float = -45.0, damping: float = 0.4, end: float = 10.0) -> Measurement:
    """Return the paper's linkage with some damping in its first bearing; the mass of its coupler is known.

    Its angle determines, in addition to the damping, only one number, the acceleration by gravity; the height of its coupler
    determines the length. Released above the ground, it crosses the singular configurations again and again.
    """
    placed = udk.library.parallelogram(np.deg2rad(degrees))
    bearing = udk.TorsionSpring((udk.GROUND, LINKS[0]), 0.0, damping)
    mechanism = udk.Mechanism(placed.bodies, placed.joints, forces={"bearing": bearing}, gravity=placed.gravity, name=placed.name)
    masses = " = ".join(f"body.{link}.mass" for link in LINKS)
    parameters = udk.length(*LINKS), masses, "force.bearing.damping"
    return Measurement(mechanism, parameters, ("body.link1.angle", "body.coupler.y"), end, 20.0)


def four_bar(end: float = 5.0) -> Measurement:
    """Return a four-bar with two encoders and a known crank.

    The motion determines five numbers of the masses and inertias of three links, up to a common factor: a coupler of length b
    and mass m acts as m / 2 at either end, and by its inertia less m b^2 / 4.
    """
    parameters = (
        *(f"body.{body}.{what}" for body in ("coupler", "rocker") for what in ("mass", "inertia")),
        udk.length("coupler"),
    )
    return Measurement(udk.library.four_bar(), parameters, ("body.crank.angle", "body.rocker.angle"), end, 100.0)


def slider_crank(end: float = 5.0) -> Measurement:
    """Return a slider-crank whose slider is on a spring with a damper; crank and rod have known masses."""
    mechanism = udk.library.slider_crank(0.7, 4.0, driven=False, spring=(60.0, 1.6, 4.0))
    spring = (f"force.spring.{what}" for what in ("stiffness", "length", "damping"))
    parameters = (*spring, "body.slider.mass", udk.length("rod"))
    return Measurement(mechanism, parameters, ("body.crank.angle", "body.slider.x"), end, 20.0)


def excavator(end: float = 4.0) -> Measurement:
    """Return an excavator's arm on the oil in its cylinders, with encoders at three pins; the mass of its boom is known."""
    cylinders = (f"force.{name}.{what}" for what in ("stiffness", "damping") for name in CYLINDERS)
    return Measurement(udk.library.excavator(), (*cylinders, "body.bucket.mass", "body.stick.mass"), PINS, end, 50.0)


def driven_excavator(end: float = 10.0) -> Measurement:
    """Return an excavator's arm moved by its cylinders; their forces and the angles determine masses and geometry.

    The bucket's cylinder only extends, so that the four-bar closes with a link from half to one and a half times as long.
    """
    mechanism = udk.library.excavator(driven=True, strokes=(0.3, -0.4, 0.2), frequencies=(1.6, 2.2, 2.8))
    masses = (*(f"body.{body}.mass" for body in ("boom", "stick", "bucket")), "body.stick.inertia", "body.bucket.inertia")
    parameters = (*masses, "driver.boom cylinder.points[0][0]", udk.length("link"))
    return Measurement(mechanism, parameters, (*PINS, *(f"driver.{name}.load" for name in CYLINDERS)), end, 10.0)


def sprung_chain(count: int = 20, end: float = 3.0) -> Measurement:
    """Return a chain of five links with torsion springs and dampers at the pins, pulled at the end by a known force.

    Parameters are the first `count` of 5 stiffnesses, 5 dampings, 5 masses, 4 inertias and the length of the last link. The
    inertia of the first link is left out, since its effect is negligible compared with its mass and the first spring.
    """
    placed = udk.library.chain(5, angle=0.3, length=2.0, mass=5.0)
    pairs = zip((udk.GROUND, *placed.body_names), placed.body_names, strict=False)
    springs = {
        f"spring{i}": udk.TorsionSpring(pair, 20.0 - 2.0 * i, 0.6 - 0.05 * i, 0.0 if i else -np.pi / 2)
        for i, pair in enumerate(pairs)
    }
    pull = {"pull": udk.Force(placed.body_names[-1], (8.0, 0.0))}
    mechanism = udk.Mechanism(placed.bodies, placed.joints, forces=springs | pull, gravity=placed.gravity, name="sprung chain")
    parameters = [f"force.{name}.{what}" for what in ("stiffness", "damping") for name in springs]
    parameters += [f"body.{name}.mass" for name in placed.body_names] + [f"body.{name}.inertia" for name in placed.body_names[1:]]
    chosen = (*parameters, udk.length(placed.body_names[-1]))[:count]
    return Measurement(mechanism, chosen, tuple(f"joint.pin{i}.angle" for i in range(5)), end, 50.0)
