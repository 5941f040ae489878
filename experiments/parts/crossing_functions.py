"""The rows of the table of functions by models: each calls one public function, and compares it with another way.

A row returns what it was compared with, and raises `WrongError` where the two differ. Where udkjax refuses the model, its error
passes through.
"""

from typing import Any

import jax

import udkjax as udk
from experiments.parts import crossing_motion as motion
from experiments.parts import crossing_positions as positions
from experiments.parts import crossing_studies as studies
from experiments.parts.crossing_case import TS, Case, Row, agree, by_twin, transformed
from experiments.parts.crossing_positions import first_body


def path(case: Case) -> str:
    return agree(udk.path(case.model, case.run, f"body.{first_body(case.model)}"), case.run.q[:, 0, :2], "q")


def at_start(function: Any) -> Any:
    """Return a function of the model at the start of the case's run."""
    return lambda case, m: function(m, 0.0, case.state.q, case.state.v)


def along(function: Any) -> Any:
    """Return a function of the model along the case's run without events."""
    return lambda case, m: function(m, case.alone)


def driven(function: Any) -> Any:
    """Return a function of the model and of its own kinematics."""
    return lambda case, m: function(m, case.kinematics(m, 3, rate=case.rate))


def inverse(case: Case, m: Any) -> Any:
    if case.is_system or m.driver_names:
        return udk.inverse_dynamics(m, TS[:3]).efforts
    rest = udk.kinematics(m, case.driver, case.values(3), held=case.held, rate=1.0, acceleration=2.0)
    return udk.inverse_dynamics(m, TS[:3], rest, [case.driver, *(case.held or {})]).efforts


def end_of_step(case: Case, m: Any) -> Any:
    end = udk.step(m, case.state, None, TS[1], rtol=1e-10, atol=1e-10)
    return end.q, end.v


FUNCTIONS: dict[str, dict[str, Row]] = {
    "simulate": {
        "": motion.simulate,
        "engine": motion.simulate_engine,
        "jit": motion.simulate_jit,
        "vmap": motion.simulate_vmap,
        "derivative": motion.simulate_derivative,
    },
    "step": {"": motion.step, "engine": motion.step_engine, "names": motion.step_names},
    "assemble": {"": motion.assemble, "transformed": transformed(lambda case, m: list(vars(udk.assemble(m)).values()))},
    "accelerations": {"": motion.accelerations, "transformed": transformed(at_start(udk.accelerations))},
    "analyse": {"": by_twin(lambda case, m: [*(udk.analyse(m).redundant_rows or ()), udk.analyse(m).length])},
    "singular_values": {
        "": motion.singular_values,
        "transformed": transformed(
            lambda case, m: udk.singular_values(m, 0.0, case.state.q, None if case.is_system else udk.analyse(case.model))
        ),
    },
    "energy": {"": motion.energy, "transformed": transformed(along(udk.energy))},
    "violation": {"": motion.violation, "transformed": transformed(along(udk.violation))},
    "reactions": {"": motion.reactions, "transformed": transformed(along(udk.reactions))},
    "efforts": {"": motion.efforts, "transformed": transformed(along(udk.efforts))},
    "friction_loads": {"": motion.friction_loads, "transformed": transformed(along(udk.friction_loads))},
    "unique_reactions": {"": by_twin(along(udk.unique_reactions))},
    "uniqueness": {"": by_twin(lambda case, m: jax.tree.leaves(udk.uniqueness(m, 0.0, case.state.q)))},
    "power_balance": {"": motion.power, "transformed": transformed(lambda case, m: udk.power_balance(m, case.alone).kinetic)},
    "inverse_dynamics": {"": motion.inverse, "transformed": transformed(inverse)},
    "feed_forward": {"": motion.feed_forward},
    "equilibrium": {
        "": positions.equilibrium,
        "transformed": transformed(
            lambda case, m: [udk.equilibrium(m, stable=True, analysis=udk.analyse(case.model)).q], slope_tol=1e-3
        ),
    },
    "equilibria": {"": positions.equilibria},
    "holding_efforts": {
        "": positions.holding,
        "transformed": transformed(
            lambda case, m: udk.holding_efforts(m, case.driver, case.values(2), held=case.held).without_friction
        ),
    },
    "modes": {
        "": positions.modes,
        "transformed": transformed(lambda case, m: udk.modes(m, case.state, analysis=udk.analyse(case.model)).omega2),
    },
    "kinematics": {
        "": positions.kinematics,
        "transformed": transformed(lambda case, m: [(k := case.kinematics(m, 3)).q, k.v, k.a]),
    },
    "branches": {"": positions.branches},
    "characteristics": {"": positions.characteristics},
    "instant_centres": {"": positions.instant_centres},
    "travel": {"": positions.travel},
    "motion_ranges": {"": positions.motion_ranges},
    "gaps": {"": positions.gaps},
    "layers": {"": positions.layers},
    "motion_at": {"": positions.motion_at},
    "worked_solution": {"": positions.worked_solution},
    "pin_motion": {"": positions.pin_motion, "transformed": transformed(driven(lambda m, k: udk.pin_motion(m, k).links))},
    "pressure_angle": {"": positions.pressure_angle},
    "coupler_curve": {"": positions.coupler_curve},
    "mechanical_advantage": {
        "": positions.mechanical_advantage,
        "transformed": transformed(
            lambda case, m: 1.0 / udk.mechanical_advantage(m, case.kinematics(m, 3, rate=case.rate), case.output)
        ),
    },
    "transmission_angle": {"": positions.transmission_angle},
    "workspace": {"": positions.workspace},
    "check": {"": positions.check},
    "path": {"": path},
    "pin_reactions": {"": motion.pin_reactions, "transformed": transformed(along(udk.pin_reactions))},
    "reaction_peaks": {"": motion.reaction_peaks},
    "envelope": {"": motion.envelope},
    "diagnose": {"": studies.diagnose},
    "explain": {"": studies.explain},
    "identify": {"": studies.identify, "names": studies.identify_names},
    "check_gradients": {"": studies.check_gradients, "names": studies.check_gradients_names},
    "design_experiment": {"": studies.design_experiment},
    "inference": {"": studies.inference},
    "sample": {"": studies.sample},
    "compare": {"": studies.compare},
    "tolerances": {"": studies.tolerances},
    "sweep": {"": studies.sweep, "names": studies.sweep_names},
    "design": {"": studies.design},
    "design_all": {"": studies.design_all},
    "dumps": {"": studies.dumps},
    "loads": {"": studies.dumps},
    "save": {"": studies.save},
    "export_c": {"": studies.export_c},
    "export_fmu": {"": studies.export_fmu},
    "export_compiled": {"": studies.export_compiled},
    "load_exported": {"": studies.export_compiled},
    "load": {"": studies.save},
    "mjcf_text": {"": studies.mjcf},
    "read_mjcf": {"": studies.mjcf},
    "animate": {"": studies.animate(False), "live": studies.animate(True)},
    "animate_modes": {"": studies.animate_modes},
    "with_length": {"": positions.with_length},
    "with_angle": {"": positions.with_angle},
}
# Public functions that take no model: they make parts of drawings, or choices of other functions, which rows above use.
WITHOUT_MODEL = {"circles": "drawn", "polar": "drawn", "on_line": "drawings", "on_rail": "drawings", "stacked": "drawings"}
WITHOUT_MODEL |= {"read_outline": "Link", "plot_posterior": "sample", "length": "Parameter", "mechanisms_for": "drawings"}
