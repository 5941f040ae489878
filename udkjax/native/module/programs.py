"""The programs of a scene that modules call, by the names of their functions, and those that modules differentiate."""

from collections.abc import Mapping
from typing import NamedTuple


class CalledProgram(NamedTuple):
    """The outputs of a program; and, by output, the arrays of the module that store outputs under another name."""

    outputs: tuple[str, ...]
    stored: Mapping[str, str] = {}


FURTHER_ACCELERATIONS = "accelerations_further"
OUT_POINTER = "out"  # the pointer
_STEP_OUTPUTS = "v1", "a at v1", "safe", "unsettled"
_TANGENT_PART = "dq1", "dv1", "distance"
_ACCELERATION_OUTPUTS = "a", "safe", "unsettled"
_TO_OUT, _AS_PSI = {"a": OUT_POINTER}, {"psi_dot": "psi"}
PROGRAMS = {
    # by elimination
    "accelerations": CalledProgram(_ACCELERATION_OUTPUTS, _TO_OUT),
    "accelerations_and_drift": CalledProgram((*_ACCELERATION_OUTPUTS, "psi", "distance"), _TO_OUT),
    FURTHER_ACCELERATIONS: CalledProgram(("a further", "unsettled"), _TO_OUT),
    "newton_q": CalledProgram(("q1", "safe")),
    "newton_v_and_psi": CalledProgram(("v1", "psi")),
    "project": CalledProgram(("q1", "v1 at q1", "psi at q1")),
    "project_and_accelerate": CalledProgram(_STEP_OUTPUTS),
    "tangent_part": CalledProgram(_TANGENT_PART),
    "end_of_step": CalledProgram((*_STEP_OUTPUTS, *_TANGENT_PART)),
    "drift": CalledProgram(("distance", "psi")),
    "multipliers_of_settled": CalledProgram(("a settled", "safe", "multipliers")),
    "independent_rows": CalledProgram(("independent",)),
    "rank": CalledProgram(("rank",)),
    "value_derivatives": CalledProgram(("dq1 by value", "dv1 by value", "psi", "distance")),
    # for dense pseudoinverses
    "rows_and_loads": CalledProgram(("terms with friction", "psi_q", "psi", "root", "psi_dot", "couplings")),
    "dense_accelerations": CalledProgram(("terms", "psi_q", "root", "couplings")),
    "dense_newton_q": CalledProgram(("psi_q", "psi", "root", "couplings")),
    "dense_newton_v": CalledProgram(("psi_q", "psi_dot", "root", "couplings"), _AS_PSI),
    "rows_of_positions": CalledProgram(("psi_q of q", "psi", "root of q")),
    "rows_of_velocities": CalledProgram(("psi_q of q", "psi_dot", "root of q"), _AS_PSI),
    # without a linear system
    "equation_terms": CalledProgram(("terms",)),
    "psi": CalledProgram(("psi",)),
    "psi_dot": CalledProgram(("psi_dot",), _AS_PSI),
    "pieces": CalledProgram(("pieces",)),
    "drift_of_rates": CalledProgram(("drift",)),
    "mobility": CalledProgram(("dv1 without rows",)),
}
DIFFERENTIATED_OUTPUTS = {"accelerations": ("a",), "projection": ("q1", "v1 at q1"), "newton_q": ("q1",), "newton_v": ("v1",)}

# Rarely called functions: once per run, near singular configurations, where a piece may end, or once in an implicit step.
COLD_FUNCTIONS = (
    "end_piece",
    "along_motion",
    "jump",
    "finish_members",
    "begin",
    "rows_and_loads",
    "fallback",
    "fallback_tangent_part",
    "finish_by_fallback",
    "close_output",
    "accelerate_by_fallback",
    "equation_terms",
    "newton_v_and_psi",
    "evaluation_slopes",
    "measure_speed",
    FURTHER_ACCELERATIONS,
    "settle_state",
    "settle_end",
)
