"""The default's tableau is diffrax's; it is repeated in the package so that a run need not import diffrax."""

from dataclasses import fields

import diffrax
import numpy as np

from udkjax.integrate.solvers import is_explicit, method_of


def test_the_default_is_dopri8():
    ours, theirs = method_of(None), method_of(diffrax.Dopri8())
    for field in fields(ours):
        np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name), err_msg=field.name)
    assert ours.stages == 13 and ours.order == 8.0
    assert method_of(diffrax.Tsit5()) is method_of(diffrax.Tsit5()) is not ours


def test_what_is_explicit():
    assert is_explicit(None) and is_explicit(diffrax.Tsit5())
    assert not is_explicit(diffrax.Kvaerno5()) and not is_explicit(diffrax.KenCarp4())
