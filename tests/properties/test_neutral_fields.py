"""A scene in which an optional field is left out, and the same with the value that changes nothing, one after the other.

Compiled programs and results are found again by the form of a scene. If a key forgot which fields are given, the second of two
such scenes would get the program of the first.
"""

from typing import Any

import jax
import numpy as np
import pytest

import udkjax as udk

TS = np.linspace(0.0, 0.1, 3)
PIN = {"top": udk.Revolute(["ground", "a"], [[0.0, 0.0], [-0.5, 0.0]])}
BODY = {"a": udk.Body(1.0, 1 / 12, [0.5, 0.0], angular_velocity=-0.5)}
SLIDE = {"b": udk.Body(1.0, 0.1, [0.5, 0.0], velocity=[0.3, 0.0])}
ENDS, POINTS = ["ground", "a"], [[0.0, 1.0], [0.3, 0.0]]


def forced(*forces):
    return udk.Mechanism(BODY, PIN, forces=dict(zip("fgh", forces, strict=False)))


def driven(**more):
    motion = udk.Polynomial([0.5, 0.3])
    driver = udk.Driver(["ground", "b"], "x", motion, **more)
    joint = udk.Prismatic(["ground", "b"], [[0.0, 0.0], [0.0, 0.0]], 0.0)
    return udk.Mechanism(SLIDE, {"slide": joint}, {"drive": driver})


def rubbing(**more: Any):
    return udk.Friction("top", coefficient=0.2, radius=0.02, **more)


def joined(joint):
    return udk.Mechanism(BODY | {"b": udk.Body(1.0, 0.1, [1.0, 0.5])}, PIN | {"j": joint})


# Without the field, with it, and its name.
PAIRS = {
    "Spring.damping": lambda x: forced(udk.Spring(ENDS, POINTS, 50.0, 0.5, *x)),
    "TorsionSpring.damping": lambda x: forced(udk.TorsionSpring(ENDS, 5.0, *x)),
    "Friction.static_coefficient": lambda x: forced(rubbing(**({"static_coefficient": 0.2} if x else {}))),
    "Friction.viscous": lambda x: forced(rubbing(**({"viscous": 0.0} if x else {}))),
    "Driver.axis": lambda x: driven(**({"axis": 0.0} if x else {})),
    "Driver.points": lambda x: driven(points=[[0.0, 0.0], [0.0, 0.0]] if x else None),
    "Prismatic.angle": lambda x: joined(udk.Prismatic(["a", "b"], [[0.5, 0.5], [0.0, 0.0]], 0.7, *x)),
    "Distance.length": lambda x: joined(udk.Distance(["ground", "b"], [[0.0, 0.0], [0.0, 0.0]], *([1.25**0.5] if x else []))),
    "Angle.angle": lambda x: joined(udk.Angle(["a", "b"], *x)),
    "Weld.angle": lambda x: joined(udk.Weld(["a", "b"], [[0.5, 0.5], [0.0, 0.0]], *x)),
}


def results(mech):
    """Return the numbers of functions that keep programs: one of each cache."""
    run = udk.simulate(mech, TS, rtol=1e-9, atol=1e-9)
    end = udk.step(mech, udk.assemble(mech), {"body.a.mass" if "a" in mech.bodies else "body.b.mass": 1.5}, 0.01)
    a = udk.accelerations(mech, 0.0, run.q[0], run.v[0])
    power = udk.power_balance(mech, run)
    parts = [run.q, run.v, end.q, a, udk.reactions(mech, run), udk.energy(mech, run).kinetic, power.kinetic, power.potential]
    return [np.asarray(x, float) for x in jax.tree.leaves(parts)]


def same(found, wanted):
    assert len(found) == len(wanted)
    for x, y in zip(found, wanted, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-7, atol=1e-9 * (1.0 + np.abs(y).max(initial=0.0)))


@pytest.mark.parametrize("name", PAIRS)
def test_a_neutral_field_changes_nothing(name):
    without, given = PAIRS[name](()), PAIRS[name]((0.0,))
    first = results(without)
    same(results(given), first)
    same(results(without), first)


@pytest.mark.parametrize("order", [1, -1])
def test_laws_of_friction_are_identified_one_after_the_other(order):
    """The laws have different numbers of `Friction`, and the fits the same unknown."""
    laws = [forced(udk.Friction("top", torque=0.1, velocity=0.1)), forced(rubbing())]
    for mech in laws[::order]:
        run = udk.simulate(mech, TS, rtol=1e-10, atol=1e-10)
        data = {"time": TS, "body.a.angle": np.asarray(run.q)[:, 0, 2]}
        guess = mech.with_parameters({"body.a.mass": 1.1})
        found = udk.identify(guess, data, ["body.a.mass"], n_starts=0, noise=1e-6, progress=False)
        np.testing.assert_allclose(found.values, [1.0], rtol=1e-5)
