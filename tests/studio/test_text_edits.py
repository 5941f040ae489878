"""Documents merged into their texts: changes are written, comments stay, and nothing else moves."""

import copy

import pytest

from udkjax.scene.tables.checks import SceneError
from udkjax.studio.limits import RefusedError
from udkjax.studio.text_edits import merge_document, read_document

TEXT = """# A linkage of a test
format = 2 # drawings
units = {length = "mm"} # of plain numbers
ground = ["O"] # fixed

[pins]
O = [0, 0] # the origin
A = [1, 2] # a

# the crank
[[link]]
name = "crank" # c
pins = ["O", "A"]
density = 7850 # steel
width = 15

# the second
[[link]]
name = "two"
pins = ["A", "B"]

[[motor]]
pin = "O" # at O
speed = "60 rpm"
"""
INLINE = """format = 2
link = [
  {name = "crank", pins = ["O", "A"], density = 7850}, # c
  {name = "two", pins = ["A", "B"]},
]
motor = [{pin = "O", speed = "60 rpm"}]

[pins]
O = [0, 0] # the origin
A = [1, 2]
"""


@pytest.mark.parametrize("text", [TEXT, INLINE, "", "# nothing\n"])
def test_an_unchanged_document_gives_the_same_text(text):
    assert merge_document(text, read_document(text)) == text


@pytest.mark.parametrize("text", [TEXT, INLINE])
def test_a_moved_pin_changes_its_line_alone(text):
    document = read_document(text)
    document["pins"]["A"] = [3.5, -2]
    assert merge_document(text, document) == text.replace("A = [1, 2]", "A = [3.5, -2]")


def changes(document):
    """Iterate over changed copies of a document."""

    def removed(d):
        del d["link"][0]

    def added(d):
        d["link"].append({"name": "three", "pins": ["A", "C"], "mass": 1.25})
        d["pins"]["C"] = [5, 5]

    def first(d):
        d["motor"].insert(0, {"pin": "A", "speed": "1 rpm"})

    def retold(d):
        d["link"][1] = {"name": "deux", "pins": ["B", "A"]}
        d["motor"][0]["speed"] = 6.28

    def emptied(d):
        del d["link"], d["motor"]

    def more(d):
        d["spring"] = [{"between": ["O", "A"], "stiffness": "1 N/mm"}]
        d["cam"] = [{"pins": ["O", "A"], "profile": {"angle": [0, 1.5], "radius": [1, 2]}}]
        d["name"] = 'quoted " \\ and\nbroken'

    for change in (removed, added, first, retold, emptied, more):
        changed = copy.deepcopy(document)
        change(changed)
        yield changed


@pytest.mark.parametrize("text", [TEXT, INLINE])
def test_every_change_is_written_and_undone(text):
    before = read_document(text)
    for document in changes(before):
        written = merge_document(text, document)
        assert read_document(written) == document
        assert read_document(merge_document(written, before)) == before


def test_comments_stay_where_they_belong():
    document = read_document(TEXT)
    document["pins"]["B"] = [3, 4]
    document["link"].append({"name": "three", "pins": ["A", "B"]})
    written = merge_document(TEXT, document)
    assert "A = [1, 2] # a\nB = [3, 4]\n\n# the crank\n[[link]]\n" in written
    for comment in ("# A linkage of a test", "# drawings", "# of plain numbers", "# fixed", "# the origin", "# steel", "# at O"):
        assert comment in written


def test_a_document_without_a_text_becomes_a_file():
    document = {
        "format": 2,
        "units": {"length": "mm"},
        "ground": ["O"],
        "pins": {"O": [0, 0]},
        "link": [{"name": "a", "pins": ["O"]}],
    }
    text = merge_document("", document)
    assert read_document(text) == document
    assert "[pins]\nO = [0, 0]" in text and '[[link]]\nname = "a"' in text


def test_numbers_that_are_not_finite_become_strings():
    document = read_document("format = 2\n[pins]\nA = [nan, inf]\nB = [-inf, 1e400]\n")
    assert document["pins"] == {"A": ["nan", "inf"], "B": ["-inf", "inf"]}


def test_bad_input_is_named():
    with pytest.raises(SceneError, match="TOML"):
        read_document("format = ")
    with pytest.raises(SceneError, match="TOML"):
        merge_document("format = ", {"format": 2})
    with pytest.raises(SceneError, match="name has no value"):
        merge_document("", {"name": None})
    with pytest.raises(RefusedError, match="characters"):
        read_document("#" * 1_000_000)
    with pytest.raises(RefusedError, match="text: must be a string"):
        read_document(None)
    with pytest.raises(RefusedError, match="elements"):
        read_document("[pins]\n" + "".join(f"p{k} = [0, 0]\n" for k in range(2_000)))
