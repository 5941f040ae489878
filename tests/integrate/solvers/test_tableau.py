"""The default's tableau is diffrax's; it is repeated in the package so that a run need not import diffrax."""

from dataclasses import fields

import diffrax
import numpy as np

from udkjax.integrate.solvers import has_method, is_explicit, method_of


def test_the_default_is_dopri8():
    ours, theirs = method_of(None), method_of(diffrax.Dopri8())
    for field in fields(ours):
        np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name), err_msg=field.name)
    assert ours.stages == 13 and ours.order == 8.0
    assert method_of(diffrax.Tsit5()) is method_of(diffrax.Tsit5()) is not ours


def test_what_is_explicit():
    assert is_explicit(None) and is_explicit(diffrax.Tsit5())
    assert not is_explicit(diffrax.Kvaerno5()) and not is_explicit(diffrax.KenCarp4())


def test_what_has_a_tableau():
    """Also singly diagonally implicit methods, of one tableau."""
    implicit = [diffrax.Kvaerno3(), diffrax.Kvaerno4(), diffrax.Kvaerno5()]
    assert all(map(has_method, [None, diffrax.Tsit5(), *implicit]))
    assert not any(map(has_method, [diffrax.KenCarp4(), diffrax.ImplicitEuler(), diffrax.HalfSolver(diffrax.Heun())]))
    for solver in implicit:
        method, tableau = method_of(solver), solver.tableau
        assert method.is_implicit and method.stages == tableau.num_stages
        np.testing.assert_allclose(method.v.sum(axis=1), method.nodes, atol=1e-13)
        np.testing.assert_array_equal(method.v[-1], method.v[-2])  # the last stage is the end of the step
        np.testing.assert_allclose(method.q[-1] @ np.ones(method.stages), 0.5, atol=1e-13)
