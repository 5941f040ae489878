"""The data of a portable engine, whose contents the docstring of the package lists."""

import base64
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.argument_types import NOT_NEGATIVE
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.integrate.compiled_mechanism import compile_concrete
from udkjax.integrate.events.law.event import ExpandsToEvents
from udkjax.integrate.native_engine import packed
from udkjax.integrate.portable.parameters import NumberProgram, guess_of, places_of_numbers, scalar_parameters
from udkjax.integrate.portable.portable_events import PortableEvents
from udkjax.integrate.portable.pull import PULL_PREFIX, with_pulls
from udkjax.integrate.prepare import AUTO, DRIFT_PROJECTED, Choices, prepare_run
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import Projection
from udkjax.native.module.steps import SMALLEST_STEP
from udkjax.native.operations import MarkRows, Operation
from udkjax.native.position_operations import Close
from udkjax.native.runs import RunStates
from udkjax.native.wasm import evaluation_module, hosted_module, wasm_module
from udkjax.positions.assembling.assembly import State
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism

DATA_FORMAT = 2  # of the data, which engine.js reads
STEPS_OF_A_PAGE = 20_000  # largest number of steps of a run in a page: with more the page would not respond for seconds


class PortableEngine(NamedTuple):
    """The engine of a mechanism as data that a page runs.

    Attributes:
        data: the engine as JSON, with the contents that the docstring of the package lists.
        numbers: the numbers of the equations as a function of the parameters, for evaluation in Python.
        mechanism: the mechanism that the engine simulates.
    """

    data: JsonObject
    numbers: NumberProgram
    mechanism: Mechanism


@checked
def portable_engine(
    mechanism: Mechanism,
    parameters: Sequence[str] = (),
    rtol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    atol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    pull: bool = True,
    runs: bool = True,
    events: Sequence[ExpandsToEvents] = (),
    drawn: bool = False,
) -> PortableEngine:
    """Compile the engine of a mechanism for pages.

    Args:
        mechanism: the scene, with concrete numbers.
        parameters: names of the numbers that may change, whole (`pin.A`) or one entry (`pin.A[0]`).
        rtol: relative tolerance of runs.
        atol: tolerance of runs, relative to the mechanism's scales, as in `simulate`.
        pull: whether a hand may pull bodies: each body gets a spring, which has no stiffness until the body is pulled.
        runs: whether the engine integrates motions; if not, it closes positions and evaluates energies, and compiles faster.
        events: the events of runs, as for `simulate`.
        drawn: whether the engine evaluates `drawn_points` as well.

    Returns:
        The `PortableEngine`.

    Raises:
        SceneError: a parameter is unknown.
        UnsupportedError: the scene, the condition of an event, or the dependence of numbers on a parameter has an operation
            without a machine instruction.
    """
    values = scalar_parameters(mechanism, parameters)
    with_own = with_pulls if pull else lambda given: given.without_origin
    analysis = analyse(mechanism)
    if _may_move_by_redundancy(mechanism, analysis):
        analysis = replace(analysis, redundant_rows=None)  # other numbers make other rows redundant: the page determines them
    watched = PortableEvents(events, with_own(mechanism), analysis)
    scene, analysis = watched.mechanism(with_own(mechanism)), watched.analysis

    def further(given: Mechanism) -> list[Any]:
        drawing = [x for _, x in drawn_points(given)] if drawn else []
        return [*(x for numbers in watched.numbers(with_own(given)) for x in numbers), *drawing]

    numbers = NumberProgram(mechanism, values, lambda given: watched.mechanism(with_own(given)), further)
    data: JsonObject = {
        "format": DATA_FORMAT,
        "bodies": list(mechanism.body_names),
        "parameters": [{"name": name, "unit": mechanism.unit_of(name), "value": x} for name, x in values.items()],
        "numbers": floats(numbers.base),
        "count": numbers.count,
        "knots": numbers.knots,
        "of_events": [sum(np.size(x) for x in found) for found in watched.numbers(with_own(mechanism))],
        "events": None,
        "sampled": [],
        "samples": "",
        "thresholds": [0.0, 0.0],
        "rows": np.asarray(analysis.scales.rows).tolist(),
        "scales": {name: float(getattr(analysis.scales, name)) for name in ("length", "rate", "mass")},
    }
    problem = _problem(scene, analysis, rtol, atol)
    operation, of_rows = _operation_of_rows(problem, watched)
    data |= _places(scene, pull) | of_rows | {"closing": _closing(analysis)}
    modules = {"close": _close(scene)}
    if data["marks"]:
        modules["mark"] = _operation(MarkRows(scene_programs(scene).with_all_rows))
    if runs and operation is not None:
        modules |= _run_modules(operation, problem, data, watched, scene)
        if data["sampled"] and any(0 <= k - numbers.count < numbers.knots for k in numbers.changing_numbers):
            raise ValueError("parameters move breakpoints of a scene that has samples: leave out those of its motion laws")
    code = scene_programs(scene, analysis.redundant_rows) if operation is None else operation.code
    modules["evaluate"] = _evaluation(mechanism, scene, code, numbers, data)
    return PortableEngine(data | {"modules": modules}, numbers, scene)


