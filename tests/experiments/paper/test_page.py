import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from experiments.paper import page as report
from experiments.paper import tables as report_tables
from experiments.paper.findings import findings, nfunc_note, psi2_note, repeat, summary
from experiments.paper.record import read, save

VOID = {"meta", "img", "br", "link"}


class Outline(HTMLParser):
    """The tags of a page with their attributes. It fails if a tag is not closed."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict]] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def all(self, tag: str) -> list[dict]:
        return [attrs for name, attrs in self.found if name == tag]


def cells(html: str) -> list[list[str]]:
    """The rows of tables as plain text."""
    plain = lambda cell: re.sub(r"<[^>]*>", "", cell)  # noqa: E731
    rows = re.findall(r"<tr>(.*?)</tr>", html, re.DOTALL)
    return [[plain(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)] for row in rows]


@pytest.fixture(scope="module")
def page(study_data, tmp_path_factory):
    """The page, made from the file alone."""
    file = tmp_path_factory.mktemp("report") / "report.nc"
    save(study_data, file)
    return report.page(read(file))


@pytest.mark.slow
def test_the_page_stands_alone_and_says_what_its_pictures_show(page):
    outline = Outline(page)
    pictures = outline.all("img")
    assert len(pictures) == len(report.FIGURES)
    for picture in pictures:
        assert picture["src"].startswith("data:image/svg+xml;base64,")
        assert len(picture["alt"]) > 30
    assert len(outline.all("figcaption")) == len(pictures)
    assert len(outline.all("caption")) == len(outline.all("table")) > 5
    assert not outline.all("link") and not outline.all("script")
    assert not re.search(r"https?://|url\(|@import", page)
    assert "$" not in page
    assert len(page.encode()) < 5e6


def test_every_number_of_a_paper_table_is_that_of_the_file(study_data):
    shown = cells(report_tables.paper_tables(study_data))
    line = next(row for row in shown if row[0] == "Greville")  # of table 3, the first of this study
    run = study_data.isel(run=int(np.flatnonzero((study_data.method == "Greville") & (study_data.group == "paper"))[0]))
    assert float(run.tol) == 1e-8
    assert line[1:3] == ["correct to 17.5 s", "correct up to 10.00 s"]
    assert line[3] == "1.9·10−4" and line[4] == re.sub("<.*?>", "", report_tables.scientific(float(run.psi2_end)))
    assert line[5:9] == [report_tables.count(n) for n in (1648055, run.right_hand_sides, 1422689, run.accepted)]
    assert line[9:11] == ["0.53", f"{float(run.cpu):.3g}"]
    assert line[11:] == ["1.0", "c"]


@pytest.mark.parametrize("variable", ["psi2_end", "right_hand_sides", "accepted", "cpu", "error_max"])
@pytest.mark.parametrize("tables", [report_tables.paper_tables, report_tables.better])
def test_a_changed_file_changes_the_tables(study_data, variable, tables):
    changed = study_data.copy(deep=True)
    changed[variable] = 2 * changed[variable] + 1
    before, after = cells(tables(study_data)), cells(tables(changed))
    (differs,) = {
        tuple(k for k in range(len(a)) if a[k] != b[k]) for a, b in zip(before, after, strict=True) if a != b
    }  # one and the same column, in every row
    assert len(differs) == 1
    assert sum(a != b for a, b in zip(before, after, strict=True)) == sum(
        len(row) in (8, 13) and row[0] != "method" for row in before
    )


def test_the_rule_that_explains_the_paper_is_shown_beside_it(study_data):
    shown = cells(report_tables.explained(study_data))
    assert [row for row in shown if len(row) == 1] == [["TOL = 10−8"], ["TOL = 10−6"]]
    lines = [row for row in shown if row[0] == "Greville"]
    assert [line[7:] for line in lines] == [["threshold TOL", "−7.5"], ["threshold TOL", "−6.0"]]  # 10 s and 13 s by either rule
    held = study_data.isel(
        run=(study_data.solver == "VODE") & (study_data.group == "rank held") & (study_data.method == "Greville")
    )
    assert [line[1] for line in lines] == ["correct to 17.5 s", "correct to 19.0 s"]
    assert [line[6] for line in lines] == [report_tables.count(count) for count in held.right_hand_sides.values]
    assert report_tables.explained(study_data.isel(run=study_data.solver != "VODE")) == ""


def test_a_run_that_was_given_up_says_why(study_data):
    (line,) = [
        row for row in cells(report_tables.paper_tables(study_data)) if "step limit" in row[-11:][0] or "step limit" in row[2]
    ]
    assert line[0] == "Varga" and line[2] == "fails at 7.30 s (step limit)"


def test_remarks_explain_the_letters_of_the_tables_and_no_others(study_data):
    text = report_tables.remarks(study_data)
    letters = re.findall(r"<dt>(.)</dt>", text)
    assert letters == sorted({row[-1] for row in cells(report_tables.paper_tables(study_data)) if len(row) == 13})
    assert "Unexplained" in text


def test_findings_count_what_the_tables_show(study_data):
    text = re.sub("<.*?>", "", findings(study_data))
    assert "of 10 runs 9 are correct only for a while and 1 are given up while still correct" in text
    assert "right until 7.3 to 10.0 s at TOL = 10−8, 13.0 s at TOL = 10−6" in text
    assert "between 10−8 and 10−6 3.00 s, by the law 2.60 s (medians" in text  # SVD does not halt at 1e-6 in the paper
    assert "runs without stabilization are, with the threshold TOL right until 10.0 s at TOL = 10−8, 13.0 s at" in text
    assert "the drift grows at 1.770 1/s, by the law 1.770 1/s" in text
    assert "4 starts that differ by rounding are lost between 10.0 and 13.0 s" in text
    assert "with the paper's gains: all 10 runs are correct to the end" in text
    assert "NFUNC is 534 to 537 times ours" in nfunc_note(study_data)  # 80.1e6 / 10 / 15e3
    assert "times ours" in psi2_note(study_data) and "unexplained" in psi2_note(study_data)
    assert "the paper has 1.1·10<sup>−4</sup> to 9.7·10<sup>−4</sup> m² where it was correct up to" in psi2_note(study_data)


@pytest.mark.slow
def test_the_page_begins_with_a_picture_and_words(page, study_data):
    found, picture = page.index("What was found"), page.index("<figure")
    assert picture < found < page.index("<ul>")
    words = summary(study_data)
    assert words in page and not re.search(r"\d", words)
    assert "every run is lost sooner or later" in words and "projecting each step" in words
    kept = study_data.copy(deep=True)
    kept["kind"] = kept.kind.copy(data=np.full(kept.kind.shape, "correct", dtype=kept.kind.dtype))
    assert "every run stays right" in summary(kept)
    assert "prefers-color-scheme: dark" in page


def test_the_page_says_how_to_repeat_it_and_what_was_cut(study_data):
    text = repeat(study_data)
    assert "udkjax report --start -45 --seed 3" in text
    assert "62 s" in text and "40 s" in text and "cut to 2 s" in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (4.5e-4, "4.5·10<sup>−4</sup>"),
        (9.96e-5, "1.0·10<sup>−4</sup>"),
        (12.0, "1.2·10<sup>1</sup>"),
        (2.04, "2.0"),
        (0.997, "1.0"),
        (0.0, "0"),
        (np.nan, "–"),
    ],
)
def test_numbers_are_written_in_full(value, text):
    assert report_tables.scientific(value) == text


def test_counts_are_written_in_groups_that_do_not_break():
    assert report_tables.count(1648055).split("\u202f") == ["1", "648", "055"]
    assert report_tables.count(-1) == report_tables.count(None) == "–"


def test_other_files_are_refused(tmp_path, study_data):
    file = tmp_path / "other.nc"
    study_data.assign_attrs(format="something else").to_netcdf(file, engine="h5netcdf")
    with pytest.raises(ValueError, match="not the data of a report"):
        read(file)


def test_settings_and_versions_are_on_the_page(study_data):
    shown = dict(row for row in cells(report_tables.settings(study_data)) if len(row) == 2)
    assert shown["setting: start"] == "-45" and shown["setting: seed"] == "3"
    assert shown["machine"] == study_data.attrs["machine"] and "version: jax" in shown
    assert json.loads(study_data.attrs["published"])[0]["number"] == 2
