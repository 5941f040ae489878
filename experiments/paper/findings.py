"""The findings of the report: sentences whose numbers are read from the dataset."""

import json
from itertools import pairwise

import numpy as np

from .comparison import published_kind, published_time
from .figures import runs, tolerances
from .published import Row
from .tables import count, power, scientific

PAPER_END = 20.0  # s
ROUNDING = 1e-16  # m: of a coordinate


def findings(data) -> str:
    """Return the findings as an HTML list."""
    return "<ul>\n" + "\n".join(f"<li>{text}</li>" for text in _sentences(data)) + "\n</ul>"


def summary(data) -> str:
    """Say in words what became of the runs: which kinds of them stay right."""
    free = [run for run in runs(data, "paper") if not run.alpha > 0]
    right = sum(map(_is_right, free))
    first = (
        "Without stabilization every run is lost sooner or later, whichever pseudoinverse solves the equations"
        if not right
        else "Without stabilization runs stay right with some pseudoinverses and are lost with others"
        if right < len(free)
        else "Without stabilization every run stays right for as long as it was followed"
    )
    cures = {
        "small gains": "small gains of Baumgarte's stabilization",
        "fixed rows": "leaving out one constraint for good",
        "default": "projecting each step back to the constraints (the default of udkjax)",
    }
    kept = [cure for group, cure in cures.items() if (found := list(runs(data, group))) and all(map(_is_right, found))]
    *most, last = kept or [""]
    second = f" {', '.join(most)}{' and ' if most else ''}{last} keep{'' if most else 's'} all of them right." if last else ""
    second = second[:1] + second[1:2].upper() + second[2:]
    return f"<p>{first}: the linkage has one constraint more than it needs, and errors grow along it.{second}</p>"


def _is_right(run) -> bool:
    return run.kind.item() == "correct"


def _sentences(data):
    for stabilized, name in ((False, "without stabilization"), (True, "with the paper's gains")):
        chosen = [run for run in runs(data, "paper") if (run.alpha > 0) == stabilized]
        yield f"<b>The paper's runs {name}:</b> {_counted(chosen)}{_times_by_tolerance(data, chosen)}."
    yield from _spacing(data)
    yield from _nearest(data)
    held = list(runs(data, "rank held"))
    if held:
        growth = [float(run.growth) for run in held if np.isfinite(run.growth)]
        law = _law(data)
        rates = f"; the drift grows at {_span(growth, '.3f')} 1/s" if growth else ""
        lost = [float(run.correct_to) for run in runs(data, "start") if np.isfinite(run.correct_to)]
        luck = (
            f" {len(lost)} starts that differ by rounding are lost between {min(lost):.1f} and {max(lost):.1f} s." if lost else ""
        )
        yield (
            f"<b>A threshold that is not tied to TOL does not save them:</b> with the rank held at 11, {_counted(held)}"
            f"{_times_by_tolerance(data, held)}{rates}, by the law {law:.3f} 1/s. The cause is the redundancy itself.{luck}"
        )
    gains = list(runs(data, "small gains"))
    stiff = [run for run in runs(data, "paper") if run.alpha > 0]
    if gains:
        yield (
            f"<b>Gains of {_span([float(run.alpha) for run in gains], 'g')} 1/s are enough:</b> {_counted(gains)}, largest error "
            f"{_largest(gains)} rad, {_rate(gains)} right-hand sides a second of motion; the paper's gains take {_rate(stiff)}."
        )
    for group, name in (("fixed rows", "Eleven rows chosen once"), ("default", "The defaults of udkjax")):
        chosen = list(runs(data, group))
        if chosen:
            ends = ", ".join(f"{scientific(float(run.error_end))} (TOL = {power(float(run.tol))})" for run in chosen)
            yield f"<b>{name}:</b> {_counted(chosen)}; error at the end {ends} rad."


