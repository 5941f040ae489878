"""Command line summaries of a mechanism and of a run."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.equations.states.quantities import efforts
from udkjax.integrate import Solution
from udkjax.integrate.solution import format_work
from udkjax.positions.answers.scene_check import Check
from udkjax.printing import align_columns, format_number
from udkjax.scene.mechanism import Mechanism
from udkjax.study.accuracy import Accuracy
from udkjax.study.report import row_label
from udkjax.wording import join_names, numbered, plural


def check_summary(mech: Mechanism, check: Check) -> str:
    """Return the findings of `udkjax.positions.answers.scene_check.check` about a mechanism as a table of text."""
    lines = check.lines()
    lines["constraint equations"] += f" in {plural(len(mech.joints), 'joint')} and {plural(len(mech.drivers), 'driver')}"
    lines["redundant constraints"] = ", ".join(row_label(mech, *row) for row in check.redundant) or "none"
    lengths = {} if mech.drawing is None or mech.departs_from_drawing else mech.drawing.length_texts()
    lines |= {f"length of {name}": text for name, text in lengths.items()}
    touching = [] if mech.drawing is None else mech.drawing.touching_pins()
    if touching:
        lines["without derivatives"] = f"the places of {join_names(touching)}: circles only touch there"
    return table(mech.name or "mechanism", lines)


def run_summary(
    mech: Mechanism, sol: Solution, accuracy: Accuracy, seconds: float, compiling: float, moved: Sequence[str] = ()
) -> str:
    """Return the result, work, accuracy and time of a run as a table of text.

    Args:
        mech: the mechanism.
        sol: the run.
        accuracy: the accuracy of the run.
        seconds: wall time of the run (s).
        compiling: the part of this time that was spent on compiling (s).
        moved: descriptions of moves by assembly, the result of `moves_of_assembly`.
    """
    lines = {
        "result": sol.cause if sol.result else sol.result.name,
        **numbered("assembly", [text.removeprefix("assembly ") for text in moved]),
        "work": format_work(sol.stats),
        **trust(accuracy),
        **{name: format_peak(sol.ts, x, mech.drivers[name].effort_unit) for name, x in known_efforts(mech, sol).items()},
        "time": f"{seconds:.2f} s, including {compiling:.2f} s to compile",
    }
    span = f"{float(sol.ts[0]):g} to {float(sol.ts[-1]):g} s"
    return table(f"{mech.name or 'mechanism'}, {span}, {len(sol.ts)} output times", lines)


def known_efforts(mech: Mechanism, sol: Solution) -> dict[str, Array]:
    """Return the efforts (torques or forces) of the drivers over time; {} if a link has no mass, since they are unknown then."""
    return {} if mech.massless else efforts(mech, sol)


def trust(accuracy: Accuracy) -> dict[str, str]:
    """Return the lines of a summary, by title, about constraint violation, energy and, if it is known, error of the solution."""
    kinetic = f"kinetic up to {accuracy.kinetic_energy:.3g} J"
    if accuracy.work is None:
        change = format_error(accuracy.energy_change, accuracy.kinetic_energy)
        changed = f"changes by at most {change} J, although no work is done"
    else:
        changed = f"drivers, dampers and loads do {accuracy.work:.6g} J of work"
    lines = {
        "constraint violation": f"at most {format_error(accuracy.violation, accuracy.length)} m or rad",
        **({} if np.isnan(accuracy.kinetic_energy) else {"energy": f"{changed}; {kinetic}"}),
    }
    if accuracy.error is not None:
        lines["exact solution"] = f"error of at most {format_error(accuracy.error, accuracy.length)} m or rad"
    return lines


def format_peak(ts: ArrayLike, effort: ArrayLike, unit: str) -> str:
    """Return the peak and the root mean square of a driver's torque or force as text; "unknown" if no value is finite."""
    x = np.asarray(effort, float)
    good = x[np.isfinite(x)]
    if not good.size:
        return "unknown"
    k = int(np.nanargmax(np.abs(x)))
    return f"peak {format_number(x[k], unit)} at {np.asarray(ts)[k]:g} s, root mean square {np.sqrt(np.mean(good**2)):.6g} {unit}"


def format_error(error: float, scale: float) -> str:
    """Return an error with three digits; 0 if it is a rounding error relative to a scale."""
    return "0" if format_number(error, scale=scale) == "0" else f"{error:.2e}"


def table(title: str, lines: dict[str, str]) -> str:
    """Return names and values in columns below a title."""
    return "\n".join([title, *align_columns(list(lines.items()))])
