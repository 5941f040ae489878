"""What the command line says about a mechanism and about a run."""

from udkjax.equations.analysis import analyse
from udkjax.integrate import Solution
from udkjax.scene import Mechanism
from udkjax.study.accuracy import Accuracy
from udkjax.study.row_labels import row_label
from udkjax.study.wording import plural


def check_summary(mech: Mechanism, check) -> str:
    """Describe what `udkjax.integrate.assembly.check` found in a mechanism."""
    lines = {
        "bodies": f"{check.bodies}",
        "coordinates": f"{check.coordinates}",
        "constraint rows": f"{check.rows} in {plural(len(mech.joints), 'joint')} and {plural(len(mech.drivers), 'driver')}",
        "rank": f"{check.rank}",
        "degrees of freedom": f"{check.degrees_of_freedom}",
        "redundant rows": ", ".join(row_label(mech, *row) for row in check.redundant) or "none",
    }
    if check.dependent:
        lines["depend on each other"] = ", ".join(check.dependent)
    found = analyse(mech)
    lines["length, time, mass"] = f"{float(found.length):.3g} m, {float(found.time):.3g} s, {float(found.mass):.3g} kg"
    lines["closure, as given"] = f"{float(check.residual_before):.2e}"
    lines["closure, assembled"] = f"{float(check.residual_after):.2e}" + ("" if check.closed else ": it does not close")
    return table(mech.name or "mechanism", lines)


def run_summary(mech: Mechanism, sol: Solution, accuracy: Accuracy, seconds: float, compiling: float) -> str:
    """Describe how a run ended, what it took and how far it can be trusted."""
    lines = {
        "result": sol.cause if sol.result else sol.result.name,
        "work": work(sol),
        **trust(accuracy),
        "time": f"{seconds:.2f} s, {compiling:.2f} s of it to compile",
    }
    return table(f"{mech.name or 'mechanism'}, {float(sol.ts[0]):g} to {float(sol.ts[-1]):g} s, {len(sol.ts)} instants", lines)


def work(sol: Solution) -> str:
    """Describe what a run took; a count of -1 is not known."""
    named = {
        "steps": "steps",
        "rejected": "rejected",
        "right_hand_sides": "right-hand sides",
        "projections": "projections",
    }
    return ", ".join(f"{int(sol.stats[key])} {name}" for key, name in named.items() if int(sol.stats.get(key, -1)) >= 0)


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
    width = max(map(len, lines), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {value}" for name, value in lines.items())])
