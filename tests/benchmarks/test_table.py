"""Claims are read from the figures, and the page shows them."""

import re

import pytest

benchmarks = pytest.importorskip("benchmarks", reason="not in a source tree")

from benchmarks import page, table  # noqa: E402

TRAJECTORY = [
    {"name": name, "start": -45.0, "tol": tol, "error": 10 * tol, "seconds": scale * tol**-0.125}
    for name, scale in (("udkjax", 1e-4), ("C++", 2e-4), ("script, 1e-10", 1e-3))
    for tol in (1e-5, 1e-7, 1e-9)
]
AT_EQUAL_ERROR = [
    {"name": name, "start": -45.0, "target": 1e-6, "seconds": 1.0, "times_ours": times}
    for name, times in (("udkjax", 1.0), ("C++", 2.0), ("script, 1e-04", None), ("script, 1e-10", 10.0))
] + [
    {"name": name, "start": 60.0, "target": 1e-8, "seconds": 1.0, "times_ours": times}
    for name, times in (("udkjax", 1.0), ("script, 1e-04", None), ("script, 1e-10", float("nan")))
]
FIGURES = {
    "trajectory": TRAJECTORY + AT_EQUAL_ERROR,
    "gradients": [{"name": "udkjax", "mode": "forward", "parameters": 2, "seconds": 1.0, "times_run": float("nan")}],
}


def test_claims_are_judged():
    judged = {row["claim"]: row for row in table.judge(FIGURES)}
    assert len(judged) == len(table.CLAIMS)
    against = judged["20 s, hanging, error 1e-06: time relative to C++"]
    assert (against["figure"], against["holds"], against["target"]) == (0.5, True, "≤ 1")
    script = judged["20 s, hanging, error 1e-06: a script's time relative to ours"]
    assert (script["figure"], script["holds"], script["target"]) == (10.0, False, "≥ 20")
    never = judged["20 s, crossing, error 1e-08: a script's time relative to ours"]
    assert (never["figure"], never["holds"]) == (float("inf"), True)  # it does not get there at all
    assert judged["20 s, crossing, error 1e-06: time relative to C++"]["holds"] is None
    assert judged["gradient, 2 parameters, forward, time relative to the run"]["figure"] is None
    assert all(row["holds"] is None for row in judged.values() if row["benchmark"] not in FIGURES)


def test_the_page_names_programs_claims_and_what_is_missing(tmp_path, capsys):
    judged = table.judge(FIGURES)
    table.show(judged)
    assert "NO" in capsys.readouterr().out
    page.write(FIGURES, judged, {"cpu": "some <processor>"}, ["Exudyn (not installed)"], tmp_path / "index.html")
    html = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "some &lt;processor&gt;" in html and "Exudyn (not installed)" in html and "20 s, hanging" in html
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert html.count("<figure") == 2