def _spacing(data):
    """Say how much sooner a run is lost for a smaller TOL: by the law, here, and in the paper, where a run halts."""
    tols = tolerances(data)
    free = {tol: [float(run.correct_to) for run in runs(data, "paper", tol=tol, alpha=0.0)] for tol in tols}
    if not np.isfinite(list(free.values())).any(axis=1).all():
        return
    halted = {table["tol"]: _halted(table, "SVD") for table in json.loads(data.attrs["published"]) if not table["alpha"]}
    parts = []
    for tol, above in pairwise(tols):
        law, here = np.log(above / tol) / _law(data), np.nanmedian(free[above]) - np.nanmedian(free[tol])
        paper = halted[above] - halted[tol]
        parts.append(
            f"between {power(tol)} and {power(above)} {here:.2f} s"
            f"{f', in the paper {paper:.2f} s (SVD)' if np.isfinite(paper) else ''}, by the law {law:.2f} s"
        )
    if parts:
        yield (
            "<b>With the threshold tied to TOL, TOL decides when a run is lost,</b> because that is how far the drift must grow: "
            f"{'; '.join(parts)} (medians of the methods; what method and integrator add by rounding differs, too)."
        )


def _halted(table: dict, method: str) -> float:
    """Return the time at which a run of the paper halted (s); NaN if it did not."""
    (row,) = [Row(**row) for row in table["rows"] if row["method"] == method]
    return published_time(row) if published_kind(row) == "fails" else float("nan")


def _nearest(data):
    """Say how the paper's runs end with the nearest relative of its integrator."""
    groups = {"with the threshold TOL": "other integrators", "with the rank held at 11": "rank held"}
    found = {name: list(runs(data, group, solver="VODE", alpha=0.0)) for name, group in groups.items()}
    if all(found.values()):
        spans = [f"{name} {_times_by_tolerance(data, chosen).removeprefix('; ')}" for name, chosen in found.items()]
        yield (
            "<b>By VODE, the nearest relative of the paper’s integrator,</b> runs without stabilization are, "
            f"{', and '.join(spans)}. A table below says which rule is nearer to each of the paper’s results."
        )


def _law(data) -> float:
    """The law's rate of growth (1/s) without stabilization."""
    return float(data.law_rate[int(np.argmin(np.abs(data.law_gain.values)))])


def growth_time(data) -> str:
    """Say how long the drift takes from rounding to a lost run, by its law."""
    decades = np.log10(float(data.attrs["setting_lost"]) / ROUNDING)
    rate = _law(data)
    took = f"about {decades * np.log(10) / rate:.0f} s" if rate > 0 else "for ever"
    return (
        f"Its rate of growth is {rate:.3f} 1/s: from {power(ROUNDING)} m to {power(data.attrs['setting_lost'])} it takes {took},"
    )


def second_choice(data) -> str:
    """Say what another start that fits the paper's results would change."""
    other = float(data.attrs["law_rate_second"])
    if abs(data.attrs["setting_start"] - data.attrs["start_second"]) < 1:
        return ""
    return (
        f" From {data.attrs['start_second']:g}°, which would fit the paper too, the drift grows at {other:.3f} 1/s instead of "
        f"{_law(data):.3f} 1/s, so that all runs are right for longer, by a factor of {_law(data) / other:.2f}."
    ).replace(" -", " −")


def nfunc_note(data) -> str:
    """Say how many times the right-hand sides here the paper counts, a second of motion, where both runs are right to the end."""
    pairs = [(row, run) for pairs in _printed(data).values() for row, run in pairs if row.result == run.kind == "correct"]
    ratios = [row.nfunc * float(run.t_end) / PAPER_END / float(run.right_hand_sides) for row, run in pairs if row.nfunc]
    if not ratios:
        return ""
    return (
        f"Where both runs are right to the end the paper’s NFUNC is {_span(ratios, '.0f')} times ours, a second of motion. "
        "We infer that a cumulative counter was added up over the output points (one every 0.01 s would give a factor of 1000), "
        "and so was NSTEPS."
    )


