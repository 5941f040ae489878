"""Mechanisms converted into drawings: the same motion from pins and links."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.studio.drawn_scenes import drawing_text_of
from udkjax.studio.shown_runs import duration_of
from udkjax.studio.tasks import LIBRARY_TEMPLATES, template_text

FEW = ("parallelogram", "planetary_gear", "excavator", "elliptic_trammel")


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FEW else pytest.mark.slow) for n in LIBRARY_TEMPLATES])
def test_a_template_moves_as_the_library_says(name):
    mechanism = LIBRARY_TEMPLATES[name][1]()
    drawn = udk.loads(template_text(name))
    assert drawn.drawing is not None
    ts = np.linspace(0.0, min(1.0, duration_of(drawn)), 11)
    runs = [udk.simulate(m, ts, rtol=1e-10, atol=1e-10) for m in (mechanism, drawn)]
    order = [list(drawn.bodies).index(body) for body in mechanism.bodies]
    places = np.asarray(runs[0].q)[:, :, :2], np.asarray(runs[1].q)[:, order, :2]
    length = float(udk.analyse(mechanism).length)
    assert np.abs(places[0]).max() > 0
    np.testing.assert_allclose(*places, rtol=0, atol=1e-10 * length)  # of both runs' tolerances


def test_the_paper_linkage_is_redundant_as_drawn():
    found = udk.diagnose(udk.loads(template_text("parallelogram")))
    assert (found.degrees_of_freedom, found.redundant) == (1, 1)


def test_an_element_that_cannot_be_drawn_is_named():
    wheel = udk.Body(1.0, 0.1)
    welded = udk.Mechanism({"a": wheel}, {"held": udk.Weld(("ground", "a"), [(0, 0), (0, 0)])})
    with pytest.raises(udk.SceneError, match=r"joint 'held'.*Weld"):
        drawing_text_of(welded)


def test_a_drawing_stays_as_it_is_unless_a_number_departs_from_it():
    """A mechanism with a changed number is converted with that number: here a body's mass, which its density no longer gives."""
    pins, bar = {"O": (0.0, 0.0), "A": (0.3, 0.4)}, udk.Link(["O", "A"], density=7850.0, width=0.02, thickness=0.01)
    drawn = udk.Drawing(pins, {"bar": bar}, ground=["O"]).mechanism()
    assert drawing_text_of(drawn) == udk.dumps(drawn) and "density" in udk.dumps(drawn)
    heavier = udk.loads(drawing_text_of(drawn.with_parameters({"body.bar.mass": 7.0})))
    assert float(heavier.bodies["bar"].mass) == 7.0
