"""The functions of a scene in C: each calls a unit, the translation of an operation of machine code."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.compiled_mechanism import compile_concrete, evaluation_of
from udkjax.integrate.events.law.kinks import kinks_of
from udkjax.integrate.native_engine import packed, scene_inputs
from udkjax.integrate.portable.parameters import NumberProgram, scalar_parameters
from udkjax.integrate.prepare import AUTO, DRIFT_PROJECTED, Choices, may_stick, prepare_run, with_held_pins
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import Projection
from udkjax.integrate.solution import Result
from udkjax.integrate.stepping import MOST_STEPS_OF_INTERVAL
from udkjax.native.c import CUnit, c_function, c_unit, number_text
from udkjax.native.module.steps import SMALLEST_STEP, Status
from udkjax.native.operations import Operation, StateOperation
from udkjax.native.position_operations import Close
from udkjax.native.runs import RunStates
from udkjax.pinv import SVD
from udkjax.positions.assembling.assembly import State, assemble
from udkjax.requirements import ArgumentError
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote

RESULT_OF_STATUS = {
    Status.DONE: Result.successful,
    Status.STEP_LIMIT: Result.step_limit,
    Status.NOT_FINITE: Result.not_finite,
    Status.LOST: Result.drift,
    Status.SINGULAR: Result.singular,
    Status.SPURIOUS_RANK: Result.spurious_rank,
    Status.MISSING_RANK: Result.missing_rank,
}
OTHER_FILES = "fmi3", "fmu", "model"  # names of the headers and sources of an FMU
INFO_PLACES = {name: k for k, name in enumerate(RunStates.info_names)}  # places in the result "info"


class SceneCode:
    """The functions of a scene in C.

    The methods `run` to `reactions` each return the C text of functions, and the unit that these call.

    Args:
        mechanism: the scene, with concrete numbers.
        ts: output times of its run (s).
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, relative to the scene's scales.
        stiff: whether a run goes on by an implicit method where it is stiff.

    Raises:
        ArgumentError: there is no C for the scene.
    """

    def __init__(self, mechanism: Mechanism, ts: np.ndarray, rtol: float, atol: float, stiff: bool = True):
        choices = Choices(rtol=rtol, atol=atol, drift_tol=DRIFT_PROJECTED, dt0=None, method=AUTO, stabilization=Projection())
        given, analysis, choices = with_held_pins(mechanism, None, None, choices)
        self.mechanism: Mechanism = given
        refuse_what_needs_python(self.mechanism)
        self._choices = choices
        self.ts, self.analysis = ts, analyse(self.mechanism) if analysis is None else analysis
        self.compiled = compile_concrete(self.mechanism, self.analysis, *choices.of_mechanism)
        plan = self.compiled.plan
        if plan.why_not_native:
            raise ArgumentError(f"no C for this scene: {plan.why_not_native}")
        if plan.shares_by_marks:
            why = "friction depends on the loads of joints, and rows that may be redundant share these"
            raise ArgumentError(f"no C for this scene: {why}; remove the redundant constraint that udkjax.diagnose names")
        closed = assemble(self.mechanism, float(ts[0]))
        start = State(np.asarray(closed.q).ravel(), np.asarray(closed.v).ravel())
        self.problem: Problem = prepare_run(self.compiled, self.analysis, ts, start, None, choices, np).problem
        assert plan.operation is not None  # there is machine code
        self.operation = plan.operation if stiff else replace(plan.operation, changes=False, leaves=False)
        self.prefix = re.sub(r"[^a-z0-9]+", "_", (mechanism.name or "scene").lower()).strip("_")
        if self.prefix in OTHER_FILES or not re.match(r"[a-z]", self.prefix):
            self.prefix = f"scene_{self.prefix}"

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return self.operation.code.coordinate_count

    @cached_property
    def inputs(self) -> dict[str, np.ndarray]:
        """The inputs of a run, by name."""
        names = (*Operation.input_names, *(("samples",) if self.operation.sampled else ()))
        return {name: np.ravel(x) for name, x in zip(names, packed(self.problem), strict=True)}

    @property
    def numbers(self) -> np.ndarray:
        """The input "numbers" of a run: all numbers of the scene, marks of rows if any, and two thresholds of pivots."""
        return self.inputs["numbers"]

    # --- functions

    def run(self) -> tuple[str, CUnit]:
        """Return the functions of whole runs (`..._run`) and of one interval (`..._step`)."""
        unit, text = self._integration(self.operation)
        text += f"""
