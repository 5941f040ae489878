"""`udkjax design`."""

from pathlib import Path
from typing import Annotated

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
    """Find mechanisms that move as a goal says: a path, poses, or a function; exit with 1 where there is none.

    Args:
        goal: file with the mechanism, the goal and the limits.
        starts: from how many random mechanisms.
        seed: of these; the same seed gives the same designs.
        results: how many designs, at most.
        out: folder for each design as a drawing (design1.toml) and as a page that moves (design1.html).
    """
    for name, value, least in (("starts", starts, 1), ("results", results, 1), ("seed", seed, 0)):
        if value < least:
            refuse(f"--{name} {value}: must be at least {least}")
    import numpy as np

    import udkjax as udk
    from udkjax.show.summary import table
    from udkjax.study.design.goal_file import read_design

    try:
        search = read_design(goal)
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {goal}: {problem}")
    found = search(starts, seed, results)
    mech = search.problem.mechanism
    lines = {"starts": f"{starts}, of which {len(found.losses)} ended within the limits"}
    for k, one in enumerate(found):
        lines[f"design {k + 1}"] = f"loss {one.loss:.8g}, largest residual {np.max(np.abs(one.residuals)):.3g}"
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for k, one in enumerate(found):
            udk.save(one.mechanism, out / f"design{k + 1}.toml")
            traces = [search.problem.goal.point] if isinstance(search.problem.goal, udk.PathGoal) else None
            udk.animate(one.mechanism, one.motion(), measures=(), traces=traces).save(out / f"design{k + 1}.html")
        lines["written"] = str(out)
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
        {"starts": starts, "losses": found.losses, "designs": listed},
        table(f"designs of {mech.name or 'a mechanism'}", lines),
        json,
    )
    if not len(found):
        fail("nothing was found within the limits: give more --starts, or wider bounds")
