"""`udkjax design`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from udkjax.cli.common import Json, fail, refuse, show
from udkjax.extras import OptionalImport

with OptionalImport():
    import tyro

Goal = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="GOAL.toml")]


def design(
    goal: Goal,
    /,
    starts: int = 300,
    seed: int = 0,
    results: int = 5,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Find mechanisms for a prescribed path, poses, or function; exit with 1 if no mechanism is found.

    The loss of a design is the weighted sum of squares of its residuals, the distances from the goal. With `complete = true` in
    the file, all four-bars through nine points, or five poses, are found, and --starts and --seed are ignored.

    Args:
        goal: file with the mechanism, the goal and the limits.
        starts: number of random mechanisms to start from.
        seed: seed of the random mechanisms; the same seed gives the same designs.
        results: maximum number of designs to return.
        out: folder for each design as a drawing (design1.toml) and as an animated page (design1.html).
    """
    for name, value, minimum in (("starts", starts, 1), ("results", results, 1), ("seed", seed, 0)):
        if value < minimum:
            refuse(f"--{name} {value}: must be at least {minimum}")
    import numpy as np

    from udkjax.show.summary import table
    from udkjax.synthesis.complete.complete_design import CompleteSearch
    from udkjax.synthesis.goal_file import read_design

    try:
        search = read_design(goal)
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {goal}: {problem}")
    if isinstance(search, CompleteSearch):
        _show_all(goal, search, results, out, json)
        return
    designs = search(starts, seed, results)
    mech = search.problem.mechanism
    lines = {"starts": f"{starts}; {len(designs.losses)} ended within the limits"}
    for k, candidate in enumerate(designs):
        lines[f"design {k + 1}"] = f"loss {candidate.loss:.8g}, largest residual {np.max(np.abs(candidate.residuals)):.3g}"
    if out is not None:
        lines["files in"] = _write(designs, search.problem.goal, out)
    listed = [
        {
            "loss": candidate.loss,
            "transmission": candidate.transmission,
            "turns": candidate.turns,
            "values": candidate.values,
            "residuals": candidate.residuals,
            "parameters": candidate.parameters,
        }
        for candidate in designs
    ]
    show(
        {"starts": starts, "losses": designs.losses, "reason": designs.reason, "designs": listed},
        table(f"designs of {mech.name or 'a mechanism'}", lines),
        json,
    )
    if not len(designs):
        fail(f"no mechanism was found: {designs.reason}")


def _show_all(file: Path, search: Any, results: int, out: Path | None, json: bool) -> None:
    """Find all solutions of a goal; show how many there are, and list the first."""
    import udkjax as udk
    from udkjax.show.summary import table

    try:
        solutions = search()
    except ValueError as problem:
        if isinstance(problem, udk.SceneError):
            raise
        refuse(f"{file}: {problem}")
    chosen = [solutions[k] for k in range(min(results, len(solutions)))]
    lines = {"solutions": ", ".join(f"{count} {name}" for name, count in solutions.paths.items())}
    lines["real solutions"] = f"{solutions.classes} proven, {solutions.unproven} unproven; {len(solutions)} four-bars"
    for name in dict.fromkeys(solutions.defects):
        lines[f"defect {name}"] = str(solutions.defects.count(name))
    for k, solution in enumerate(chosen):
        lines[f"design {k + 1}"] = (
            f"{solution.kind}, defect {solution.defect}, transmission {solution.transmission:.3g}, class {solution.number}"
        )
    if out is not None:
        lines["files in"] = _write(chosen, search.goal, out)
    names = (
        "kind",
        "turns",
        "defect",
        "circuits",
        "branches",
        "order",
        "transmission",
        "confirmed",
        "radius",
        "number",
        "cognate",
    )
    listed = [{name: getattr(solution, name) for name in (*names, "values", "pins")} for solution in chosen]
    counts = {
        "solutions": solutions.paths,
        "classes": solutions.classes,
        "unproven": solutions.unproven,
        "four_bars": len(solutions),
    }
    counts |= {"beyond_limits": solutions.left_out, "others": [{"kind": kind, "pins": pins} for kind, pins in solutions.others]}
    show({**counts, "designs": listed}, table(f"four-bars of {solutions.mechanism.name or 'a drawing'}", lines), json)
    if not len(solutions):
        beyond = f" within the limits; {solutions.left_out} are beyond them" if solutions.left_out else ""
        fail(f"no real four-bar meets the goal exactly{beyond}: remove complete = true to find the nearest")


def _write(designs: Iterable[Any], goal: Any, out: Path) -> str:
    """Write each design as a drawing and as an animated page; return the folder."""
    import udkjax as udk

    out.mkdir(parents=True, exist_ok=True)
    traces = [goal.point] if isinstance(goal, udk.PathGoal) else None
    for k, candidate in enumerate(designs):
        udk.save(candidate.mechanism, out / f"design{k + 1}.toml")
        udk.animate(candidate.mechanism, candidate.motion(), measures=(), traces=traces).save(out / f"design{k + 1}.html")
    return str(out)
