import json
from pathlib import Path

import numpy as np
import pytest

from experiments.paper.comparison import REMARKS, nearer, published_kind, published_row, published_time, remark
from experiments.paper.published import TABLES

READ = json.loads((Path(__file__).parents[2] / "data" / "seed_paper_tables.json").read_text())["tables"]
NAMES = {"LS-Householder": "Householder", "LS-MGS": "GramSchmidt"}


def test_the_tables_are_those_that_were_read_from_the_paper():
    assert len(TABLES) == len(READ) == 6
    for table, (name, rows) in zip(TABLES, READ.items(), strict=True):
        gains = f"a{table.alpha:g}_b{table.beta:g}" if table.alpha else "none"
        assert name == f"{table.number}_TOL1e-{round(-np.log10(table.tol))}_{gains}"
        for row, read in zip(table.rows, rows, strict=True):
            assert row.method == NAMES.get(read["method"], read["method"])
            assert row[1:6] == (read["result"], read["psi2"], read["nfunc"], read["nsteps"], read["cpu"])


def test_misprints_are_noted_where_figures_repeat():
    (greville,) = [row for row in TABLES[2].rows if row.method == "Greville"]
    (before,) = [row for row in TABLES[1].rows if row.method == "Greville"]
    assert greville.nsteps == before.nsteps and greville.misprint
    noted = {(table.number, row.method) for table in TABLES for row in table.rows if row.misprint}
    assert noted == {(4, "Greville"), (4, "Householder"), (6, "Greville")}


@pytest.mark.parametrize(
    ("method", "tol", "alpha", "kind", "time"),
    [
        ("SVD", 1e-10, 0.0, "fails", 9.1),
        ("Varga", 1e-8, 0.0, "fails", 8.06),
        ("Greville", 1e-8, 0.0, "correct up to", 17.5),
        ("GramSchmidt", 1e-6, 0.0, "correct", None),
        ("Varga", 1e-10, 1000.0, "correct", None),
    ],
)
def test_published_results_are_read(method, tol, alpha, kind, time):
    found = published_row(method, tol, alpha)
    assert found is not None
    assert published_kind(found[1]) == kind
    np.testing.assert_equal(published_time(found[1]), np.nan if time is None else time)


def test_runs_that_the_paper_has_not_are_not_found():
    assert published_row("Elimination", 1e-8, 0.0) is None
    assert published_row("SVD", 1e-8, 3.0) is None


@pytest.mark.parametrize(
    ("method", "tol", "alpha", "kind", "correct_to", "letter"),
    [
        ("Greville", 1e-8, 1000.0, "correct", np.nan, "a"),
        ("Greville", 1e-8, 0.0, "correct up to", 16.3, "b"),
        ("Greville", 1e-8, 0.0, "correct up to", 10.4, "c"),
        ("Householder", 1e-10, 0.0, "correct up to", 18.5, "d"),
        ("SVD", 1e-10, 0.0, "correct up to", 7.0, "e"),
        ("SVD", 1e-10, 0.0, "fails", 7.0, "f"),
        ("Varga", 1e-10, 0.0, "fails", 7.0, "g"),
        ("SVD", 1e-10, 1000.0, "correct", np.nan, "h"),
        ("Householder", 1e-6, 0.0, "correct up to", 13.0, "i"),
        ("Householder", 1e-6, 0.0, "fails", 13.0, "j"),
        ("Greville", 1e-8, 0.0, "correct", np.nan, "k"),
        ("SVD", 1e-8, 0.0, "correct", np.nan, "l"),
        ("Varga", 1e-6, 1000.0, "fails", 9.0, "m"),
    ],
)
def test_each_difference_gets_its_remark(method, tol, alpha, kind, correct_to, letter):
    table, row = published_row(method, tol, alpha) or pytest.fail("not published")
    assert remark(row, table, kind, correct_to) == letter
    assert letter in REMARKS


@pytest.mark.parametrize(
    ("method", "tol", "tied", "held", "fits", "later"),
    [
        ("SVD", 1e-10, 8.1, 16.7, "threshold TOL", -1.0),
        ("Greville", 1e-10, 8.7, 17.4, "rank held at 11", -0.1),
        ("GramSchmidt", 1e-6, 12.5, 18.0, "rank held at 11", -2.0),  # correct: to the end, 20 s
        ("Varga", 1e-6, 12.5, 16.0, "threshold TOL", 5.2),
    ],
)
def test_the_rule_that_fits_the_paper_best_is_found(method, tol, tied, held, fits, later):
    _, row = published_row(method, tol, 0.0) or pytest.fail("not published")
    assert nearer(row, tied, held, 20.0) == (fits, pytest.approx(later))


def test_every_verdict_on_every_published_run_has_a_remark():
    for table in TABLES:
        for row in table.rows:
            for kind in ("correct", "correct up to", "fails"):
                for time in (1.0, 17.0, 20.0):
                    assert remark(row, table, kind, time) in REMARKS