def psi2_note(data) -> str:
    """Say how far the paper's sums of squared violations are from ours."""
    ratios = {
        name: [row.psi2 / float(run.psi2_end) for row, run in pairs if row.psi2 and run.psi2_end > 0]
        for name, pairs in _printed(data).items()
    }
    parts = [f"{scientific(min(found), 0)} to {scientific(max(found), 0)} times ours {n}" for n, found in ratios.items() if found]
    if not parts:
        return ""
    ours = [_when_lost(run) for run in runs(data, "rank held", solver="VODE", alpha=0.0) if np.isfinite(run.correct_to)]
    paper = [
        row["psi2"]
        for table in json.loads(data.attrs["published"])
        for row in table["rows"]
        if not table["alpha"] and published_kind(Row(**row)) == "correct up to"
    ]
    held = (
        f" But with the rank held at 11, by VODE, it is {_range(ours)} m² at the first output time at which a run is lost, and "
        f"grows tenfold in {np.log(10) / 2 / _law(data):.1f} s; the paper has {_range(paper)} m² where it was correct up to a "
        "time: another sign of such a rule."
        if ours and paper
        else ""
    )
    return f"The paper’s Σψ² is {' and '.join(parts)}: unexplained. It does not say at which instants its sum is taken.{held}"


def _when_lost(run) -> float:
    """The sum of squared violations at the first output time at which a run is lost."""
    return float(run.psi2[np.searchsorted(run.time.values, float(run.correct_to), side="right")])


def _range(values) -> str:
    return f"{scientific(min(values))} to {scientific(max(values))}"


def _printed(data) -> dict[str, list]:
    """Return the paper's lines, each with the run of this package, without and with stabilization."""
    pairs: dict[str, list] = {"without stabilization": [], "with it": []}
    for table in json.loads(data.attrs["published"]):
        rows = {row["method"]: Row(**row) for row in table["rows"]}
        ours = runs(data, "paper", tol=table["tol"], alpha=table["alpha"])
        pairs["with it" if table["alpha"] else "without stabilization"] += [(rows[run.method.item()], run) for run in ours]
    return pairs


def _counted(chosen) -> str:
    """Say how many runs are correct, lost, or fail."""
    kinds = [str(run.kind.item()) for run in chosen]
    names = {
        "correct": "correct to the end",
        "correct up to": "correct only for a while",
        "fails": "given up while still correct",
    }
    counts = {text: kinds.count(kind) for kind, text in names.items() if kind in kinds}
    if len(counts) == 1:
        return f"all {len(kinds)} runs are {next(iter(counts))}"
    *most, last = (f"{number} are {text}" for text, number in counts.items())
    return f"of {len(kinds)} runs {', '.join(most)} and {last}"


def _times_by_tolerance(data, chosen) -> str:
    parts = []
    for tol in tolerances(data):
        times = [float(run.correct_to) for run in chosen if run.tol == tol and np.isfinite(run.correct_to)]
        if times:
            parts.append(f"{_span(times, '.1f')} s at TOL = {power(tol)}")
    return ("; right until " + ", ".join(parts)) if parts else ""


def _span(values, form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"


def _largest(chosen) -> str:
    return scientific(max(float(run.error_max) for run in chosen))


def _rate(chosen) -> str:
    rates = [float(run.right_hand_sides) / float(run.end) for run in chosen if run.right_hand_sides > 0 and run.end > 0]
    return f"{count(min(rates))} to {count(max(rates))}" if rates else "an unknown number of"


def repeat(data) -> str:
    """Return how to get this page again."""
    attrs = data.attrs
    quick = " --quick" if attrs["setting_scope"] == "quick" else ""
    command = f"udkjax report{quick} --start {attrs['setting_start']:g} --seed {attrs['setting_seed']}"
    stiff = [float(run.t_end) for run in runs(data, "paper") if run.alpha > 0]
    cut = (
        f"This is the {attrs['setting_scope']} version: runs with the paper's gains are cut to {min(stiff):g} s, and the "
        "work-precision diagram is thinner. "
        if stiff and min(stiff) < float(data.t_end.max())
        else ""
    )
    return (
        f"<p><code>{command}</code> makes the data and this page again, here in {attrs['seconds']:.0f} s, "
        f"{attrs['seconds_compiling']:.0f} s of it to compile. {cut}A run gives up after "
        f"{count(attrs['setting_max_steps'])} steps. <code>udkjax report --from FILE.nc</code> draws the page from the "
        "data alone.</p>"
    )
