"""Tables and texts of an artificial estimate; the files of an identification are tested with the command line."""

from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import udkjax as udk
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.answers.uncertainty import Uncertainty
from udkjax.study.identify.records.records import Record, labels
from udkjax.study.identify.search.optimizer import squares
from udkjax.study.report import format_value


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        (3.1194645, 0.0188, "3.119"),
        (3.1194645, 0.00012, "3.11946"),
        (-0.0368209, 0.00012, "-0.03682"),
        (1234.567, 20.0, "1235"),
        (0.5, 3.0, "0.50"),
        (1.0, 1e-18, "1.00000000000"),
        (2.0, np.inf, "2"),
        (2.0, np.nan, "2"),
        (0.0, 0.1, "0"),
        (1 / 3, 0.0, "0.333333"),
    ],
)
def test_values_are_said_as_far_as_they_are_known(value, error, said):
    assert format_value(value, error) == said


def test_records_without_a_name_of_their_own_are_numbered():
    assert labels([Record([0.0], {"y": [0.0]}, name=name) for name in ("push", "", "push", "pull", "")]) == [
        "push 1",
        "record 2",
        "push 3",
        "pull",
        "record 5",
    ]


@pytest.fixture
def estimate() -> Estimate:
    """Four parameters, one undetermined and two determined only together; and an initial state."""
    names = ("a", "b", "c", "d")
    channels = [SimpleNamespace(name=f"y{k}", units="rad") for k in range(8)]
    index = np.array([[0, t, c] for t in range(5) for c in range(8)])
    problem: Any = SimpleNamespace(
        unknowns=SimpleNamespace(
            guess=np.array([1.0, 2.0, 3.0, 4.0]), kinds=["bounded"] * 4, low=np.zeros(4), high=np.full(4, 4.5)
        ),
        all_names=(*names, "start: angle"),
        all_units=("kg", "kg", "m", "1", "rad"),
        channels=channels,
        records=[SimpleNamespace(name="run")],
        index=index,
        noise_given=index[:, 2] == 0,
    )
    known: Any = SimpleNamespace(
        standard_errors=np.array([np.inf, np.inf, np.inf, 2.5]),
        dead=("c",),
        flat=(SimpleNamespace(names=("a", "b")),),
        poor=("d",),
        messages=("a & b",),
        chi2=39.5,
        degrees_of_freedom=35,
    )
    known.correlated_beyond = lambda least: ()
    known.notes = lambda name: Uncertainty.notes(known, name)
    found = Estimate(
        names=names,
        units=("kg", "kg", "m", "1"),
        values=np.array([1.5, 2.5, 3.0, 4.5]),
        uncertainty=known,
        at_bounds=("d",),
        initial_state_values={"start: angle": (0.1, 0.01)},
        predicted=(),
        residuals=(),
        noise=({channel.name: np.array([np.nan, 0.02, 0.02]) for channel in channels},),
        outliers=(),
        whiteness={},
        converged=False,
        agreeing=3,
        guesses=16,
        ways=(),
        history=(),
        evaluations=1,
        seconds=2.0,
        tol=(1e-9, 1e-9),
        z=np.zeros(5),
        problem=problem,
        loss=squares,
    )
    vars(found)["mechanism"] = SimpleNamespace(name="<linkage>")
    return found


def test_each_row_says_what_is_wrong_with_it(estimate):
    found = estimate.rows()
    assert [row.note for row in found] == [
        "undetermined together with others",
        "undetermined together with others",
        "affects no measured quantity",
        "poorly determined, at a bound",
        "added to the guess of the initial state",
    ]
    assert [row.first_guess for row in found] == [1.0, 2.0, 3.0, 4.0, 0.0]
    assert found[-1][:4] == ("start: angle", 0.1, 0.01, "rad")


def test_the_text_says_how_the_fit_ended_and_what_the_noise_was(estimate):
    lines = str(estimate).splitlines()
    assert lines[0] == "<linkage>: 4 parameters from 40 numbers in 1 record"
    assert lines[2].split() == "a 1.5 unknown kg 1 undetermined together with others".split()
    assert lines[5].split() == "d 4.5 2.5 1 4 poorly determined, at a bound".split()
    assert [len(line) - len(line.lstrip()) for line in lines[1:7]] == [2] * 6
    assert lines[7:] == [
        "fit: not converged after 1 evaluation in 2.0 s, 3 of 16 first guesses led to it",
        "chi^2: 39.5 with 35 degrees of freedom",
        "estimated noise: " + ", ".join(f"y{k} 0.02 rad" for k in range(1, 7)) + " and y7 0.02 rad",
        "the fit has not converged: these are the best values found",
        "a & b",
        "d is at its bound, 4.5; from below it is known to 2.5",
    ]


def test_a_notebook_shows_the_same_as_a_table(estimate):
    root = ElementTree.fromstring(f"<div>{estimate._repr_html_()}</div>".replace("<br>", "<br/>"))
    texts = [[cell.text or "" for cell in row] for row in root.iter("tr")]
    assert texts[0][:3] == ["parameter", "value", "standard error"] and len(texts) == 6
    assert texts[4] == ["d", "4.5", "2.5", "1", "4", "poorly determined, at a bound"]
    said = "".join(root.itertext())
    assert "<linkage>: 4 parameters" in said and "a & b" in said and "chi^2: 39.5 with 35 degrees of freedom" in said


def test_a_name_that_was_not_identified_has_no_profile(estimate):
    with pytest.raises(udk.IdentificationError, match='"aa" was not identified'):
        estimate.profile("aa")
