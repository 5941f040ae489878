"""The tables of the report, as HTML: every number in them is read from the dataset."""

import json
from collections.abc import Iterable, Sequence
from html import escape
from math import floor, isfinite, log10
from string import ascii_lowercase

from .comparison import nearer
from .figures import runs, tolerances
from .published import Row

NOTHING = "–"
GAP = "\u202f"  # a narrow space that does not break
RULES = {
    "SVD": "D = U S V<sup>T</sup>; singular values at or below TOL count as zero",
    "Varga": "two QR factorizations by Householder reflections, the first with column pivoting; the rank is read from the "
    "diagonal of R: entries at or below TOL count as zero",
    "Greville": "row by row; a row counts as dependent when the norm of its part orthogonal to the rows before is at "
    "or below TOL",
    "Householder": "least squares by QR with column pivoting, freed of its part in the null space; entries of the diagonal of R "
    "at or below TOL count as zero",
    "GramSchmidt": "modified Gram-Schmidt with column pivoting, each column made orthogonal twice, for D and again for R; the "
    "rank is decided by the norm of the rest of a column: at or below TOL it counts as zero",
}
GROUPS = {
    "other integrators": "The paper’s runs by other integrators: no stabilization, threshold TOL",
    "rank held": "Rank held at 11: no stabilization, threshold {rank_held} of the largest singular value",
    "small gains": "Small gains α = β, threshold TOL as in the paper",
    "fixed rows": "Eleven independent rows, chosen once (sparse elimination), no stabilization",
    "default": "What udkjax does by itself: Auto, projection of each step, Dopri8",
}
CAUSES = {
    "step_limit": "step limit",
    "step_too_small": "step too small",
    "not_finite": "not finite",
    "drift": "drift",
    "could_not_assemble": "not closed",
}


def scientific(value: float | None, digits: int = 1) -> str:
    """Write a number as 4.5·10⁻⁴."""
    if value is None or not isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    exponent = floor(log10(abs(value)))
    mantissa = f"{value / 10.0**exponent:.{digits}f}"
    if mantissa.startswith("10"):
        exponent, mantissa = exponent + 1, f"{1:.{digits}f}"
    if exponent == 0:
        return mantissa
    return f"{mantissa}·10<sup>{str(exponent).replace('-', '−')}</sup>"


def power(value: float) -> str:
    """Write a power of ten."""
    return f"10<sup>{str(round(log10(value))).replace('-', '−')}</sup>"


def count(value: float | None) -> str:
    """Write an integer in groups of three digits."""
    return NOTHING if value is None or value < 0 else f"{int(value):,}".replace(",", GAP)


def seconds(value: float | None) -> str:
    """Write a time (s) with three significant digits."""
    return NOTHING if value is None or not isfinite(value) else f"{value:.3g}"


def result(run) -> str:
    """Return how a run ended: its verdict, and the cause if the solver gave up."""
    words = escape(str(run.verdict.item()))
    cause = str(run.result.item())
    return words if cause == "successful" else f"{words} ({CAUSES.get(cause, cause)})"


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int]) -> str:
    """Return an HTML table of `rows` of cells, all of them HTML; the first of each row is its name.

    `head` is its rows of column heads. The columns `words`, counted from 0, hold words, the others numbers. A row of one cell is
    the title of those below it.
    """
    body, width = [], max(line.count("<th") + line.count("rowspan") for line in head)
    for first, *rest in rows:
        kinds = (' class="words"' if k in words else "" for k in range(1, len(rest) + 1))
        cells = "".join(f"<td{kind}>{cell}</td>" for kind, cell in zip(kinds, rest, strict=True))
        body.append(f'<th scope="row">{first}</th>{cells}' if rest else f'<th scope="rowgroup" colspan="{width}">{first}</th>')
    heads, lines = ("".join(f"<tr>{line}</tr>\n" for line in part) for part in (head, body))
    return f"<table>\n<caption>{caption}</caption>\n<thead>\n{heads}</thead>\n<tbody>\n{lines}</tbody>\n</table>"


