"""The fields of a cam's laws of lift in the studio's page, by mouse and keys."""

import pytest

import udkjax as udk


def typed(studio, label, text):
    studio.page.get_by_label(label, exact=True).fill(text)
    studio.page.keyboard.press("Enter")
    studio.page.wait_for_timeout(30)


@pytest.mark.slow
def test_the_laws_of_a_cam_are_edited_segment_by_segment_and_undone(studio):
    studio.js("studio.files.openTemplate('cam_follower')")
    studio.settle()
    first = studio.document
    studio.js("studio.select([{kind: 'cam', index: 0}])")
    studio.page.get_by_label("given by", exact=True).select_option("laws")
    profile = studio.document["cam"][0]["profile"]
    assert profile == {"base": 30, "law": ["cycloidal", "dwell"] * 2, "angle": [120, 60, 120, 60], "lift": [19, 0, -19, 0]}
    typed(studio, "lift 1", "2*12 mm")
    typed(studio, "angle 2", "90")
    studio.page.get_by_label("law 3", exact=True).select_option("3-4-5")
    studio.page.get_by_role("button", name="Add a segment").click()
    studio.page.get_by_label("law 5", exact=True).select_option("harmonic")
    typed(studio, "lift 5", "-4")
    profile = studio.document["cam"][0]["profile"]
    assert profile["law"] == ["cycloidal", "dwell", "3-4-5", "dwell", "harmonic"]
    assert profile["angle"] == [120, 90, 90, 30, 30] and profile["lift"] == [28, 0, -24, 0, -4]
    assert studio.page.get_by_label("lift 2", exact=True).is_disabled()
    typed(studio, "angle 1", "300")
    assert "its neighbour would have no angle left" in studio.status()
    assert studio.document["cam"][0]["profile"] == profile
    studio.settle()
    assert "profile" not in studio.findings
    studio.until("studio.motion.run?.count > 1")
    drawn = udk.loads(studio.js("studio.state.text"))
    height = udk.motion_at(drawn, "30 deg").pins["P"][0, 0, 1]
    assert height == pytest.approx(0.03 + 0.028 * (0.25 - 1 / 6.283185307179586), rel=1e-9)
    studio.page.get_by_role("button", name="remove segment 4").click()
    assert studio.document["cam"][0]["profile"]["angle"] == [120, 90, 90, 60]
    for _ in range(8):
        studio.page.keyboard.press("Control+z")
    studio.settle()
    assert studio.document == first
