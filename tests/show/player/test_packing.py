import base64

import numpy as np
import pytest

from udkjax.show.player.packing import floats, pack, unpack


@pytest.mark.parametrize("rows", [1, 2, 3, 50])
def test_unpacked_numbers_are_within_half_a_step(rows):
    rng = np.random.default_rng(rows)
    table = np.column_stack([1e9 * rng.normal(size=rows), rng.normal(size=rows), np.zeros(rows), np.arange(rows)])
    steps = np.array([1.0, 1e-7, 1e-3, 0.25])
    found = unpack(pack(table, steps))
    assert np.all(np.abs(found - table) <= steps / 2 * (1 + 1e-9) + 1e-15 * np.abs(table))
    assert np.abs(found - table)[:, 1].max() > 0  # numbers are indeed rounded


def test_smooth_motion_takes_about_one_byte_per_number():
    t = np.linspace(0, 10, 2001)
    table = np.column_stack([np.sin(3 * t + k) for k in range(6)])
    size = len(base64.b64decode(pack(table, 1e-5)["bytes"]))
    assert size < 1.2 * table.size


def test_bytes_of_some_numbers_computed_by_hand():
    # 0, -1, 64 have the second differences 0, -1, 66: zigzag 0, 1, 132 = 4 + 128
    data = pack(np.array([[0.0], [-1.0], [64.0]]), 1.0)
    assert base64.b64decode(data["bytes"]) == bytes([0, 1, 132, 1])
    assert data["rows"] == 3 and data["steps"] == [1.0]


def test_single_precision_keeps_nan_and_infinity():
    found = np.frombuffer(base64.b64decode(floats([1.5, np.nan, -np.inf])), "<f4")
    np.testing.assert_array_equal(found, np.array([1.5, np.nan, -np.inf]))