def columns(*names: str, words: int = 0) -> str:
    """Return the heads of columns, the first `words` of them of words, the others of numbers."""
    kinds = ("" if k < words else ' class="number"' for k in range(len(names)))
    return "".join(f'<th scope="col"{kind}>{name}</th>' for kind, name in zip(kinds, names, strict=True))


def rules(data) -> str:
    """Return which rule decided the rank in each method."""
    methods = json.loads(data.attrs["setting_methods"])
    return table(
        "What each method was told to count as zero, in the units of D.",
        [columns("method", "rule", words=2)],
        [(method, RULES[method]) for method in methods],
        [1],
    )


def paper_tables(data) -> str:
    """Return tables 2 to 7 of the paper together with our figures."""
    found = []
    for published in json.loads(data.attrs["published"]):
        stabilized = published["alpha"] > 0
        ours = [run for run in runs(data, "paper", tol=published["tol"]) if (run.alpha > 0) == stabilized]
        if ours:
            found.append(_paper_table(published, {str(run.method.item()): run for run in ours}))
    return "\n".join(found)


def _paper_table(published: dict, ours: dict) -> str:
    gains = f"Baumgarte α = {published['alpha']:g}, β = {published['beta']:g} 1/s" if published["alpha"] else "no stabilization"
    end, whole = float(next(iter(ours.values())).t_end), 20.0
    length = f"{end:g} s" if end == whole else f"here cut to {end:g} s, in the paper {whole:g} s"
    misprints: list[str] = []
    rows = []
    for row in published["rows"]:
        if row["method"] not in ours:
            continue
        run = ours[row["method"]]
        star = ""
        if row["misprint"]:
            misprints.append(row["misprint"])
            star = f"<sup>{len(misprints)}</sup>"
        cells = [row["method"] + star, f"<i>{escape(row['result'])}</i>", result(run)]
        cells += [f"<i>{scientific(row['psi2'])}</i>", scientific(float(run.psi2_end))]
        cells += [f"<i>{count(row['nfunc'])}</i>", count(float(run.right_hand_sides))]
        cells += [f"<i>{count(row['nsteps'])}</i>", count(float(run.accepted))]
        cells += [f"<i>{seconds(row['cpu'])}</i>", seconds(float(run.cpu))]
        rows.append([*cells, scientific(float(run.error_max)), str(run.remark.item())])
    pairs = ("result", "Σψ² (m²)", "NFUNC", "NSTEPS", "CPU (s)")
    head = ['<th scope="col" rowspan="2">method</th>']
    head += [f'<th scope="colgroup" colspan="2">{pair}</th>' for pair in pairs]
    head += [f'<th scope="col" rowspan="2" class="number">{name}</th>' for name in ("largest<br>error (rad)", "see")]
    caption = f"<b>Table {published['number']}.</b> TOL = {power(published['tol'])}, {gains}, {length}."
    notes = "".join(f"<br><sup>{k + 1}</sup> Misprint in the paper: {escape(text)}." for k, text in enumerate(misprints))
    second = columns(*(5 * ("paper", "here")), words=2)
    return table(caption + notes, ["".join(head), second], rows, [1, 2])


def remarks(data) -> str:
    """Return the meanings of the letters that occur in the tables."""
    texts = json.loads(data.attrs["remarks"])
    used = sorted(set(data.remark.values) & set(ascii_lowercase))
    return "<dl>" + "".join(f"<dt>{letter}</dt><dd>{escape(texts[letter])}</dd>" for letter in used) + "</dl>"


