"""`udkjax design`."""

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from udkjax.cli.common import Json, fail, refuse, show
from udkjax.cli.exits import NO_FIT
from udkjax.cli.options import NotNegative, NotNegativeCount, Positive, PositiveCount, refuse_without_effect
from udkjax.extras import OptionalImport

with OptionalImport():
    import tyro

Goal = Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="GOAL.toml")]

TURN_INSTANTS = 241  # of a turn on a page
OF_CURVES = "--bars", "--size", "--seconds", "--geared", "--slides", "--unit"  # options
NOT_A_FIT = 0.1  # error of a mechanism, in RMS radii of its curve, beyond which it draws another curve


def design(
    goal: Goal = None,
    /,
    starts: PositiveCount = 300,
    seed: NotNegativeCount = 0,
    results: PositiveCount = 5,
    out: Path | None = None,
    curve: Path | None = None,
    bars: PositiveCount = 12,
    size: Positive | None = None,
    seconds: NotNegative = 60.0,
    geared: bool = True,
    slides: bool = False,
    unit: str = "mm",
    json: Json = False,
) -> None:
    """Find mechanisms for a prescribed path, poses, or function; or, with --curve, for a drawn curve.

    The command exits with 1 if no mechanism is found, and with 3 if the best one is not a fit: it misses a target by more than a
    tenth of their extent, or a curve by more than a tenth of its RMS radius.

    The loss of a design is the weighted sum of squares of its residuals, the distances from the goal. With `complete = true` in
    the file, all four-bars through nine points, or five poses, are found, without --starts and --seed.

    With --curve no drawing is needed: structure and dimensions of linkages with one motor are found. Ctrl-C ends this search with
    the best designs so far.

    Args:
        goal: file with the mechanism, the goal and the limits.
        starts: number of random mechanisms to start from.
        seed: seed of the random mechanisms; the same seed gives the same designs.
        results: maximum number of designs to return.
        out: folder for each design as a drawing (design1.toml) and as an animated page (design1.html).
        curve: file with a curve instead of a goal: rows x, y (.csv), or a drawing in one stroke (.svg).
        bars: largest number of links for a curve, with the ground.
        size: for a curve, the largest distance of any pin from its middle, in its unit; by default three times its extent.
        seconds: CPU time after which the search for a curve ends (s).
        geared: whether mechanisms for a curve may have a second crank, joined to the first by a belt.
        slides: whether a third of their dyads has a slide or a rail in the place of a pin.
        unit: unit of the curve and of the drawings.
    """
    if curve is None:
        refuse_without_effect(OF_CURVES, "without --curve")
    elif goal is None:
        refuse_without_effect(["--starts"], "with --curve: its search ends after --seconds")
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            refuse(f"cannot write --out {out}: {problem}")
    if goal is None and curve is not None:
        given = {"bars": bars, "seed": seed, "results": results, "seconds": seconds, "geared": geared, "slides": slides}
        _show_curve(curve, given, size, unit, out, json)
        return
    if goal is None or curve is not None:
        refuse("give either a goal file or --curve FILE")
    from udkjax.show.summary import table
    from udkjax.synthesis.complete.complete_design import CompleteSearch
    from udkjax.synthesis.fit import design_lines, deviation_of
    from udkjax.synthesis.goal_file import read_design

    try:
        search = read_design(goal)
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {goal}: {problem}")
    if isinstance(search, CompleteSearch):
        refuse_without_effect(["--starts", "--seed"], f"with complete = true in {goal}, which finds all four-bars")
        _show_all(goal, search, results, out, json)
        return
    designs = search(starts, seed, results)
    mech = search.problem.mechanism
    lines = {"starts": f"{starts}; {len(designs.losses)} ended within the limits"}
    reports = [design_lines(candidate, search.problem.goal) for candidate in designs]
    tables = [table(f"design {k + 1}: loss {designs[k].loss:.8g}", report) for k, report in enumerate(reports)]
    if out is not None:
        lines["files in"] = _write(designs, search.problem.goal, out)
    listed = [
        {
            "loss": candidate.loss,
            "report": report,
            "transmission": candidate.transmission,
            "turns": candidate.turns,
            "values": candidate.values,
            "residuals": candidate.residuals,
            "parameters": candidate.parameters,
        }
        for candidate, report in zip(designs, reports, strict=True)
    ]
    show(
        {"starts": starts, "losses": designs.losses, "reason": designs.reason, "designs": listed},
        "\n\n".join([table(f"designs of {mech.name or 'a mechanism'}", lines), *tables]),
        json,
    )
    if not len(designs):
        fail(f"no mechanism was found: {designs.reason}")
    if not deviation_of(designs[0], search.problem.goal).is_fit:
        fail(reports[0]["deviation"], NO_FIT)


