"""`udkjax exercise`."""

import csv
from pathlib import Path

from udkjax.cli.common import Json, Scene, load, refuse, show
from udkjax.cli.options import NotNegativeCount, PositiveCount, refuse_without_effect

MOST_STUDENTS = 2000


def exercise(
    scene: Scene,
    /,
    vary: tuple[str, ...],
    out: Path,
    at: str = "40 deg",
    count: PositiveCount | None = None,
    students: Path | None = None,
    seed: NotNegativeCount = 0,
    json: Json = False,
) -> None:
    """Write an exercise for each student with numbers of their own, its solution, and a table of all answers.

    All numbers assemble, turn all the way round if the drawing does, and differ. The same seed gives the same files.

    Args:
        scene: the drawing, with one motor.
        vary: numbers that differ, with their ranges, such as "length(crank) 35..45 mm", "number.r 30..50" or "at 20..70 deg".
        out: folder to write; teacher.csv is the table.
        at: value of the motor, unless it is varied.
        count: number of students, called student 1, student 2, ...
        students: instead, a table (.csv) with their names in the first column.
        seed: seed of the numbers.
    """
    if (count is None) == (students is None):
        refuse("give --count or --students")
    if any(text.split()[:1] == ["at"] for text in vary):
        refuse_without_effect(["--at"], "if --vary has a range of it")
    names = _names(students) if students is not None else [f"student {k + 1}" for k in range(count or 0)]
    if not 0 < len(names) <= MOST_STUDENTS:
        refuse(f"{len(names)} students: must be from 1 to {MOST_STUDENTS}")
    if out.exists() and not out.is_dir():
        refuse(f"--out {out} is not a folder")
    mech, _ = load(scene)
    from udkjax.study.worked.exercises import write_course

    found, files = write_course(mech, vary, names, at, seed, out)
    results = {"files": files, "students": {one.student: {"numbers": one.numbers, "answers": one.answers()} for one in found}}
    show(results, f"wrote {len(files)} files to {out}", json)


def _names(path: Path) -> list[str]:
    """Return the names in the first column of a table (.csv), without a heading; exit with a message if it cannot be read."""
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        refuse(f"cannot read {path}: {problem}")
    names = [row[0].strip() for row in rows if row and row[0].strip()]
    return names[1:] if names and names[0].lower() in ("name", "names", "student", "students") else names
