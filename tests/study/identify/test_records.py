"""Requirements on records."""

import numpy as np
import pytest

from udkjax import IdentificationError, Record, Start

TS = np.linspace(0.0, 1.0, 5)


def test_a_record():
    record = Record(TS, {"body.a.angle": np.arange(5.0)}, noise={"body.a.angle": 0.1}, t0=-1.0)
    assert record.t0 == -1.0 and np.array_equal(record.noise["body.a.angle"], [0.1] * 5)
    assert record.start.estimate == "nothing" and repr(record) == "Record(5 times, body.a.angle)"


def test_noise_of_all_channels_or_of_none():
    values = {"body.a.x": TS, "body.a.y": TS}
    assert all(np.array_equal(noise, [0.5] * 5) for noise in Record(TS, values, noise=0.5).noise.values())
    assert list(Record(TS, values).noise.values()) == [None, None]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((TS[::-1], {"c": TS}), "must increase, but entry 1"),
        ((TS.reshape(5, 1), {"c": TS}), "vector"),
        (([0.0, np.nan], {"c": [1.0, 2.0]}), "entry 1 is not a finite"),
        ((TS, {"c": TS[:3]}), "each of the 5 times"),
        ((TS, {"c": np.full(5, np.nan)}), "contains no number"),
        ((TS, {"c": [1.0, np.inf, 1.0, 1.0, 1.0]}), "entry 1 is infinite"),
        ((TS, {"c": ["one"] * 5}), "must be numbers"),
        ((TS, {}), "no channel"),
        ((TS, {"c": TS}, {"d": 1.0}), "not among the channels"),
        ((TS, {"c": TS}, -1.0), "finite number > 0"),
        ((TS, {"c": TS}, {"c": [1.0, 2.0]}), "of shape"),
        ((TS, {"c": TS}, None, None, 0.5), "after the first measurement"),
    ],
)
def test_what_a_record_cannot_be(arguments, told):
    with pytest.raises(IdentificationError, match=told):
        Record(*arguments)


def test_all_mistakes_at_once_with_the_record_named():
    with pytest.raises(IdentificationError) as error:
        Record(TS, {"c": TS[:3], "d": np.full(5, np.inf)}, name="swing 3")
    assert len(error.value.problems) == 2 and all('record "swing 3"' in problem for problem in error.value.problems)


def test_what_a_start_estimates():
    with pytest.raises(IdentificationError, match="nothing, position, velocity, both"):
        Start(estimate="angle")  # pyright: ignore[reportArgumentType]
