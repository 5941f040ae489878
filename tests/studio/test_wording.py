"""Messages in the studio name acts of its page, and nothing of Python."""

import ast
import re
from pathlib import Path

import pytest

import udkjax
from udkjax.studio import tasks
from udkjax.studio.text_edits import merge_document, read_document
from udkjax.studio.wording import PYTHON_WORDING, STUDIO_WORDS, UNKNOWN_CAUSE, in_studio_words, studio_words

PACKAGE = Path(udkjax.__file__).parent
BELOW = ("positions", "statics", "integrate", "equations/rows", "equations/states", "scene/model.py", "study/diagnosis")
TOOLS = (PACKAGE / "studio" / "page" / "tools.js").read_text(encoding="utf-8")
CRANK = tasks.template_text("crank_rocker")


def changed(**tables):
    """Return the crank-rocker with other tables, or without those whose value is None."""
    document = {**read_document(CRANK), **tables}
    return merge_document("", {key: value for key, value in document.items() if value is not None})


def links(is_wide=True, **numbers):
    """Return the links of the crank-rocker with other numbers alone, and bars with a width or not."""
    known = [{"name": link["name"], "pins": link["pins"], **numbers} for link in read_document(CRANK)["link"]]
    return [link | ({"width": "10 mm"} if is_wide and len(link["pins"]) == 2 else {}) for link in known]


MOTOR = read_document(CRANK)["motor"][0]
TWO = [MOTOR, {"pin": read_document(CRANK)["ground"][-1], "speed": "10 rpm"}]
LOOSE = {
    "pins": {**read_document(CRANK)["pins"], "Z": [300, 300]},
    "link": [*read_document(CRANK)["link"], {"name": "tail", "pins": ["B", "Z"], "mass": 1, "width": "10 mm"}],
}
SAID = {
    "gaps without a motor": (changed(motor=None), "gaps", "put a motor on a pin or a slide (Motor, M)"),
    "gaps with two": (changed(motor=TWO), "gaps", "this needs one motor, and there are motor1, motor2: delete the others"),
    "gaps with a loose link": (changed(**LOOSE), "gaps", "put a motor on what still moves, tail (Motor, M), or fix a pin of it"),
    "gaps without widths": (changed(link=links(False, mass=1)), "gaps", "has no width: select it, and type its width"),
    "equilibrium without masses": (changed(link=links(), gravity=[0, "-9.81 m/s2"]), "rest", "type its mass, or select nothing"),
    "forces without masses": (changed(link=links()), "dynamics", "on which efforts depend: select each, and type"),
    "holding what is free": (
        changed(**LOOSE),
        "holding",
        "put a motor on what still moves (Motor, M), or ask for the Equilibrium",
    ),
    "contradicting motors": (changed(motor=TWO), "structure", "contradict each other: delete one, or change its speed"),
}


@pytest.mark.parametrize("case", SAID)
def test_the_cure_is_an_act_of_the_page(case):
    text, about, words = SAID[case]
    assert not tasks.compile_drawing(text)["problems"]
    found = tasks.diagnose_drawing(text, about)
    said = " ".join([*found["problems"], found.get("conflict", ""), found.get("cause", "")])
    assert words in said and not PYTHON_WORDING.search(said) and "driver" not in said, said


def test_free_links_without_mass_need_one_or_a_motor():
    (said,) = tasks.compile_drawing(changed(link=links(), motor=None))["problems"]
    assert said.endswith("select each, and type its mass, or put a motor on a pin (Motor, M)")


def test_an_export_that_needs_masses_says_how_to_give_them(client):
    found = client.ask("save", path="a.gif", text=changed(link=links(), motor=None), revision=None, export=True)
    assert found.status_code == 422
    assert found.json()["problem"].endswith("select each, and type its mass, or put a motor on a pin (Motor, M)")


def test_tools_are_those_of_the_page():
    named = {act for words in STUDIO_WORDS.values() for act in re.findall(r"\((\w+), (\w)\)", words)}
    assert named == {("Motor", "M"), ("Ground", "G"), ("Select", "V")}
    for name, key in named:
        assert f'name: "{name.lower()}", key: "{key.lower()}"' in TOOLS


def messages():
    """Yield the strings of the modules whose messages reach the studio, with a brace pair for each number or name."""
    for name in BELOW:
        for file in [PACKAGE / name] if name.endswith(".py") else sorted((PACKAGE / name).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value


def test_every_pattern_is_that_of_a_message():
    known = list(messages())
    for pattern in STUDIO_WORDS:
        parts = re.split(r"\\.|\(.*?\)\??|\[.*?\]\*?|\.[*+]|[*+?\"]", pattern)
        words = [part.strip(" {},") for part in re.split("the others", pattern) + parts if len(part) > 8]
        assert any(part in message for message in known for part in words), pattern


def test_no_message_of_the_package_speaks_of_python():
    found = [message for message in messages() if PYTHON_WORDING.search(message)]
    assert len(found) > 100
    for message in found:
        said = studio_words(message)
        assert said and not PYTHON_WORDING.search(said), (message, said)


def test_words_of_names_stay_and_clauses_about_python_go():
    said = 'the limit of 9 steps was reached: force "drivers; the scene" jumps at 2 s: give its `breakpoints`, smooth it, or not'
    assert studio_words(said) == 'the limit of 9 steps was reached: force "drivers; the scene" jumps at 2 s'
    assert studio_words("loads (see udkjax check) of the scene; drivers (all) hold") == "loads of the drawing; motors (all) hold"
    assert studio_words("use `Auto()`") == UNKNOWN_CAUSE
    answer = {"problems": ["use `Auto()`"], "sets": [{"title": "the scene"}], "text": "the scene", "n": 2}
    assert in_studio_words(answer) == {
        "problems": [UNKNOWN_CAUSE],
        "sets": [{"title": "the drawing"}],
        "text": "the scene",
        "n": 2,
    }
