"""What the command line says about a mechanism and about a run."""

from collections.abc import Sequence

from udkjax.integrate import Solution
from udkjax.integrate.assembly import Check, check_lines, numbered
from udkjax.integrate.solution import format_work
from udkjax.printing import align_columns
from udkjax.scene import Mechanism
from udkjax.study.accuracy import Accuracy
from udkjax.study.row_labels import row_label
from udkjax.study.wording import plural


def check_summary(mech: Mechanism, found: Check) -> str:
    """Describe what `udkjax.integrate.assembly.check` found in a mechanism."""
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
        "time": f"{seconds:.2f} s, {compiling:.2f} s of it to compile",
    }
    return table(f"{mech.name or 'mechanism'}, {float(sol.ts[0]):g} to {float(sol.ts[-1]):g} s, {len(sol.ts)} instants", lines)


def trust(accuracy: Accuracy) -> dict[str, str]:
    """Describe the largest violation, the change of the energy and, where one is known, the error against the exact solution."""
    lines = {
        "violation": f"{accuracy.violation:.2e} m or rad at most",
        "energy": f"changes by {accuracy.energy_change:.2e} J at most; kinetic up to {accuracy.kinetic_energy:.3g} J",
    }
    if accuracy.error is not None:
        lines["exact solution"] = f"missed by {accuracy.error:.2e} m or rad at most"
    return lines


def table(title: str, lines: dict[str, str]) -> str:
    """Lay out names and values below a title."""
    return "\n".join([title, *align_columns(list(lines.items()))])
