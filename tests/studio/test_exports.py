"""Exports of the studio show the position in which the page is, and links that touch there."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.requirements import ArgumentError
from udkjax.statics.reaction_peaks import RestingPositions
from udkjax.studio import tasks
from udkjax.studio.exports import exported
from udkjax.studio.limits import RefusedError
from udkjax.studio.shown_runs import shown_run
from udkjax.studio.text_edits import merge_document, read_document

CRANK = tasks.template_text("crank_rocker")
WIDE = {**read_document(CRANK)}
WIDE["link"] = [link | ({"width": "90 mm"} if len(link["pins"]) == 2 else {}) for link in WIDE["link"]]


def test_a_picture_shows_the_pose_of_the_page(client):
    mechanism, t = udk.loads(CRANK), 0.7123
    run = shown_run(mechanism)
    animation = udk.animate(mechanism, run)
    pictures = {}
    for name, pose in {"drawn": {}, "at a time": {"t": t}, "posed": {"q": np.ravel(animation.pose(t)[0]).tolist()}}.items():
        assert client.ask("save", path="a.svg", text=CRANK, revision=None, export=True, pose=pose).status_code == 200
        pictures[name] = (client.folder / "a.svg").read_text()
        (client.folder / "a.svg").unlink()
    assert pictures["drawn"] == animation.save(client.folder / "b.svg", labels=True).read_text()
    assert pictures["at a time"] == animation.save(client.folder / "b.svg", t, labels=True).read_text()

    def pins(picture):
        return [line for line in picture.splitlines() if 'class="pin"' in line]

    assert pins(pictures["drawn"]) != pins(pictures["at a time"])
    still = RestingPositions(np.array([0.0, 1.0]), np.stack([animation.pose(t)[0]] * 2), np.zeros((2, 3, 3)))
    assert pictures["posed"] == udk.animate(mechanism, still).save(client.folder / "b.svg", labels=True).read_text()


@pytest.mark.parametrize("pose", [{"t": None}, {"t": [1]}, {"t": "x"}, {"q": [1, 2]}, {"q": "x"}, {"q": [float("nan")] * 9}])
def test_a_pose_is_a_time_or_coordinates(pose):
    with pytest.raises(RefusedError, match="finite number"):
        exported(udk.loads(CRANK), CRANK, ".svg", pose)


def test_links_that_touch_are_red_in_exports_once_gaps_are_found():
    text = merge_document(CRANK, WIDE)
    mechanism = udk.loads(text)
    least = udk.gaps(mechanism, run=shown_run(mechanism)).least
    assert least.distance < 0
    for pose in ({"t": least.value}, {"q": np.ravel(least.q).tolist()}):
        svg = exported(mechanism, text, ".svg", pose, True).decode()
        assert svg.count('class="touching"') >= 2
        assert 'class="touching"' not in exported(mechanism, text, ".svg", pose).decode()
        assert exported(mechanism, text, ".png", pose, True) != exported(mechanism, text, ".png", pose)
    assert len(exported(mechanism, text, ".html", None, True)) > 100_000  # live, without gaps


def test_a_drawing_without_masses_and_motors_has_a_picture():
    bare = {**read_document(CRANK)}
    bare["link"] = [{"name": link["name"], "pins": link["pins"]} for link in bare["link"]]
    del bare["motor"]
    text = merge_document("", bare)
    svg = exported(udk.loads(text), text, ".svg").decode()
    assert all(f">{pin}</text>" in svg for pin in bare["pins"])
    with pytest.raises(ArgumentError, match="have no mass"):
        exported(udk.loads(text), text, ".gif")
