"""Fixes of redundant constraints leave drawings that move as before."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.studio.tasks import DRAWN_TEMPLATES, LIBRARY_TEMPLATES, compile_drawing, diagnose_drawing, template_text

NAMES = (*LIBRARY_TEMPLATES, *DRAWN_TEMPLATES)
PART = 0.3  # of the duration that the studio shows
INSTANTS = 7


def positions(text, ts):
    """Return positions of all bodies by name: those of the motion from the drawn position."""
    sol = udk.simulate(udk.loads(text), ts, rtol=1e-9, atol=1e-9)
    return dict(zip(sol.bodies, np.moveaxis(np.asarray(sol.q), 1, 0), strict=True))


def all_fixes(text):
    """Return the findings of a drawing, and its fixes."""
    found = diagnose_drawing(text)
    return found, [fix for redundancy in found["sets"] for fix in redundancy["fixes"]]


def test_every_scene_of_the_library_is_a_template():
    assert {*udk.library.__all__} <= {*LIBRARY_TEMPLATES}


@pytest.mark.parametrize(
    "template", ["parallelogram", *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES if name != "parallelogram")]
)
def test_every_fix_can_be_read_and_removes_redundancy(template):
    text = template_text(template)
    before, fixes = all_fixes(text)
    for fix in fixes:
        assert fix["document"] is not None, fix
        changed = compile_drawing(text, fix["document"])
        assert changed["problems"] == []
        after = diagnose_drawing(changed["text"])
        assert after["redundant"] < before["redundant"] and after["joint_mobility"] == before["joint_mobility"]


@pytest.mark.slow
@pytest.mark.parametrize("template", NAMES)
def test_every_fix_leaves_the_motion_as_it_was(template):
    text = template_text(template)
    scene = compile_drawing(text)["scene"]
    ts = np.linspace(0.0, PART * scene["duration"], INSTANTS)
    fixes = all_fixes(text)[1]
    before = positions(text, ts) if fixes else {}
    for fix in fixes:
        after = positions(compile_drawing(text, fix["document"])["text"], ts)
        for body, q in before.items():
            np.testing.assert_allclose(after[body], q, rtol=0, atol=1e-6 * scene["length"], err_msg=f"{fix['change']}: {body}")
