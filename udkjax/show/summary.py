"""Texts of the command line about a mechanism and about a run."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike

from udkjax.equations import efforts
from udkjax.integrate import Solution
from udkjax.integrate.solution import format_work
from udkjax.positions.assembly import Check, check_lines, numbered
from udkjax.printing import align_columns, format_number
from udkjax.scene import Mechanism
from udkjax.scene.wording import plural, row_label
from udkjax.study.accuracy import Accuracy


def check_summary(mech: Mechanism, found: Check) -> str:
    """Describe the findings of `udkjax.positions.assembly.check` in a mechanism."""
    lines = check_lines(found)
    lines["constraint rows"] += f" in {plural(len(mech.joints), 'joint')} and {plural(len(mech.drivers), 'driver')}"
    lines["redundant rows"] = ", ".join(row_label(mech, *row) for row in found.redundant) or "none"
    return table(mech.name or "mechanism", lines)


def run_summary(
    mech: Mechanism, sol: Solution, accuracy: Accuracy, seconds: float, compiling: float, moved: Sequence[str] = ()
) -> str:
    """Describe how a run ended, how far assembly `moved` bodies before it, what it took and how far it can be trusted."""
    lines = {
        "result": sol.cause if sol.result else sol.result.name,
        **numbered("assembly", [text.removeprefix("assembly ") for text in moved]),
        "work": format_work(sol.stats),
        **trust(accuracy),
        **{name: format_peak(sol.ts, x, mech.drivers[name].effort_unit) for name, x in efforts(mech, sol).items()},
        "time": f"{seconds:.2f} s, {compiling:.2f} s of it to compile",
    }
    return table(f"{mech.name or 'mechanism'}, {float(sol.ts[0]):g} to {float(sol.ts[-1]):g} s, {len(sol.ts)} instants", lines)


def trust(accuracy: Accuracy) -> dict[str, str]:
    """Describe the largest violation, the energy and, where one is known, the error against the exact solution."""
    kinetic = f"kinetic up to {accuracy.kinetic_energy:.3g} J"
    if accuracy.work is None:
        changed = f"changes by {format_error(accuracy.energy_change, accuracy.kinetic_energy)} J at most, where nothing does work"
    else:
        changed = f"drivers, dampers and loads do {accuracy.work:.6g} J of work"
    lines = {
        "violation": f"{format_error(accuracy.violation, accuracy.length)} m or rad at most",
        "energy": f"{changed}; {kinetic}",
    }
    if accuracy.error is not None:
        lines["exact solution"] = f"missed by {format_error(accuracy.error, accuracy.length)} m or rad at most"
    return lines


def format_peak(ts: ArrayLike, effort: ArrayLike, unit: str) -> str:
    """Describe the effort of a driver over time: its peak and its root mean square."""
    x = np.asarray(effort, float)
    good = x[np.isfinite(x)]
    if not good.size:
        return "exerts nothing that is known"
    k = int(np.nanargmax(np.abs(x)))
    return f"peak {format_number(x[k], unit)} at {np.asarray(ts)[k]:g} s, root mean square {np.sqrt(np.mean(good**2)):.6g} {unit}"


def format_error(error: float, scale: float) -> str:
    """Return an error with the digits that matter; 0 where it is rounding beside a scale."""
    return "0" if format_number(error, scale=scale) == "0" else f"{error:.2e}"


def table(title: str, lines: dict[str, str]) -> str:
    """Lay out names and values below a title."""
    return "\n".join([title, *align_columns(list(lines.items()))])