def _operation_of_rows(problem: Problem, events: PortableEvents) -> tuple[RunStates | None, JsonObject]:
    """Return the operation of runs, None if a page cannot run the scene, and the entries `marks`, `shared`, `why` of the data."""
    operation, why = problem.compiled.plan.operation, problem.compiled.plan.why_not_native
    found: JsonObject = {"marks": 0, "shared": None, "why": why}
    if why or operation is None:
        return None, found
    code = operation.code
    found["marks"] = code.row_count if code.marks_rows else 0
    if not code.shares_by_marks:
        return operation, found
    if events.phases.switches.names:  # each phase has redundant rows of its own
        return None, found | {"why": "friction depends on the loads of joints, and rows that may be redundant share these"}
    numbers = dict(zip(Operation.input_names, packed(problem), strict=False))["numbers"]
    found["shared"] = np.flatnonzero(numbers[0, code.marks] < 0).tolist()
    return replace(operation, code=code.with_shared_rows(tuple(found["shared"]))), found


def drawn_points(mechanism: Mechanism) -> list[tuple[str, Any]]:
    """Return pairs of a body and points (n, 2) in its frame (m): those through which links are drawn, and pins of one link alone.

    The list is empty for a mechanism without a drawing.
    """
    if mechanism.drawing is None:
        return []
    return [*mechanism.drawing.shapes().items(), *((body, place[None]) for body, place in mechanism.drawing.free_pins().values())]


def _may_move_by_redundancy(mechanism: Mechanism, analysis: Analysis) -> bool:
    """Return True if a mechanism may move only because some of its rows are redundant.

    This is so if rows are redundant or not known to be independent, or if there are at least as many rows, without those of
    drivers, as coordinates.
    """
    undriven = len(analysis.row_names) - len(mechanism.driver_names)
    return analysis.redundant_rows != () or undriven >= 3 * len(mechanism.bodies)


def floats(x: Any) -> str:
    """Return numbers as a text: base64 of little-endian float64."""
    return base64.b64encode(np.asarray(x, "<f8").tobytes()).decode()


def _module(code: bytes, data_end: int, **further: Any) -> JsonObject:
    return {"code": base64.b64encode(zlib.compress(code, 9)).decode(), "bytes": len(code), "data_end": data_end, **further}


def _operation(operation: Operation) -> JsonObject:
    linked, module = wasm_module(operation)
    names = {"inputs": [*Operation.input_names, *module.inputs], "results": [*module.results, *module.outputs]}
    return _module(linked.code, linked.data_end, fields=list(module.call_fields), settings=list(operation.all_settings), **names)


def _places(mechanism: Mechanism, pull: bool) -> JsonObject:
    """Return the entries `guess`, `pulls` and `masses` of the data: places in the vector of all numbers."""
    places = places_of_numbers(mechanism)
    guess = guess_of(places)
    pulls = [places.forces[PULL_PREFIX + name] for name in places.body_names] if pull else []
    held = [[*e.point.tolist(), *e.target.tolist(), int(e.stiffness), int(e.damping)] for e in pulls]
    masses = [[int(body.mass), int(body.inertia)] for body in places.bodies.values()]
    return {"guess": {x: y.tolist() for x, y in guess.items()}, "pulls": held, "masses": masses}


def _problem(mechanism: Mechanism, analysis: Analysis, rtol: float, atol: float) -> Problem:
    """Return the problem of a run, a template whose times and state the page replaces."""
    choices = Choices(rtol=rtol, atol=atol, drift_tol=DRIFT_PROJECTED, dt0=None, method=AUTO, stabilization=Projection())
    choices = choices._replace(max_steps=STEPS_OF_A_PAGE)
    compiled = compile_concrete(mechanism, analysis, *choices.of_mechanism)
    start = State(mechanism.q0, mechanism.v0)
    problem = prepare_run(compiled, analysis, np.array([0.0, 1.0]), start, None, choices, np).problem
    return replace(problem, smallest=np.asarray(0.0), rate=np.asarray(1.0))


