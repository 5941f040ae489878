"""`udkjax solve`."""

from pathlib import Path

from udkjax.cli.common import Json, Scene, load, refuse, show


def solve(scene: Scene, /, at: str, out: Path | None = None, digits: int = 6, json: Json = False) -> None:
    """Solve a drawing of pins, slides and slots in one position, line by line, with numbers put in.

    Each vector loop, its position on both branches, velocities and accelerations as linear systems, polygons to scale, and the
    static forces of each link.

    Args:
        scene: the drawing, with one motor.
        at: value of the motor, such as "40 deg".
        out: page to write (.html), which also prints; by default the equations are printed as text.
        digits: significant digits of the numbers.
    """
    if out is not None and out.suffix != ".html":
        refuse(f"--out {out}: must be a page (.html)")
    if not 2 <= digits <= 15:
        refuse(f"--digits {digits}: must be from 2 to 15")
    if out is not None and not out.parent.is_dir():
        refuse(f"cannot write {out.name}: there is no folder {out.parent}")
    mech, _ = load(scene)
    import udkjax as udk

    solution = udk.worked_solution(mech, at, digits)
    results: dict[str, object] = {
        "title": solution.title,
        "lines": [line.text(solution.style) for line in solution.lines],
        "residual": solution.residual,
        "files": [] if out is None else [out],
    }
    if out is None:
        show(results, str(solution), json)
        return
    solution.save(out)
    show(results, f"wrote {out}", json)