def better(data) -> str:
    """Return better runs than the paper's, one table for each tolerance."""
    names = ("method", "result", "Σψ² (m²)", "NFUNC", "NSTEPS", "CPU (s)", "largest<br>error (rad)", "error at the<br>end (rad)")
    head = columns(*names, words=2)
    found = []
    for tol in tolerances(data):
        rows: list[Sequence[str]] = []
        for group, title in GROUPS.items():
            chosen = list(runs(data, group, tol=tol))
            if chosen:
                rows.append([title.format(rank_held=power(data.attrs["setting_rank_held"]))])
            rows += [_better_row(run, data.attrs["setting_solver"]) for run in chosen]
        if rows:
            found.append(table(f"TOL = {power(tol)}, {float(data.t_end.max()):g} s.", [head], rows, [1]))
    return "\n".join(found)


def explained(data) -> str:
    """Return which of two rules for the rank, by the paper's nearest relative of an integrator, gives the paper's results."""
    rows: list[Sequence[str]] = []
    for published in json.loads(data.attrs["published"]):
        tol = published["tol"]
        tied, held = (
            {str(run.method.item()): run for run in runs(data, group, tol=tol, solver="VODE", alpha=0.0)}
            for group in ("other integrators", "rank held")
        )
        if published["alpha"] or not held:
            continue
        rows.append([f"TOL = {power(tol)}"])
        for row in published["rows"]:
            method = row["method"]
            if method in held and method in tied:
                work = [count(row["nfunc"]), *(count(float(by[method].right_hand_sides)) for by in (tied, held))]
                times = (_lost(by[method]) for by in (tied, held))
                rule, later = nearer(Row(**row), *times, end=float(held[method].t_end))
                rows.append(
                    [
                        method,
                        f"<i>{escape(row['result'])}</i>",
                        result(tied[method]),
                        result(held[method]),
                        *work,
                        rule,
                        f"{later:+.1f}".replace("-", "−"),
                    ]
                )
    if not rows:
        return ""
    head = [
        '<th scope="col" rowspan="2">method</th><th scope="colgroup" colspan="3">result</th>'
        '<th scope="colgroup" colspan="3">NFUNC</th><th scope="col" rowspan="2">nearer to the paper</th>'
        '<th scope="col" rowspan="2" class="number">later by (s)</th>',
        columns(*(2 * ("paper", "threshold TOL", "rank held at 11")), words=3),
    ]
    return table("The paper’s runs without stabilization, and VODE’s with two rules for the rank.", head, rows, [1, 2, 3, 7])


def _lost(run) -> float:
    """Return the time at which a run ceased to be right (s): when it was lost or given up, or its end."""
    times = [float(run[name]) for name in ("correct_to", "failed_at")]
    return min((time for time in times if isfinite(time)), default=float(run.t_end))


def _better_row(run, usual: str) -> list[str]:
    alpha, beta = float(run.alpha), float(run.beta)
    gain = (
        ""
        if alpha == 0
        else f", α = β = {alpha:g}"
        if alpha == beta
        else f", α = {alpha:g}, β = {beta:g}, {float(run.t_end):g} s"
    )
    by = f", {run.solver.item()}" if run.solver != usual else ""
    errors = [scientific(float(run[name])) for name in ("error_max", "error_end")]
    work = [count(float(run.right_hand_sides)), count(float(run.accepted)), seconds(float(run.cpu))]
    return [f"{run.method.item()}{gain}{by}", result(run), scientific(float(run.psi2_end)), *work, *errors]


def settings(data) -> str:
    """Return settings, versions and machine."""
    rows = []
    for name, value in data.attrs.items():
        kind, _, rest = name.partition("_")
        if kind in ("setting", "version"):
            rows.append((f"{kind}: {rest.replace('_', ' ')}", escape(f"{value:g}" if isinstance(value, float) else f"{value}")))
    rows += [(name, escape(str(data.attrs[name]))) for name in ("machine", "date")]
    return table(
        "Settings, versions and machine, as they stand in the data file.", [columns("name", "value", words=2)], rows, [1]
    )