def _run_modules(
    operation: RunStates, problem: Problem, data: JsonObject, events: PortableEvents, scene: Mechanism
) -> JsonObject:
    """Return the modules by which a page runs the scene; the entries that describe their inputs are put into `data`."""
    inputs = packed(problem)
    inputs_by_name = dict(zip(Operation.input_names, inputs, strict=False))
    data |= {
        "thresholds": inputs_by_name["numbers"][0, -2:].tolist(),
        "settings": dict(zip(operation.settings, inputs_by_name["settings"][0].tolist(), strict=True)),
        "smallest": SMALLEST_STEP,
        "info": list(RunStates.info_names),
        "drift_tol": DRIFT_PROJECTED,
        "sampled": list(operation.sampled),
        "samples": floats(inputs[len(Operation.input_names)][0]) if operation.sampled else "",
    }
    if data["shared"] is not None and "max_rank" in data["settings"]:
        data["settings"]["max_rank"] -= len(data["shared"])
    modules = {"run": _operation(events.watched_by(operation))}
    if events.events:
        instants = events.instants(operation)
        data["events"] = events.data(scene, instants, data["settings"]["atol"])
        for name, at_states in (("states", events.states_of(operation)), ("project", events.projection_of(operation))):
            (count,) = at_states.outputs((), 2)[0]
            modules[name] = _operation(at_states) | {"count": count}
        found = hosted_module(instants.functions, instants.inputs, instants.imports)
        places = {name: [place, int(np.prod(shape))] for name, (place, shape) in found.places.items()}
        modules["instants"] = _module(found.linked.code, found.linked.data_end, places=places, size=found.size)
    return modules


def _close(mechanism: Mechanism) -> JsonObject:
    return _operation(Close(scene_programs(mechanism).with_all_rows))


def _closing(analysis: Analysis) -> JsonObject:
    """Return the entry `closing` of the data."""
    length, tol = float(analysis.scales.length), float(analysis.scales.rank_tol)
    return {"thresholds": [tol**2, 0.0], "settings": [length, tol], "tol": CLOSURE.tol, "rounding": CLOSURE.rounding}


def _evaluation(
    given: Mechanism, mechanism: Mechanism, code: RunPrograms, numbers: NumberProgram, data: JsonObject
) -> JsonObject:
    """Return the module that evaluates states; `efforts`, `forces` and `friction` are put into `data`.

    `given` is the scene, and `mechanism` the one that serves all phases.
    """
    linked, evaluation = evaluation_module(code, [numbers.function()])
    data["efforts"] = [
        {"driver": name, "unit": driver.effort_unit, **places}
        for (name, driver), places in zip(mechanism.drivers.items(), _driver_places(mechanism, code), strict=True)
    ]
    shares = data["why"] or data["shared"]  # redundant rows share forces, which are not unique
    data["forces"] = [] if shares else [x for x in joint_forces(mechanism, code) if x["constraint"] in given.constraints]
    data["friction"] = any(isinstance(force, Friction) for force in mechanism.forces.values())
    return _module(linked.code, linked.data_end, places=evaluation.places, size=evaluation.size)


def _driver_places(mechanism: Mechanism, code: RunPrograms) -> list[JsonObject]:
    """Return, for each driver, its row of Psi and the place of this row in the solution of the linear system."""
    names = [name for name, _ in code.row_names]
    rows = [names.index(name) for name in mechanism.driver_names]
    return [{"row": row, "place": code.eliminated_rows[row]} for row in rows]


def joint_forces(mechanism: Mechanism, code: RunPrograms) -> list[JsonObject]:
    """Return, for each constraint at a point, terms of the force on its second body (the first if the second is the ground).

    The load of a constraint on a body is -Psi_q^T lambda = Psi_q^T x, with x the solution of the linear system for its rows. It
    is unique if no row is redundant; otherwise the share of the rows left out is arbitrary.

    Args:
        mechanism: the scene.
        code: the programs of all its rows.

    Returns:
        A list of {constraint, x, y}; the force (N) along each axis of the ground is the sum of x0[i] psi_q[j] f over the entries
        (i, j, f), without the factor psi_q if j is null.
    """
    row, column, place, factor = code.psi_q_entries
    forces, owners = [], [name for name, _ in code.row_names]
    for name, constraint in mechanism.constraints.items():
        if getattr(constraint, "points", None) is None or getattr(constraint, "coordinate", "") == "angle":
            continue
        body = constraint.bodies[0 if constraint.bodies[1] == GROUND else 1]
        start = 3 * mechanism.body_names.index(body)
        own_rows = np.flatnonzero([owner == name for owner in owners])
        terms: dict[str, list] = {"x": [], "y": []}
        for axis, entries in enumerate(terms.values()):
            for k in np.flatnonzero(np.isin(row, own_rows) & (column == start + axis)):
                where = None if place[k] == code.constant_entry else int(place[k])
                entries.append([code.eliminated_rows[int(row[k])], where, float(factor[k])])
        forces.append({"constraint": name, **terms})
    return forces
