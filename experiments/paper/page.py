"""The report: one HTML page, drawn from the study's dataset alone."""

from collections.abc import Callable
from pathlib import Path
from string import Template
from typing import Any

from udkjax.extras import OptionalImport
from udkjax.show.report import embedded, report_style

from . import figures, tables
from .findings import findings, growth_time, nfunc_note, psi2_note, repeat, second_choice, summary

with OptionalImport():
    from matplotlib.figure import Figure

FIGURES: dict[str, tuple[Callable[[Any], Figure], str, str]] = {
    "linkage": (
        figures.linkage,
        "A coupler on three parallel links, drawn at its start and in four later poses.",
        "The five-bar parallelogram at its start, and later (fainter).",
    ),
    "figure_2": (
        figures.figure_2,
        "Three panels for each tolerance: the sum of squared constraint violations over time without and with Baumgarte's "
        "terms, and the error of the angles.",
        "<b>Violation and error.</b> Left and middle: the sum of squared constraint violations, the paper's figure 2; dashed: "
        "TOL². Right: the largest error of an angle against the exact solution; dashed: where a run counts as lost.",
    ),
    "singular_values": (
        figures.singular_values,
        "For each tolerance: the eleventh and twelfth singular value of D over time with the threshold, and the rank below.",
        "<b>Rank.</b> The twelfth singular value of D is zero on the constraint manifold and rises with the drift; where it "
        "crosses the threshold TOL (dashed) the rank jumps from 11 to 12. Without stabilization. Ranks are set apart by method.",
    ),
    "energies": (
        figures.energies,
        "For each tolerance: the angle of a link over time, and the change of the total energy.",
        "<b>Motion and energy.</b> Once the rank is 12 no degree of freedom is left, and a lost linkage comes to rest. Coloured: "
        "without stabilization; dotted: with the paper's gains (energy only); black: the defaults of udkjax.",
    ),
    "growth": (
        figures.growth,
        "Left: the twelfth singular value over time with the law's exponential growth. Right: rate of growth against gain.",
        "<b>The law of the drift.</b> Left: the drift of runs whose rank is held at 11, and the law; one constant, the level of "
        "the rounding errors, is taken from the runs. Right: the law's rate against the gain α = β; rings: measured.",
    ),
    "work": (
        figures.work,
        "Error against right-hand sides and against time on logarithmic axes, coloured by integrator, marked by method.",
        "<b>Work and precision.</b> Runs over 20 s with gains of 3 1/s that keep the drift down, and, in black, with projection. "
        "Colours are integrators, marks are methods, points along a line are tolerances.",
    ),
}


def page(data: Any) -> str:
    """Return the report on a dataset of record.py as one self-contained HTML page."""
    pictures = {name: figure(data, name) if _drawable(data, name) else "" for name in FIGURES}
    template = Template(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    return template.substitute(
        style=report_style(),
        summary=summary(data),
        findings=findings(data),
        rules=tables.rules(data),
        paper_tables=tables.paper_tables(data),
        nfunc_note=nfunc_note(data),
        psi2_note=psi2_note(data),
        remarks=tables.remarks(data),
        explained=tables.explained(data),
        better=tables.better(data),
        settings=tables.settings(data),
        repeat=repeat(data),
        growth_time=growth_time(data),
        citation=data.attrs["citation"],
        second_choice=second_choice(data),
        start=f"{data.attrs['setting_start']:g}°".replace("-", "−"),
        inferred="inferred: the paper does not print it" if data.attrs["setting_start"] in (-45.0, -50.0) else "chosen here",
        lost=f"{data.attrs['setting_lost']:g}",
        first_step=f"{data.attrs['setting_first_step']:g}",
        solver=data.attrs["setting_solver"],
        machine=data.attrs["machine"],
        **pictures,
    )


def write(data: Any, target: Path) -> None:
    """Write the page of a dataset."""
    target.write_text(page(data), encoding="utf-8")


def figure(data: Any, name: str) -> str:
    """Return one of the `FIGURES` as HTML, its picture inside."""
    draw, alt, caption = FIGURES[name]
    return embedded(lambda: draw(data), alt, caption, name)


def _drawable(data: Any, name: str) -> bool:
    needed = {"growth": "rank held", "work": "work"}.get(name, "paper")
    return needed in set(data.group.values)