int {self.prefix}_run(const double *numbers, const double *ts, int times, const double *q, const double *v, double *qs,
    double *vs, double *violation, double *info, double *memory)
{{
    return integrate(numbers, ts, times, q, v, qs, vs, violation, info, memory, 0.0, {number_text(self._settings["max_steps"])});
}}
{self._step("step", "double *q, double *v")}"""
        return text, unit

    def step_derivatives(self) -> tuple[str, CUnit]:
        """Return the function of one interval with its derivative along a direction (`..._step_along`)."""
        if self.operation.sampled:
            raise ArgumentError("no C for derivatives of steps with tables over time: export the run alone")
        operation = self.operation.with_tangents((True,) * self.operation.code.number_count)
        unit, text = self._integration(operation, ("dnumbers", "dq", "dv"), ("dys", "dend"))
        arguments = "double *q, double *v, const double *dnumbers,\n    double *dq, double *dv"
        return text + self._step("step_along", arguments, ("dnumbers", "dq", "dv"), ("dys", "dend")), unit

    def _step(self, name: str, state: str, along: Sequence[str] = (), found: Sequence[str] = ()) -> str:
        """Return the C of a function that integrates over one interval; `along` and `found` name arrays of a direction."""
        n, further = self.n, "".join(f", {x}" for x in (*along, *found))
        declared = "".join(f", {x}[{4 * n}]" for x in found)
        copied = [f"        memcpy(d{x}, dys + {k * n}, {n} * sizeof *d{x});" for k, x in ((2, "q"), (3, "v")) if along]
        return f"""
int {self.prefix}_{name}(const double *numbers, double t, double dt, {state}, double *memory)
{{
    double ts[2], qs[{2 * n}], vs[{2 * n}], violation[2], info[{len(INFO_PLACES) + 2 * n}]{declared};
    ts[0] = t;
    ts[1] = t + dt;
    const double most_steps = {number_text(MOST_STEPS_OF_INTERVAL)};
    const int result = integrate(numbers, ts, 2, q, v, qs, vs, violation, info, memory, dt, most_steps{further});
    if (!result) {{
        memcpy(q, qs + {n}, {n} * sizeof *q);
        memcpy(v, vs + {n}, {n} * sizeof *v);
{"".join(f"{line}{chr(10)}" for line in copied)}    }}
    return result;
}}
"""

    @property
    def _settings(self) -> dict[str, float]:
        return dict(zip(self.operation.all_settings, self.inputs["settings"].tolist(), strict=True))

    def _integration(self, operation: Operation, along: Sequence[str] = (), found: Sequence[str] = ()) -> tuple[CUnit, str]:
        """Return the unit of an operation that integrates, and the C text of it and of a function `integrate` that calls it."""
        unit = c_unit(operation, int(bool(along)))
        rate, length = (number_text(float(x)) for x in (self.analysis.scales.rate, self.analysis.scales.length))
        results = [int(RESULT_OF_STATUS.get(k, Result.step_too_small)) for k in range(Status.MISSING_RANK + 1)]
        arrays = ("numbers", "ts", "q", "v", "rows", "breaks", "times", "qs", "vs", "violation", "info", *along, *found)
        arrays += ("samples",) if self.operation.sampled else ()
        values = dict(zip(arrays, arrays, strict=True)) | {"settings": "own", "knots": str(len(self.inputs["breaks"]))}
        values |= {"directions": "1"} if along else {}
        columns = {name: k for k, name in enumerate(self._settings)}
        further = "".join(f", const double *{x}" for x in along) + "".join(f", double *{x}" for x in found)
        text = f"""{unit.text}
{_arrays(rows=self.inputs["rows"], breaks=self.inputs["breaks"], samples=self.inputs.get("samples", np.zeros(0)))}
static const double settings[] = {{ /* {", ".join(columns)} */
    {", ".join(map(number_text, self._settings.values()))}}};
