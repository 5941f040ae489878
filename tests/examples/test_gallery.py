"""The examples of the gallery run, and what they claim is so."""

import re
from importlib import import_module
from pathlib import Path

import pytest

import udkjax as udk
from examples.gallery import __main__ as gallery

ROOT = Path(__file__).parents[2]
FACTS = {  # of each example, what must be true of the numbers that it prints
    "four_bar": lambda torque, back: 0.01 < torque < 10 and back < 1e-6,
    "parallelogram": lambda violation, energy: violation < 1e-12 and energy < 1e-5,
    "five_bar": lambda projected, rate: projected < 1e-12 and rate < 0.05,
    "excavator": lambda taken: taken > 0,
    "jansen_leg": lambda flat, step, back: 0.4 < flat < 0.7 and step > 0.5 and back < 1e-9,
    "peaucellier": lambda off, length: off < 1e-12 and length > 1,
    "scissor_lift": lambda rows, freedoms, drift: rows == 2 and freedoms == 1 and drift < 1e-4,
    "dwell_cam": lambda rest, lift, off: rest > 1 / 3 and abs(lift - 0.15) < 1e-3 and off < 1e-3,
    "planetary_gear": lambda ratio, willis: abs(ratio - willis) < 1e-12,
    "hammer": lambda blows, rebound, between: blows > 10 and abs(rebound - 0.6) < 1e-9 and abs(between - 1) < 1e-6,
    "toggle_clamp": lambda limit, dry, greased: limit == 2 and abs(dry - 0.5) < 1e-9 and greased > 20,
    "woodpecker": lambda pecks, time, descent, gain: (
        pecks == 6 and abs(time - 0.220) < 0.001 and 75 < descent < 80 and gain < 1e-9
    ),
    "rod_on_floor": lambda slides, vaults, found, limit: abs(slides) + abs(vaults - 180) < 1e-6 and abs(found - limit) < 1e-8,
    "identification": lambda off, *_: off < 3,
    "double_pendulum_map": lambda members, over, calm, failed: members == 2500 and over > 0.1 and calm == 0 and failed == 0,
    "neural_friction": lambda after, before, law: after < 0.1 * before and law < 0.4,
    "workshop_four_bar": lambda before, hit, after, gap: before < 80 and hit < -4 and after > 99 and gap > 2.5,
    "designed_paths": lambda line, letter, foot: line < 0.1 and letter < 2 and foot < 1,
    "drawn_curves": lambda *errors: len(errors) == 4 and max(errors) < 0.03,
    "six_bar_dwell": lambda swing, rest: 29 < swing < 36 and rest < 0.5,
}


def test_every_script_is_in_the_gallery_and_is_tested():
    scripts = {path.stem for path in (ROOT / "examples" / "gallery").glob("*.py")} - {"__main__"}
    assert scripts == set(gallery.NAMES) == set(FACTS)


# Bytes of pages; a third of the woodpecker's is the code of its impacts.
LONGEST, LONGER = 300_000, {"woodpecker": 450_000}


def test_every_drawing_is_in_the_gallery_and_short():
    drawings = {path.stem: path for path in (ROOT / "examples" / "drawings").glob("*.toml")}
    assert drawings.keys() == gallery.DRAWINGS.keys()
    assert all(len(path.read_text(encoding="utf-8").splitlines()) <= 25 for path in drawings.values())


@pytest.mark.parametrize("name", gallery.DRAWINGS)
def test_a_drawing_moves_as_it_is_drawn(name):
    """It is closed as drawn, and has at most one degree of freedom without a motor."""
    found = udk.check(udk.load(ROOT / "examples" / "drawings" / f"{name}.toml"))
    assert found.closed and found.residual_before < 1e-12 and found.degrees_of_freedom <= 1
    assert found.moved == found.suspicious == found.redundant == ()


@pytest.mark.slow
@pytest.mark.parametrize("name", gallery.DRAWINGS)
def test_the_picture_of_a_drawing(name, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    (violation,) = gallery.make(name, tmp_path)["facts"].values()
    assert violation < 1e-9 and (tmp_path / f"{name}.html").stat().st_size < LONGEST


@pytest.mark.slow
@pytest.mark.parametrize("name", gallery.NAMES)
def test_an_example_shows_what_it_says(name, tmp_path):
    example = gallery.make(name, tmp_path)
    assert FACTS[name](*example["facts"].values()), example["facts"]
    assert (tmp_path / f"{name}.html").stat().st_size < LONGER.get(name, LONGEST)
    assert '<script src="player.js"></script>' in (tmp_path / f"{name}.html").read_text(encoding="utf-8")
    assert (tmp_path / "player.js").read_bytes() == (ROOT / "docs" / "gallery" / "player.js").read_bytes()  # else make one anew
    for file in example["files"]:
        assert (tmp_path / file).read_bytes().startswith(b"\x89PNG")
    assert name in gallery.page([example]) and import_module(f"examples.gallery.{name}").__doc__


def test_the_pictures_of_the_page_are_there_and_small():
    folder = ROOT / "docs" / "gallery"
    text = (folder / "index.md").read_text(encoding="utf-8")
    pictures = [part.split(")")[0] for part in text.split("](") if part.split(")")[0].endswith(".png")]
    assert len(pictures) >= 10 and all((folder / picture).exists() for picture in pictures)
    assert sum(path.stat().st_size for path in folder.glob("*.png")) < 1_000_000
    titles = [str(import_module(f"examples.gallery.{name}").__doc__).splitlines()[0] for name in gallery.NAMES]
    assert all(title in text.replace("$", "").replace("\\\\mu", "mu") for title in titles)


@pytest.mark.parametrize("name", [name for group in gallery.GROUPS.values() for name in group])
def test_the_page_of_an_example_says_what_to_try(name):
    text = (ROOT / "docs" / "gallery" / f"{name}.html").read_text(encoding="utf-8")
    assert text == gallery.with_bar(re.sub(r"<style>\nbody \{.*?(?=<div id=.player)", "", text, flags=re.S), name)
    assert (ROOT / gallery.source(name)).is_file()
    ((_, section),) = re.findall(r'<p id="bar"><a href="(index.html)#([\w-]+)">', text)
    headings = re.findall(r"^### (.*)$", (ROOT / "docs" / "gallery" / "index.md").read_text(encoding="utf-8"), re.M)
    assert section in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.slow
def test_live_pages_of_the_gallery_simulate(browser):
    player, loaded = "document.getElementById('player').player", {}
    for path in sorted((ROOT / "docs" / "gallery").glob("*.html")):
        page = browser.new_page()
        page.goto(path.as_uri())
        loaded[path.stem] = page.evaluate(f"(async () => !{player}.live || await {player}.live.ready)()")
        page.close()
    assert [name for name, works in loaded.items() if not works] == []  # else make them anew
