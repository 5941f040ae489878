"""Positions computed by NumPy equal those of compiled programs, and need no compilation."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

LINKAGE = udk.Drawing(
    pins={"A": [0, 0], "B": udk.polar("A", "r", 60), "C": udk.circles("BD", ("3*r", "2*r"), "left"), "D": ["3*r", 0]},
    links={
        name: {"pins": list(ends), "mass": 1, "width": 10} for name, ends in {"crank": "AB", "rod": "BC", "rocker": "CD"}.items()
    },
    ground=["A", "D"],
    motors={"motor": {"pin": "A", "speed": "w"}},
    units={"length": "mm", "angle": "deg"},
    numbers={"r": 40, "w": "60 rpm"},
)
ASKED = {
    "branches": lambda mech: udk.branches(mech, "motor", 0.3, starts=40),
    "characteristics": lambda mech: str(udk.characteristics(mech)),
    "check": lambda mech: str(udk.check(mech)),
    "diagnose": lambda mech: str(udk.diagnose(mech)),
    "explain": lambda mech: str(udk.explain(mech)),
    "gaps": lambda mech: udk.gaps(mech, pairs=[("crank", "rocker")]).least.distance,
    "layers": lambda mech: str(udk.layers(mech)),
    "worked_solution": lambda mech: str(udk.worked_solution(mech, "40 deg")),
}


@pytest.mark.parametrize("name", ASKED)
def test_what_takes_concrete_numbers_takes_them_within_a_trace(name):
    want, found = ASKED[name](LINKAGE.mechanism()), []
    mech = LINKAGE.mechanism()
    jax.jit(lambda x: found.append(ASKED[name](mech)) or x)(0.0)
    if isinstance(want, str):
        assert found == [want]
    else:
        assert_allclose(found[0], want, rtol=1e-12)


def test_nothing_is_compiled_by_xla(compilations):
    """The only exceptions are two constants, when derivatives with respect to a driver are first traced."""
    mechanism = udk.library.n_four_bar(2)
    driver = f"body.{mechanism.body_names[0]}.angle"

    def ask():
        found = udk.kinematics(mechanism, driver, np.linspace(0.0, 0.1, 4) + float(np.asarray(mechanism.q0)[0, 2]))
        assert np.all(np.asarray(found.reached))
        udk.travel(mechanism, driver)
        assert udk.equilibrium(mechanism).balanced
        udk.modes(mechanism)

    assert len([seconds for seconds in compilations(ask) if seconds]) <= 2
