"""Drawings without masses: positions, velocities and driven motions need none; whatever depends on masses is refused by name."""

import inspect
import re

import jax
import numpy as np
import pytest

import udkjax as udk

TEXT = """format = 2
units = {length = "mm", angle = "deg"}
ground = ["O", "C"]

[pins]
O = [0, 0]
C = [100, 0]
A = {from = "O", length = 40, angle = 60}
B = {from = ["A", "C"], length = [120, 80], side = "left"}

[[link]]
name = "crank"
pins = ["O", "A"]

[[link]]
name = "coupler"
pins = ["A", "B"]

[[link]]
name = "rocker"
pins = ["C", "B"]
"""
MOTOR = '\n[[motor]]\npin = "O"\nspeed = "60 rpm"\n'
TIMES = np.linspace(0.0, 0.5, 6)
# Functions of a mechanism that need no masses; all others are in `needing`.
KINEMATIC = {
    *(
        "analyse",
        "animate",
        "assemble",
        "branches",
        "characteristics",
        "check",
        "coupler_curve",
        "design",
        "design_all",
        "diagnose",
    ),
    *("dumps", "gaps", "instant_centres", "kinematics", "layers", "mechanical_advantage", "motion_at", "motion_ranges", "path"),
    *(
        "pin_motion",
        "pressure_angle",
        "save",
        "singular_values",
        "tolerances",
        "transmission_angle",
        "travel",
        "unique_reactions",
    ),
    *("uniqueness", "violation", "with_angle", "with_length", "worked_solution", "workspace"),
}


def drawn(motor=MOTOR):
    return udk.loads(TEXT + motor)


def with_masses(mech):
    return mech.with_parameters({f"body.{name}.mass": 1.0 + k for k, name in enumerate(mech.body_names)})


def test_what_needs_no_mass_is_as_with_masses():
    light = drawn()
    assert light.massless == ("crank", "coupler", "rocker")
    heavy = with_masses(light)
    assert heavy.massless == ()
    found, expected = (udk.kinematics(mech, "motor1", np.radians(np.linspace(60, 420, 25))) for mech in (light, heavy))
    for name in "qva":
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-10, atol=1e-10)
    assert udk.characteristics(light).lines() == udk.characteristics(heavy).lines()
    runs = [udk.simulate(mech, TIMES, rtol=1e-9, atol=1e-9) for mech in (light, heavy)]
    np.testing.assert_allclose(runs[0].q, runs[1].q, rtol=1e-8, atol=1e-9)
    page = udk.worked_solution(light, "40 deg")
    assert len(page.balances) == 0
    length = jax.grad(lambda x: udk.kinematics(light.with_parameters({"pin.A.length": x}), "motor1", [1.5]).q[0, 2, 2])(0.04)
    other = jax.grad(lambda x: udk.kinematics(heavy.with_parameters({"pin.A.length": x}), "motor1", [1.5]).q[0, 2, 2])(0.04)
    np.testing.assert_allclose(length, other, rtol=1e-9)


def needing(light, free):
    """Calls that depend on masses, by function."""
    run, (q, v) = udk.simulate(light, TIMES), (light.q0, light.v0)
    record = udk.simulate(with_masses(free), TIMES)
    values = {"pin.A.length": np.array([0.04, 0.041])}
    return {
        "accelerations": lambda: udk.accelerations(light, 0.0, q, v),
        "efforts": lambda: udk.efforts(light, run),
        "energy": lambda: udk.energy(light, run),
        "friction_loads": lambda: udk.friction_loads(light, run),
        "reactions": lambda: udk.reactions(light, run),
        "pin_reactions": lambda: udk.pin_reactions(light, run),
        "reaction_peaks": lambda: udk.reaction_peaks(light, run),
        "power_balance": lambda: udk.power_balance(light, run),
        "inverse_dynamics": lambda: udk.inverse_dynamics(light, TIMES),
        "holding_efforts": lambda: udk.holding_efforts(light, "motor1", [1.1]),
        "equilibrium": lambda: udk.equilibrium(free),
        "equilibria": lambda: udk.equilibria(free),
        "modes": lambda: udk.modes(free),
        "explain": lambda: udk.explain(light),
        "mjcf_text": lambda: udk.mjcf_text(light),
        "simulate": lambda: udk.simulate(free, TIMES),
        "step": lambda: udk.step(free, udk.State(q, v), {}, 0.01),
        "sweep": lambda: udk.sweep(free, values, TIMES),
        "identify": lambda: udk.identify(free, record, ["pin.A.length"]),
        "inference": lambda: udk.inference(free, record, ["pin.A.length"]),
        "check_gradients": lambda: udk.check_gradients(free, record, ["pin.A.length"]),
    }


def test_what_depends_on_masses_is_refused_by_name():
    for name, call in needing(drawn(), drawn(motor="")).items():
        with pytest.raises(
            ValueError, match=r'"crank", "coupler" and "rocker" have no mass, on which [\w ]+ depend: give each a density'
        ) as error:
            call()
        assert "Traceback" not in str(error.value), name


def test_every_function_of_a_mechanism_is_known_to_need_masses_or_not():
    others = {
        "animate_modes",
        "design_experiment",
        "export_c",
        "export_fmu",
        "feed_forward",
    }  # need what such a function returns, or files
    takes = {
        name
        for name in dir(udk)
        if inspect.isfunction(getattr(udk, name))
        and {"mechanism", "drawing"} & {*inspect.signature(getattr(udk, name)).parameters}
    }
    known = KINEMATIC | {*needing(drawn(), drawn(motor=""))} | others
    assert takes <= known, takes - known
    for name in others:
        assert re.search(r"require_(masses|weights)", inspect.getsource(inspect.unwrap(getattr(udk, name)))), name


def test_masses_of_some_links_are_missing():
    text = TEXT.replace('pins = ["O", "A"]', 'pins = ["O", "A"]\nmass = 1')
    with pytest.raises(ValueError, match=r'"coupler" and "rocker" have no mass, on which free motions depend: .*, or let motors'):
        udk.simulate(udk.loads(text), TIMES)
    with pytest.raises(udk.SceneError, match="inertia: needs a mass"):
        udk.loads(TEXT.replace('pins = ["O", "A"]', 'pins = ["O", "A"]\ninertia = "1 kg m2"'))
    weightless = udk.loads(TEXT + '\n[[spring]]\nbetween = ["A", "C"]\nstiffness = "100 N/m"\nlength = 50\n').with_parameters(
        {"gravity": [0.0, 0.0]}
    )
    found, heavy = udk.equilibrium(weightless), udk.equilibrium(with_masses(weightless))
    np.testing.assert_allclose(found.q, heavy.q, atol=1e-8)


def test_events_that_change_a_motion_need_masses():
    """A motor that lets go leaves a free motion, although it determined the motion before."""
    late, light = (lambda t, bodies: t - 0.2), drawn()
    assert udk.simulate(light, TIMES, events=udk.Event(late, udk.Log())).result == udk.Result.successful
    with pytest.raises(ValueError, match='"rocker" have no mass, on which motions after events depend: give each a density'):
        udk.simulate(light, TIMES, events=udk.Event(late, udk.Release("motor1")))
