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
    for name, value, least in (("starts", starts, 1), ("results", results, 1), ("seed", seed, 0)):
        if value < least:
            refuse(f"--{name} {value}: must be at least {least}")
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
    found = search(starts, seed, results)
    mech = search.problem.mechanism
    lines = {"starts": f"{starts}; {len(found.losses)} ended within the limits"}
    for k, one in enumerate(found):
        lines[f"design {k + 1}"] = f"loss {one.loss:.8g}, largest residual {np.max(np.abs(one.residuals)):.3g}"
    if out is not None:
        lines["files in"] = _write(found, search.problem.goal, out)
    listed = [
        {
            "loss": one.loss,
            "transmission": one.transmission,
            "turns": one.turns,
            "values": one.values,
            "residuals": one.residuals,
            "parameters": one.parameters,
        }
        for one in found
    ]
    show(
        {"starts": starts, "losses": found.losses, "reason": found.reason, "designs": listed},
        table(f"designs of {mech.name or 'a mechanism'}", lines),
        json,
    )
    if not len(found):
        fail(f"no mechanism was found: {found.reason}")


def _show_all(file: Path, search: Any, results: int, out: Path | None, json: bool) -> None:
    """Find all solutions of a goal; show their numbers, and the first ones."""
    import udkjax as udk
    from udkjax.show.summary import table

    try:
        found = search()
    except ValueError as problem:
        if isinstance(problem, udk.SceneError):
            raise
        refuse(f"{file}: {problem}")
    chosen = [found[k] for k in range(min(results, len(found)))]
    lines = {"solutions": ", ".join(f"{count} {name}" for name, count in found.paths.items())}
    lines["real solutions"] = f"{found.classes} proven, {found.unproven} unproven; {len(found)} four-bars"
    for name in dict.fromkeys(found.defects):
        lines[f"defect {name}"] = str(found.defects.count(name))
    for k, one in enumerate(chosen):
        lines[f"design {k + 1}"] = f"{one.kind}, defect {one.defect}, transmission {one.transmission:.3g}, class {one.number}"
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
    listed = [{name: getattr(one, name) for name in (*names, "values", "pins")} for one in chosen]
    counts = {"solutions": found.paths, "classes": found.classes, "unproven": found.unproven, "four_bars": len(found)}
    counts |= {"beyond_limits": found.left_out, "others": [{"kind": kind, "pins": pins} for kind, pins in found.others]}
    show({**counts, "designs": listed}, table(f"four-bars of {found.mechanism.name or 'a drawing'}", lines), json)
    if not len(found):
        beyond = f" within the limits; {found.left_out} are beyond them" if found.left_out else ""
        fail(f"no real four-bar meets the goal exactly{beyond}: remove complete = true to find the nearest")


def _write(found: Iterable[Any], goal: Any, out: Path) -> str:
    """Write each design as a drawing and as an animated page; return the folder."""
    import udkjax as udk

    out.mkdir(parents=True, exist_ok=True)
    traces = [goal.point] if isinstance(goal, udk.PathGoal) else None
    for k, one in enumerate(found):
        udk.save(one.mechanism, out / f"design{k + 1}.toml")
        udk.animate(one.mechanism, one.motion(), measures=(), traces=traces).save(out / f"design{k + 1}.html")
    return str(out)