static const int results[] = {{{", ".join(map(str, results))}}}; /* of a run, by its status */

static double larger(double a, double b) {{ return a > b ? a : b; }}

/* Integrate from ts[0] to the last time; `first` is the step to try, 0 if it is chosen. */
static int integrate(const double *numbers, const double *ts, int times, const double *q, const double *v, double *qs, double *vs,
    double *violation, double *info, double *memory, double first, double most_steps{further})
{{
    double own[sizeof settings / sizeof *settings], lengths = 0.0, angles = 0.0;
    memcpy(own, settings, sizeof settings);
    for (int i = 0; i < {self.n}; i++) {{
        if (i % 3 == 2) angles = larger(angles, fabs(v[i])); else lengths = larger(lengths, fabs(v[i]));
    }}
    own[{columns["smallest"]}] = {number_text(SMALLEST_STEP * np.finfo(float).eps)} * larger(fabs(ts[0]), fabs(ts[times - 1]));
    own[{columns["first"]}] = first;
    own[{columns["omega"]}] = larger({rate}, larger(lengths / {length}, angles));
    own[{columns["omega"]}] = larger(own[{columns["omega"]}], 1 / (ts[times - 1] - ts[0]));
    own[{columns["max_steps"]}] = most_steps;
{unit.call_record(values)}
    run_member(call, memory, 0);
    if (info[{INFO_PLACES["lost"]}] < times)
        return info[{INFO_PLACES["lost"]}] > 0 ? {int(Result.drift)} : {int(Result.initial_state_open)};
    return results[(int)info[{INFO_PLACES["code"]}]];
}}
"""
        return unit, text

    def accelerations(self) -> tuple[str, CUnit]:
        """Return the function of the accelerations at a state (`..._accelerations`)."""
        state = "const double *numbers, double t, const double *q, const double *v"
        head = f"void {self.prefix}_accelerations({state}, double *a, double *memory)"
        return self._of_state(self.evaluation, head, {"found": "a"})

    def derivatives(self) -> tuple[str, CUnit]:
        """Return the function of the accelerations with their derivative along a direction (`..._accelerations_along`)."""
        _ = self.evaluation  # raises an error for scenes without functions of single states
        operation = self.operation.acceleration_tangents
        head = f"""void {self.prefix}_accelerations_along(const double *numbers, double t, const double *q, const double *v,
    const double *dnumbers, const double *dq, const double *dv, double *a, double *da, double *memory)"""
        along = {"directions": "1", "dnumbers": "dnumbers", "dq": "dq", "dv": "dv"}
        return self._of_state(operation, head, {"found": "a", "changes": "da"} | along)

    def projection(self) -> tuple[str, CUnit]:
        """Return the function that projects a state to the constraints (`..._project`)."""
        head = f"void {self.prefix}_project(const double *numbers, double t, double *q, double *v, double *memory)"
        copied = f"    memcpy(q, found, {self.n} * sizeof *q);\n    memcpy(v, found + {self.n}, {self.n} * sizeof *v);\n"
        return self._of_state(self.evaluation.projection, head, {"found": "found"}, f"    double found[{2 * self.n}];\n", copied)

    def positions(self) -> tuple[str, CUnit]:
        """Return the function that closes positions and velocities near a guess (`..._close`)."""
        n, m = self.n, self.operation.code.row_count
        head = f"double {self.prefix}_close(const double *numbers, double t, double *q, double *v, double *memory)"
        after = f"""    memcpy(q, found, {n} * sizeof *q);
    memcpy(v, found + {n}, {n} * sizeof *v);
    for (int i = 0; i < {m}; i++) largest = fabs(left[i]) / rows[i] > largest ? fabs(left[i]) / rows[i] : largest;
    return largest;