def _show_curve(file: Path, options: dict[str, Any], size: float | None, unit: str, out: Path | None, json: bool) -> None:
    """Find mechanisms for the curve in a file, show them, and write them to the folder `out`, unless it is None.

    The command exits with a message if the curve cannot be read, or if no mechanism fits it.
    """
    import udkjax as udk
    from udkjax.scene.drawing.drawn_quantities import Units
    from udkjax.synthesis.curves.curve_file import read_curve_file

    if unit not in Units.sizes("m"):
        refuse(f"--unit {unit}: must be one of {', '.join(Units.sizes('m'))}")
    metres = Units.sizes("m")[unit]
    try:
        points = metres * read_curve_file(file)
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {file}: {problem}")
    except ValueError as problem:
        refuse(str(problem))
    options["size"] = None if size is None else metres * size
    try:
        found = udk.mechanisms_for(points, unit=unit, **options)
    except ValueError as problem:
        refuse(f"--{problem}" if str(problem).split()[0] in options else f"{file}: {problem}")
    if out is not None:
        for k, candidate in enumerate(found):
            udk.save(candidate.mechanism, out / f"design{k + 1}.toml")
            _moving_page(candidate, [candidate.pin], points).save(out / f"design{k + 1}.html")
    names = ("error", "bars", "size", "transmission", "turns", "values", "pins", "curve")
    listed = [{name: getattr(candidate, name) for name in names} for candidate in found]
    text = "\n\n".join(map(str, (found, *found)))
    show({"rounds": found.rounds, "seconds": found.seconds, "reason": found.reason, "designs": listed}, text, json)
    if not len(found):
        fail(f"no mechanism was found: {found.reason}")
    if found[0].error > NOT_A_FIT:
        fail(f"not a fit: the best mechanism misses the curve by {found[0].error:.3g} of its RMS radius", NO_FIT)


def _show_all(file: Path, search: Any, results: int, out: Path | None, json: bool) -> None:
    """Find all solutions of a goal, show their number and the first `results` of them, and write these to `out` if given."""
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
    """Write each design as a drawing and as a page; return the folder."""
    import udkjax as udk

    for k, candidate in enumerate(designs):
        udk.save(candidate.mechanism, out / f"design{k + 1}.toml")
        _page(candidate, goal).save(out / f"design{k + 1}.html")
    return str(out)


def _page(candidate: Any, goal: Any) -> Any:
    import udkjax as udk

    traces = [goal.point] if isinstance(goal, udk.PathGoal) and goal.at is None else None
    traces = [goal.pin] if isinstance(goal, udk.CurveGoal) else traces
    return _moving_page(candidate, traces, goal.targets[:, :2] if goal.has_place else None)


def _moving_page(candidate: Any, traces: list[str] | None, targets: Any) -> Any:
    """Return a design as a page with the targets: live for one turn of its motor, or else its motion over the driver's values.

    Args:
        candidate: the design.
        traces: points whose paths are drawn; None for the moving pins.
        targets: wanted places (n, 2) on the ground (m); None for none.
    """
    import numpy as np

    import udkjax as udk
    from udkjax.positions.following.drive import constant_speed

    mech, driver = candidate.mechanism, candidate.driver
    speed = constant_speed(mech, driver) if isinstance(driver, str) else 0.0
    if candidate.turns and speed:
        sol = udk.simulate(mech, np.linspace(0.0, 2 * np.pi / abs(speed), TURN_INSTANTS), throw=False)
        live = [name for name in mech.independent_parameters() if name.startswith("pin.") or name == f"motor.{driver}.speed"]
        with contextlib.suppress(ValueError):  # a page cannot simulate it
            return udk.animate(mech, sol, traces=traces, targets=targets, live=live)
    return udk.animate(mech, candidate.motion(), measures=(), traces=traces, targets=targets)
