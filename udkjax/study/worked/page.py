"""The page of a worked solution: MathML and SVG, without any other file."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from udkjax.positions.answers.pin_motion import PinMotion
from udkjax.printing import PrintedTable
from udkjax.study.worked.figures import PolygonSide, drawing_figure, polygon_figure
from udkjax.study.worked.linear_equations import NO_TERMS
from udkjax.study.worked.loop_solutions import LoopSolution
from udkjax.study.worked.loops import Geometry
from udkjax.study.worked.terms import EquationLine, NamedQuantity, NumberStyle


def document(title: str, body: str) -> str:
    """Return an HTML page with a title, a body, and the style of worked solutions."""
    style = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{style}</style></head><body>\n{body}\n</body></html>\n'


def page_of(
    title: str,
    geometry: Geometry,
    style: NumberStyle,
    loops: Sequence[LoopSolution],
    motion: PinMotion,
    polygons: tuple[Sequence[PolygonSide], Sequence[PolygonSide]],
    balances: Mapping[str, Sequence[EquationLine]],
) -> str:
    """Return the page of a solution: its figure, loops, motion, polygons of velocities and accelerations, and balances."""
    parts = [f"<h1>{escape(title)}</h1>"]
    caption = f"The drawing in this position; lengths in {style.unit('m')}."
    parts.append(f"<figure>{drawing_figure(geometry, style)}<figcaption>{caption}</figcaption></figure>")
    for k, loop in enumerate(loops):
        parts += _loop(loop, style, f" {k + 1}" if len(loops) > 1 else "")
    parts.append("<h2>Motion of pins and links</h2>")
    parts += [_table(table) for table in motion.tables()]
    parts.append(polygon_figure(polygons[0], style, "m/s", "Polygon of velocities"))
    parts.append(polygon_figure(polygons[1], style, "m/s2", "Polygon of accelerations"))
    if balances:
        parts.append("<h2>Static forces, link by link</h2>")
        parts.append('<p class="soft">Forces in N along x and y, then moments in N m about the centre of mass; arms in m.</p>')
        for body, lines in balances.items():
            parts += [f"<h3>{escape(body)}</h3>", *(_equation(line, style) for line in lines)]
    return document(title, "\n".join(parts))


def _loop(solution: LoopSolution, style: NumberStyle, number: str) -> list[str]:
    parts = [f"<h2>Position: vector loop{number}</h2>"]
    for loop in solution.loops:
        terms = [
            f"{'<mo>−</mo>' if x.sign < 0 else '<mo>+</mo>' if k else ''}{_vector(f'{x.start}{x.end}')}"
            for k, x in enumerate(loop.vectors)
        ]
        parts.append(
            f'<div class="equation"><math displaystyle="true"><mrow>{"".join(terms)}<mo>=</mo><mn>0</mn></mrow></math></div>'
        )
    parts.append("<p>Its components along x and y:</p>")
    parts += [_equation(line, style) for line in solution.closures]
    if solution.branches:
        parts.append("<p>The sum of the known vectors, and the solution:</p>")
        parts += [_equation(line, style) for line in solution.shared]
    else:
        parts.append(
            "<p>These equations have no closed form. Newton's method solves them together, from an estimate read off a sketch: "
            "in each step, the changes of the unknowns solve a linear system whose matrix is that of the velocities below, and "
            "whose right sides are the sums above with their signs changed.</p>"
        )
        if rows := solution.step_rows(style):
            parts.append(_table(PrintedTable("", rows[1:], rows[0])))
        parts.append("<p>The solution:</p>")
        parts += [_equation(EquationLine(symbol, symbol), style) for symbol in solution.found]
    for branch in solution.branches:
        if branch.words:
            note = "this position" if branch.is_actual else "the other position"
            parts.append(f"<h3>{escape(branch.words)}: {note}</h3>")
        parts += [_equation(line, style) for line in branch.lines]
    for title, system in (("Velocities", solution.velocity), ("Accelerations", solution.acceleration)):
        parts.append(f"<h2>{title}{f': loop{number}' if number else ''}</h2>")
        parts.append(_system(system.matrix, system.unknowns, system.right, style))
        coefficients = system.coefficients if system is solution.velocity else []
        parts += [_equation(line, style) for line in (*coefficients, *system.right)]
        if len(system.unknowns) > 2:
            parts.append("<p>Its solution, and the equations with it put in:</p>")
        parts += [_equation(line, style) for line in system.lines]
    return parts


def _vector(index: str) -> str:
    return f'<msub><mover><mi>r</mi><mo stretchy="false">→</mo></mover><mtext>{escape(index)}</mtext></msub>'


def _equation(line: EquationLine, style: NumberStyle) -> str:
    words = f"<p>{escape(line.words)}</p>" if line.words else ""
    return f"{words}{line.mathml(style)}"


def _system(
    matrix: Sequence[Sequence[EquationLine]], unknowns: Sequence[NamedQuantity], right: Sequence[EquationLine], style: NumberStyle
) -> str:
    """Return a linear system as matrices in MathML."""

    def column(rows: Sequence[Sequence[str]]) -> str:
        inner = "".join(f"<mtr>{''.join(f'<mtd>{cell}</mtd>' for cell in row)}</mtr>" for row in rows)
        return f"<mrow><mo>[</mo><mtable>{inner}</mtable><mo>]</mo></mrow>"

    cells = [["<mn>0</mn>" if line.right == NO_TERMS else _symbol(line, style) for line in row] for row in matrix]
    sides = [[_symbol(line, style)] for line in right]
    parts = column(cells) + column([[x.mathml(style, False)] for x in unknowns]) + "<mo>=</mo>" + column(sides)
    return f'<div class="equation"><math displaystyle="true"><mrow>{parts}</mrow></math></div>'


def _symbol(line: EquationLine, style: NumberStyle) -> str:
    assert line.left is not None
    return line.left.mathml(style, False)


def _table(table: PrintedTable) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.heads)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in table.rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def sheet_of(
    name: str, geometry: Geometry, style: NumberStyle, motion: PinMotion, student: str, given: Mapping[str, tuple[float, str]]
) -> str:
    """Return the sheet of an exercise: the drawing with its dimensions, the numbers of a student, and the questions."""
    title, figure = name or "Exercise", drawing_figure(geometry, style)
    numbers = "".join(f"<li>{escape(name)} = {value:g} {escape(unit)}</li>" for name, (value, unit) in given.items())
    pins, links = ", ".join(motion.pins), ", ".join(motion.links)
    questions = (
        "Write the vector loop and its components.",
        f"Find the positions of the pins {pins}, and the angles of the links, on both branches.",
        f"Find the angular velocities and accelerations of the links {links}.",
        f"Find the velocities and accelerations of the pins {pins}, and draw their polygons to scale.",
    )
    blanks = "".join(f"<li>{escape(text)}{''.join('<div class=blank></div>' for _ in range(4))}</li>" for text in questions)
    parts = [
        f"<h1>{escape(title)}: {escape(student)}</h1>",
        f"<p>Position: {escape(motion.title())}.</p>",
        f"<figure>{figure}<figcaption>Lengths in {style.unit('m')}.</figcaption></figure>",
        f"<p>Your numbers:</p><ul>{numbers}</ul>",
        f"<ol>{blanks}</ol>",
    ]
    return document(f"{title}: {student}", "\n".join(parts))