"""
        return self._closing(self._close, head, f"    double found[{2 * n}], largest = 0.0;\n", {"state": "found"}, after)

    def position_derivatives(self) -> tuple[str, CUnit]:
        """Return the function of the derivative of a closed state along a direction (`..._close_along`)."""
        operation = self._close.with_tangents((True,) * self._close.code.number_count)
        head = f"""void {self.prefix}_close_along(const double *numbers, double t, const double *q, const double *v,
    const double *dnumbers, const double *dq, const double *dv, double *dstate, double *memory)"""
        along = {"directions": "1", "dnumbers": "dnumbers", "dq": "dq", "dv": "dv", "dstate": "dstate"}
        return self._closing(operation, head, f"    double found[{2 * self.n}];\n", {"state": "found"} | along)

    @property
    def load_names(self) -> list[tuple[str, str]]:
        """The names of the constraint and the body of each load that `reactions` computes."""
        frames = {name: self.mechanism.frames_of(x) for name, x in self.mechanism.constraints.items()}
        return [(name, body) for name, bodies in frames.items() for body in dict.fromkeys(bodies) if body != GROUND]

    def reactions(self) -> tuple[str, CUnit]:
        """Return the function of the loads of joints and the efforts of drivers (`..._reactions`)."""
        if self.operation.code.rubs:
            why = "give the friction a torque instead of a coefficient, or compute them by udkjax.reactions"
            raise ArgumentError(f"no C for reactions with friction that depends on them: {why}")
        method = self._choices._replace(method=SVD()).of_mechanism
        equations = compile_concrete(self.mechanism, self.analysis, *method).equations
        operation, names = self._evaluation(equations).reactions, self.load_names
        found = scene_inputs(equations, equations.textbook.mechanism, operation.code.policy, np)
        owners = [name for name, _ in self.analysis.row_names]
        rows, columns, places, factors = operation.code.psi_q_entries
        pairs = zip(rows, columns, strict=True)
        to = [3 * names.index((owners[i], self.mechanism.body_names[j // 3])) + j % 3 for i, j in pairs]
        own = {"row": rows, "entry": places, "load": to, "driven": [owners.index(x) for x in self.mechanism.driver_names] or [0]}
        integers = [f"    static const int {name}[] = {{{', '.join(map(str, x))}}};" for name, x in own.items()]
        m, count = len(owners), len(self._own_numbers)
        before = f"""    double found[{m + max(places) + 1}], own[{count + 2}] = {{0.0}};
{chr(10).join(integers)}
    static const double factor[] = {{{table(factors)}}};
    memcpy(own, numbers, {count} * sizeof *own);
"""
        after = f"""    memset(loads, 0, {3 * len(names)} * sizeof *loads);
    for (int i = 0; i < {len(rows)}; i++) loads[load[i]] -= factor[i] * found[{m} + entry[i]] * found[row[i]];
    for (int i = 0; i < {len(self.mechanism.driver_names)}; i++) efforts[i] = -found[driven[i]];
"""
        head = f"""void {self.prefix}_reactions(const double *numbers, double t, const double *q, const double *v, double *loads,
    double *efforts, double *memory)"""
        return self._of_state(operation, head, {"numbers": "own", "found": "found"}, before, after, found.settings)

    @property
    def _close(self) -> Close:
        return Close(scene_programs(self.mechanism).with_all_rows)

    def _closing(self, operation: Close, head: str, before: str, values: dict, after: str = "") -> tuple[str, CUnit]:
        m, scales = operation.code.row_count, self.analysis.scales
        tol, count = float(scales.rank_tol), len(self._own_numbers)
        before += f"""    double own[{count + 2}], left[{2 * m or 1}], rank[1];
    memcpy(own, numbers, {count} * sizeof *own);
    own[{count}] = {number_text(tol**2)};
    own[{count + 1}] = 0.0;
