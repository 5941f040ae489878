"""Powers for step sizes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from udkjax.native.language.ir import POINTER, Function
from udkjax.native.language.power import power

X = np.concatenate([10.0 ** np.linspace(-30, 30, 241), 1 + np.linspace(-1e-3, 1e-3, 41), 2.0 ** np.arange(-4.0, 5.0)])


@pytest.mark.parametrize(
    "exponent, whole", [(-1 / 8, False), (-1 / 3, False), (-1 / 2, False), (0.5, False), (5, True), (1, True), (0, True)]
)
def test_powers_are_those_of_numpy(code, width, exponent, whole):
    f = Function("powers", [(POINTER, "x"), (POINTER, "out")], width)
    f.store(power(f, f.load(f.given["x"], 0, width), exponent, whole), f.given["out"], 0, width)
    run = code(f)
    found = np.full(-(-len(X) // width) * width, np.nan)
    for k in range(0, len(found), width):
        out = np.zeros(width)
        run(np.resize(X[k : k + width], width), out)
        found[k : k + width] = out
    assert_allclose(found[: len(X)], X**exponent, rtol=1e-14 if whole else 1e-8)
