"""Phrases that no native speaker writes are found by patterns in docstrings, comments, messages and pages.

`CLEAN` lists the folders and pages without any. Patterns cannot find everything: a sentence that has to be read twice is a
defect as well.
"""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

import udkjax

ROOT = Path(udkjax.__file__).parents[1]
CLEAN = [  # folders with all below them, or files
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "README.md",
    "benchmarks",
    "docs",
    "examples",
    "experiments",
    "tests/equations",
    "tests/expressions",
    "tests/native",
    "tests/pinv",
    "tests/programs",
    "tests/scene",
    "tests/study",
    "tests/transforms",
    "udkjax/__init__.py",
    "udkjax/annotations.py",
    "udkjax/equations",
    "udkjax/cli",
    "udkjax/expressions",
    "udkjax/extras.py",
    "udkjax/lazy_names.py",
    "udkjax/integrate",
    "udkjax/native",
    "udkjax/pinv",
    "udkjax/positions",
    "udkjax/printing.py",
    "udkjax/programs",
    "udkjax/progress.py",
    "udkjax/scene",
    "udkjax/show",
    "udkjax/statics",
    "udkjax/studio",
    "udkjax/study",
    "udkjax/synthesis",
    "udkjax/transforms",
    "udkjax/complementarity",
    "tests/show",
    "tests/studio",
]

# Pattern of the beginning of a docstring or a comment: (pattern, an example, a correct sentence).
BEGINNINGS = [
    (r"Of\b", "Of a step: nearer to an end than this, ...", "Fraction of a step."),
    (r"What(ever)?\b", "What a batch comes to.", "Batching rule."),
    (r"Those?\b", "Those that are done.", "These steps are done."),
    (r"That\b", "That of the bodies.", "The frame of the bodies."),
    (r"Whether\b", "Whether it is finite.", "True if it is finite."),
    (r"How\b", "How many there are.", "Number of bodies."),
    (r"Do nothing\.?$", "Do nothing.", "Do nothing: an evaluation sets `rank`."),
    (r"Write `\w+(\([\w, ]*\))?`\.$", "Write `settle_end`.", "Write `settle_end`: settle the loads at the end."),
    (r"Return those of\b", "Return those of chunk k.", "Return the random numbers of chunk k."),
    (r"(?:[A-Z][a-z]+){2,} (of|on|between)\b", "PosesAndRates of a body.", "Poses of a body."),
]
# Pattern of any text: likewise.
PHRASES = [
    (r"\bwhat is (no|none|not)\b", "Skip what is not finite.", "See what is new."),
    (r"\bwhere (it|there|they) (is|are) none\b", "Raise `TypeError` where it is none.", "There are none."),
    (r"\bthat is none\b", "A name that is none.", "None is given."),
    (r"\bnone of (which|whom)\b", "all lanes, none of which may be NaN", "None of them is."),
    (r"\b(of|from|in|by|beside|besides|than|with|before|after) what\b", "a function of what it reads", "See what happens."),
    (r"\bbehind (one another|each other|it|them|the last)\b", "They lie behind one another.", "the wall behind the house"),
    (r"\bone behind (another|the other)\b", "one behind another", "one after another"),
    (r"\b(besides|beside) (those|these|that|this|it|them)\b", "steps besides those asked for", "extra steps"),
    (r"\bso (many|much) (\w+ )?(as|numbers|entries|times|rows|steps)\b", "So many numbers.", "there were so many that it failed"),
    (
        r"\bas many( \w+)? as (it|they|he) (has|have|gives?|takes?)\b",
        "coordinates as many as he gives",
        "as many rows as columns",
    ),
    (r"\b(is|are|be) told\b", "the engine is told the unit", "it was untold"),
    (r"\bwhich one,", "a letter says which one, and", "which one is it?"),
    (r"(?<!there )\b(is|are) no (number|name|batch|program)\b", "where something is no name", "there is no number"),
    (r"\blikewise\b\.?$", "y: likewise.", "Likewise, rows are scaled."),
    (r"\b(that|those) which\b", "a thirtieth of that which jams", "the coefficient that jams"),
    (r"\bless (that|those|the)\b", "total energy, less that of the start", "no less than the load"),
    (r"\bof the user's own\b", "a system of the user's own", "the user's own system"),
    (r"\bnone to (see|be)\b", "no cause, if there is none to see", "there is none"),
    (r"\bwritten out\b", "small matrices, written out", "The loops are unrolled."),
    (r"\bis said by\b", "A wrong threshold is said by its result.", "It is said to be exact."),
    (r"^Return .*, or None\.$", "Return the pin in a hole, or None.", "Return the pin; None if there is none."),
    (r"\bbase of both\b", "The base of both modes.", "Base of forward and reverse mode."),
    (r"(?<!are )\bin two parts\b", "the logarithm in two parts", "a sum of two doubles; they are two parts of one force"),
    (
        r"\b(the rates that|what rates) are left\b",
        "the state, and the rates that are left",
        "the largest remaining row of Psi_dot",
    ),
    (r"\bwhat is left (of|out)\b", "and what is left out of balance", "and the unbalanced part"),
    (r"\b(with|about|for|each`?) so many (members|bytes|of)\b", "about so many of the draws", "about `draws` draws"),
    (r"\b(not|are|is) worth it\b", "None if that is not worth it", "None until compiling pays off"),
    (r"\bas (a|the) course (asks|counts|says)\b", "the angle as a course counts it", "as textbooks count it"),
    (r"\bas (it was|they were) found when\b", "contacts as they were found when it ran", "contacts as the run found them"),
    (
        r"\bpart of a \w+ that is not (numbers|a number)\b",
        "The part of a system that is not numbers.",
        "Everything except its numbers.",
    ),
    (r"\binstead of these\.", "the shapes of its arrays instead of these.", "shapes in place of the arrays."),
    (r"\bmove alike\b", "the point at which two links move alike", "the point with the same velocity"),
    (r"\bcounts? as (it is|they are) drawn\b", "Angles count as they are drawn.", "Angles are those of the drawing."),
]