"""
        settings = {"length": scales.length, "fallback_tol": tol}
        results = {"numbers": "own", "residuals": "left", "rank": "rank"}
        return self._of_state(operation, head, results | values, before, after, settings)

    @property
    def evaluation(self) -> StateOperation:
        return self._evaluation(self.compiled.equations)

    def _evaluation(self, equations: AbstractSystem) -> StateOperation:
        operation = evaluation_of(equations)
        if operation is None:
            raise ArgumentError("no C for single states of a scene without constraints: export its run")
        if self.operation.sampled:
            raise ArgumentError("no C for single states of a scene with tables over time: export its run")
        return operation

    @property
    def _own_numbers(self) -> np.ndarray:
        """The numbers of the scene, without marks of rows and thresholds of pivots."""
        return NumberProgram(self.mechanism, {}, lambda given: given.without_origin).base

    def _of_state(
        self, operation: Operation, head: str, values: dict, before: str = "", after: str = "", settings: Any = None
    ) -> tuple[str, CUnit]:
        unit = c_unit(operation, int(operation.tangents > 0))
        found = (
            settings
            or scene_inputs(self.compiled.equations, self.compiled.textbook.mechanism, operation.code.policy, np).settings
        )
        given = np.array([float(found[name]) for name in operation.all_settings])
        record = {"numbers": "numbers", "ts": "ts", "q": "q", "v": "v", "settings": "settings", "rows": "rows", "times": "2"}
        text = f"""
{_arrays(rows=np.asarray(self.analysis.scales.rows), settings=given)}
{head}
{{
    double ts[2];
    ts[0] = ts[1] = t;
{before}{unit.call_record(record | values)}
    run_member(call, memory, 0);
{after}}}
"""
        return unit.text + text, unit

    def parameters(self, names: Sequence[str], along: bool = False) -> tuple[str, dict[str, float]]:
        """Return the C text of the function that sets parameters, and the values of these by name.

        If `along`, the function converts changes of the parameters to changes of the numbers instead.
        """
        values = scalar_parameters(self.mechanism, names)
        program = NumberProgram(self.mechanism, values, lambda given: given.without_origin)
        if any(k >= program.count for k in program.changing_numbers):
            why = "parameters move times at which the motion is not smooth"
            raise ArgumentError(f"{why}: leave out those of motion laws over time")
        name, to = ("numbers_along", "dnumbers") if along else ("numbers", "values")
        text, call = "#include <string.h>\n", f"(void)parameters, (void){to};"
        if program.changing_numbers:
            text = c_function(program.function_along() if along else program.function())
            call = f"{name}((double *)(uintptr_t)parameters, {to});"
        clear = f"    memset(dnumbers, 0, {len(self.numbers)} * sizeof *dnumbers);\n" if along else ""
        head = f"void {self.prefix}_set_parameters{'_along' if along else ''}(const double *parameters, double *{to})"
        return f"{text}\n{head}\n{{\n{clear}    {call}\n}}\n", values


def _arrays(**arrays: np.ndarray) -> str:
    """Return definitions of constant arrays in C; an empty one gets a zero, except "samples", which is left out."""
    lines = []
    for name, values in arrays.items():
        if name == "samples" and not values.size:
            continue
        lines.append(f"static const double {name}[] = {{{table(values if values.size else np.zeros(1))}}};")
    return "\n".join(lines)


def table(values: np.ndarray) -> str:
    """Return numbers as a text of C, separated by commas, six in a line."""
    texts = [number_text(float(x)) for x in np.ravel(values)]
    return ",\n    ".join(", ".join(texts[k : k + 6]) for k in range(0, len(texts), 6))


def string_text(text: str) -> str:
    """Return a text as a string constant of C, in UTF-8."""
    letters = [chr(x) if 32 <= x < 127 and chr(x) not in '"\\?' else f"\\{x:03o}" for x in text.encode()]
    return f'"{"".join(letters)}"'


def comment_text(text: str) -> str:
    """Return a text, changed so that it can stand in a comment of C."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def refuse_what_needs_python(mechanism: Mechanism) -> None:
    """Raise an error for a scene whose run needs events, which Python applies."""
    if may_stick(mechanism):
        joints = [force.joint for force in mechanism.forces.values() if getattr(force, "sticks", False)]
        names = ", ".join(map(quote, joints))
        raise ArgumentError(f'no C for joints that stick ({names}): give their friction law="smooth"')
    if mechanism.may_have_kinks and (held := kinks_of(mechanism).held):
        names = ", ".join(map(quote, held))
        raise ArgumentError(f"no C for forces with jumps or kinks that depend on the state ({names}): make them smooth")
