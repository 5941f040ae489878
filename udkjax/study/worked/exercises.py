"""Exercises with different numbers for each student: random dimensions of a working mechanism, with sheets and solutions."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from udkjax.positions.answers.counting import Count
from udkjax.positions.assembling.assembly import AssemblyError
from udkjax.positions.following.drive import only_driver
from udkjax.positions.following.travel import travel
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.numbers.quantities import conversion_factor
from udkjax.scene.tables.checks import SceneError
from udkjax.study.worked.page import sheet_of
from udkjax.study.worked.solution import WorkedSolution, worked_solution
from udkjax.wording import quote, suggestion

MOST_TRIALS = 500  # for one student: dimensions that assemble and turn may be rare
STEPS_PER_STUDENT = 4  # steps of a range for each student: all students can have different numbers
AT_NAME = "at"  # the name of the driver's value among the varied numbers
_RANGE = re.compile(r"\s*(.+?)\s+([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*\.\.\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*")


class Variation(NamedTuple):
    """A number that differs between students.

    Attributes:
        title: the number as it was written, such as length(crank).
        name: name of the parameter, or "at" for the value of the driver.
        low, high: range of the number, in `unit`.
        unit: unit in which the number is shown.
        size: the size of `unit` in the unit of the parameter.
    """

    title: str
    name: str
    low: float
    high: float
    unit: str
    size: float


class Exercise(NamedTuple):
    """The exercise of one student: numbers by title, in their units, and the solution."""

    student: str
    numbers: dict[str, float]
    solution: WorkedSolution

    def answers(self) -> dict[str, float]:
        """Return the answers by name, in the units of the drawing.

        These are the places, velocities and accelerations of pins, and the angles, angular velocities and accelerations of links.
        """
        found, motion, style = {}, self.solution.motion, self.solution.style
        for pin, values in motion.pins.items():
            for name, unit, (x, y) in zip(("", "v", "a"), ("m", "m/s", "m/s2"), np.asarray(values)[0], strict=True):
                shown = style.size(unit)
                found |= {f"{pin}.{name}{axis} ({style.unit(unit)})": float(z) / shown for axis, z in (("x", x), ("y", y))}
        for link, values in motion.links.items():
            angle, omega, alpha = np.asarray(values)[0].tolist()
            found |= {f"{link}.angle (deg)": float(np.degrees(angle)), f"{link}.omega (rad/s)": omega}
            found[f"{link}.alpha (rad/s²)"] = alpha
        return found


def read_variation(mechanism: Mechanism, text: str) -> Variation:
    """Return the varied number of a text, such as "length(crank) 35..45 mm", "number.r 30..50" or "at 20..70 deg".

    Raises:
        SceneError: the text cannot be read, or the drawing does not give the length of a link.
    """
    match, drawing = _RANGE.fullmatch(text), mechanism.drawing
    if match is None or not isinstance(drawing, Drawing):
        raise SceneError([f'vary: {quote(text)} must be a number and its range, such as "length(crank) 35..45 mm"'])
    title, unit, units = match[1], match[4] or "", Units(dict(drawing.units))
    try:
        low, high = float(match[2]), float(match[3])
    except ValueError as problem:  # two points in a number
        raise SceneError([f"vary: {quote(text)}: {problem}"]) from None
    if not -np.inf < low < high < np.inf:
        raise SceneError([f"vary: {quote(text)}: the range must increase, between finite numbers"])
    if title == AT_NAME:
        return Variation(title, AT_NAME, low, high, unit or Count.of(mechanism, only_driver(mechanism)).unit, 1.0)
    length = re.fullmatch(r"length\((.+)\)", title)
    name = title if length is None else _length_parameter(drawing, length[1])
    known = mechanism.parameters()
    owner, _ = split_index(name, known)
    if owner not in known or np.ndim(known[owner]) != len(re.findall(r"\[", name)):
        raise SceneError([f"vary: no number named {quote(name)}{suggestion(name, known)}"])
    own = mechanism.unit_of(name)
    unit = unit or (units.shown(own) if own else "")
    try:
        return Variation(title, name, low, high, unit, conversion_factor(unit, own) if own and unit else 1.0)
    except ValueError as problem:
        raise SceneError([f"vary: {quote(text)}: {problem}"]) from None


def _length_parameter(drawing: Drawing, link: str) -> str:
    """Return the name of the parameter that is the length of a bar.

    Raises:
        SceneError: there is no such bar, or the drawing does not give its length.
    """
    if link not in drawing.links:
        raise SceneError([f"vary: no link named {quote(link)}{suggestion(link, drawing.links)}"])
    groups = drawing.groups["pin"]
    ends = drawing.links[link].sides[:1]
    for pin, other in [pair for a, b in ends for pair in ((b, a), (a, b))]:
        form = groups[pin]
        start = getattr(form, "from_", None)
        if getattr(form, "length", None) is None or hasattr(form, "to"):
            continue
        if start == other:
            return f"pin.{pin}.length"
        if isinstance(start, tuple) and other in start:
            return f"pin.{pin}.length[{start.index(other)}]"
    cure = 'give its pin by a length, such as A = {from = "O", length = 40, angle = 60}, or vary a named number'
    raise SceneError([f"vary: the drawing does not give the length of {link}: {cure}"])


def exercises(
    mechanism: Mechanism, vary: Sequence[Variation], students: Sequence[str], at: str, seed: int = 0, digits: int = 6
) -> Iterator[Exercise]:
    """Iterate over exercises with random numbers, different for each student, with which the mechanism works.

    It works if it can be assembled and, if the driver of the drawing turns all the way round, turns all the way round, too.

    Args:
        mechanism: the drawing.
        vary: the numbers that differ.
        students: names of the students.
        at: the value of the driver, unless it is varied.
        seed: the same seed gives the same numbers.
        digits: significant digits of printed numbers.

    Raises:
        SceneError: `at` is not a value of the driver, or in the ranges too few numbers assemble and turn.
    """
    driver, taken = only_driver(mechanism), set()
    if all(one.name != AT_NAME for one in vary):
        Count.of(mechanism, driver).read(at, "at")  # raises an error now, not in each trial
    turns = not np.isfinite([float(travel(mechanism, driver).lower), float(travel(mechanism, driver).upper)]).any()
    for k, student in enumerate(students):
        rng, why = np.random.default_rng([seed, k]), ""
        for _ in range(MOST_TRIALS):
            numbers = {one.title: _drawn(rng, one, len(students)) for one in vary}
            if (key := tuple(numbers.values())) in taken:
                continue
            try:
                solution = _tried(mechanism, vary, numbers, at, turns, digits)
            except (SceneError, AssemblyError) as problem:
                why = str(problem)
                continue
            taken.add(key)
            yield Exercise(student, numbers, solution)
            break
        else:
            raise SceneError([f"vary: no numbers in these ranges were found for {student} that assemble and turn. {why}".strip()])


def _drawn(rng: np.random.Generator, one: Variation, count: int) -> float:
    """Return a random number in the range of a variation: a multiple of 1, 2 or 5 times a power of ten.

    `count` is the number of students, for whom there are enough such numbers.
    """
    finest = (one.high - one.low) / (STEPS_PER_STUDENT * max(count, 5))
    power = 10.0 ** np.floor(np.log10(finest))
    step = max(k * power for k in (1.0, 2.0, 5.0) if k * power <= finest * (1 + 1e-9))
    first, last = int(np.ceil(one.low / step - 1e-9)), int(np.floor(one.high / step + 1e-9))
    return float(f"{int(rng.integers(first, last + 1)) * step:.12g}")


def _tried(
    mechanism: Mechanism, vary: Sequence[Variation], numbers: dict[str, float], at: str, turns: bool, digits: int
) -> WorkedSolution:
    values = {one.name: numbers[one.title] * one.size for one in vary if one.name != AT_NAME}
    place = next((f"{numbers[one.title]!r} {one.unit}" for one in vary if one.name == AT_NAME), at)
    changed = mechanism.with_parameters(values)
    if turns:
        limits = travel(changed, only_driver(changed))
        if np.isfinite([float(limits.lower), float(limits.upper)]).any():
            raise SceneError(["its driver does not turn all the way round"])
    return worked_solution(changed, place, digits=digits, forces=False)


def write_exercises(name: str, found: Sequence[Exercise], vary: Sequence[Variation], folder: Path) -> list[Path]:
    """Write a sheet and a solution for each student, and a table of answers for the teacher; return the paths of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    width, files = len(str(len(found))), []
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    units = {one.title: one.unit for one in vary}
    for k, one in enumerate(found):
        words = re.sub(r"[^\w-]+", "_", one.student).strip("_") or "student"
        stem = f"{k + 1:0{width}d}-{words}"
        given = {title: (value, units[title]) for title, value in one.numbers.items()}
        sheet, solution = folder / f"{stem}.html", folder / f"{stem}-solution.html"
        sheet.write_text(_sheet(one, name, given), encoding="utf-8", newline="\n")
        solution.write_text(one.solution.html(), encoding="utf-8", newline="\n")
        files += [sheet, solution]
        answers: dict[str, Any] = one.answers()
        if k == 0:
            writer.writerow(["student", *(f"{title} ({units[title]})" for title in one.numbers), *answers])
        writer.writerow([_plain(one.student), *map(repr, one.numbers.values()), *(f"{x:.9g}" for x in answers.values())])
    table = folder / "teacher.csv"
    table.write_text(out.getvalue(), encoding="utf-8", newline="\n")
    return [*files, table]


def _sheet(one: Exercise, name: str, given: dict[str, tuple[float, str]]) -> str:
    solution = one.solution
    return sheet_of(name, solution.geometry, solution.style, solution.motion, one.student, given)


def write_course(
    mechanism: Mechanism, vary: Sequence[str], students: Sequence[str], at: str, seed: int, folder: Path
) -> tuple[list[Exercise], list[Path]]:
    """Write the exercises of all students to a folder; return the exercises, and the paths of the files.

    The arguments are those of `exercises`, with the varied numbers as texts: see `read_variation`.
    """
    variations = [read_variation(mechanism, text) for text in vary]
    found = list(exercises(mechanism, variations, students, at, seed))
    return found, write_exercises(mechanism.name, found, variations, folder)


def _plain(name: str) -> str:
    """Return a name, with an apostrophe in front if a spreadsheet would take it for a formula."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@")) else name