def texts(source: str) -> tuple[list[str], list[str]]:
    """Return the docstrings and comments of a module, and its other texts of several words."""
    tree = ast.parse(source)
    owners = [node for node in ast.walk(tree) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
    docs = [node.body[0].value for node in owners if ast.get_docstring(node)]  # pyright: ignore[reportAttributeAccessIssue]
    messages = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    comments: list[str] = []
    blocks: dict[int, str] = {}  # of lines that are comments alone, by the last line
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        comment = token.string[1:].strip()
        if token.line.strip() != token.string:
            comments.append(comment)
        else:
            blocks[token.start[0]] = f"{blocks.pop(token.start[0] - 1, '')} {comment}".strip()
    return [*(doc.value for doc in docs), *comments, *blocks.values()], [text for text in messages if " " in text.strip()]


def script_texts(source: str) -> tuple[list[str], list[str]]:
    """Return the comments of a JavaScript module, and its strings of several words."""
    found = re.findall(r'"(?:[^"\\\n]|\\.)*"|`(?:[^`\\]|\\.)*`|/\*.*?\*/|(?:^//[^\n]*\n)+|//[^\n]*', source, flags=re.M | re.S)
    comments = [re.sub(r"^ *(//|/?\*+/?) ?|\*/$", "", text, flags=re.M).strip() for text in found if text.startswith("/")]
    return comments, [text[1:-1] for text in found if not text.startswith("/") and " " in text.strip()]


def one_line(text: str) -> str:
    return " ".join(text.split())


def prose(page: str) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^( *)```.*?^\1```", "", page, flags=re.M | re.S)


def findings(begun: list[str], other: list[str]) -> list[str]:
    """Return the phrases that patterns find: patterns of beginnings are applied to the first texts, the others to all."""
    found = [match[0] for text in begun for pattern, *_ in BEGINNINGS if (match := re.match(pattern, text))]
    lines = [line for text in (*begun, *other) for line in (*text.splitlines(), one_line(text))]
    found += [match[0] for line in lines for pattern, *_ in PHRASES if (match := re.search(pattern, line, re.IGNORECASE))]
    return sorted(set(found))


def files(name: str) -> list[Path]:
    place = ROOT / name
    return [place] if place.is_file() else sorted(x for x in place.rglob("*") if x.suffix in (".py", ".md", ".js"))


def problems(file: Path) -> list[str]:
    text = file.read_text(encoding="utf-8")
    parts = {".py": texts, ".js": script_texts}.get(file.suffix, lambda page: ([], prose(page).split("\n\n")))
    found = findings(*parts(text))
    return [f"{file.relative_to(ROOT)}: {phrase}" for phrase in found]


@pytest.mark.parametrize("name", CLEAN)
def test_no_phrase_is_found(name):
    assert files(name)
    assert [problem for file in files(name) for problem in problems(file)] == []


@pytest.mark.parametrize(("pattern", "wrong", "right"), BEGINNINGS)
def test_each_beginning_finds_its_example_alone(pattern, wrong, right):
    assert findings([wrong], []) and re.match(pattern, wrong)
    assert not findings([right], [])


@pytest.mark.parametrize(("pattern", "wrong", "right"), PHRASES)
def test_each_phrase_finds_its_example_alone(pattern, wrong, right):
    assert findings([], [wrong]) and re.search(pattern, wrong, re.IGNORECASE)
    assert not findings([], [right])


def test_texts_of_a_module_are_found():
    source = '"""Module of two."""\nA = 1  # one\n# Two\n# three\nB = f"four five {A}"\n'
    assert texts(source) == (["Module of two.", "one", "Two three"], ["Module of two.", "four five "])


def test_texts_of_a_script_are_found():
    source = (
        '// Of one.\n// Two.\nlet a = "three four";  // five\n/** Six\n *  seven. */\nlet b = `eight ${a} nine`, c = "ten";\n'
    )
    assert script_texts(source) == (["Of one.\nTwo.", "five", "Six\n seven."], ["three four", "eight ${a} nine"])


def test_phrases_across_lines_are_found():
    assert findings(["Of\nall."], ["none\nof which"]) == ["Of", "none of which"]


def test_code_on_a_page_is_passed_over():
    assert prose("a\n```python\nof what\n```\nb") == "a\n\nb"
