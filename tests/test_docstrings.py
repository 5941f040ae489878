"""Docstrings are sentences; public functions describe their arguments, results and errors."""

import ast
import inspect
import io
import re
import tokenize
from pathlib import Path

import pytest

import udkjax
from udkjax.equations.states import evaluate

NO_SUBJECT = re.compile("(What|Whatever|Whether|Which|Who|Whose|How|Where|When|As|Those|That)\\b")
OBJECT = re.compile("(?:Return|Iterate over) (what|whatever|who|how many|how far|how much|how often|where)\\b")  # likewise
CLAUSE = re.compile("(what|whatever|which|who|whose|how|that|those)\\b", re.IGNORECASE)  # begins no description, and no comment
PUBLIC = {f"udkjax.{name}": getattr(udkjax, name) for name in udkjax.__all__}
PUBLIC |= {
    f"udkjax.equations.{name}": found
    for name, found in vars(evaluate).items()
    if hasattr(found, "__wrapped__") and name[0] != "_"
}
FUNCTIONS = {name: x for name, x in PUBLIC.items() if inspect.isfunction(x)}


def described(doc: str, section: str) -> set[str]:
    """Return the names described in a section of a docstring in Google's style."""
    found = re.search(rf"^{section}:\n((?: +.*\n?|\n)+)", doc, re.M)
    return set(re.findall(r"^ {4}\**(\w+): ", found[1], re.M)) if found else set()


def test_functions_are_found():
    assert len(FUNCTIONS) > 50
    assert "udkjax.simulate" in FUNCTIONS
    assert "udkjax.equations.psi_q" in FUNCTIONS


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_describes_its_arguments_and_its_result(name):
    function = FUNCTIONS[name]
    doc, signature = inspect.getdoc(function) or "", inspect.signature(function)
    assert described(doc, "Args") == set(signature.parameters)
    if signature.return_annotation is not None:
        assert re.search(r"^Returns:\n    \S", doc, re.M)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_it_raises_is_described(name):
    function = FUNCTIONS[name]
    raised = set(re.findall(r"raise (\w+)\(", inspect.getsource(function)))
    assert raised <= described(inspect.getdoc(function) or "", "Raises")


def test_a_missing_argument_is_noticed():
    doc = "Do it.\n\nArgs:\n    one: The first.\n    two: The\n        second: with a colon.\n\nReturns:\n    x: No."
    assert described(doc, "Args") == {"one", "two"}


def without_subject(text: str) -> list[str]:
    """Return the first lines of docstrings that begin with a word that cannot begin a sentence with a subject."""
    kinds = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    docs = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)]
    return [doc.splitlines()[0] for doc in docs if NO_SUBJECT.match(doc) or OBJECT.match(doc)]


def clauses(text: str) -> list[str]:
    """Return descriptions of arguments and attributes, and comments, that begin with a clause instead of a noun or verb."""
    kinds = ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    docs = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)]
    sections = [found for doc in docs for found in re.findall(r"^(?:Args|Attributes):\n((?: +.*\n?|\n)+)", doc, re.M)]
    described = [line for section in sections for line in re.findall(r"^ {4}(\w+: .*)$", section, re.M)]
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type == tokenize.COMMENT]
    own = {token.start[0] for token in tokens if token.line.strip() == token.string}
    first = [token.string for token in tokens if not (token.start[0] in own and token.start[0] - 1 in own)]
    return [x for x in described if CLAUSE.match(x.partition(": ")[2])] + [x for x in first if CLAUSE.match(x[2:])]


def test_docstrings_are_sentences_with_a_subject():
    texts = {file: file.read_text(encoding="utf-8") for file in sorted(Path(udkjax.__file__).parent.rglob("*.py"))}
    assert {f"{file}: {x}" for file, text in texts.items() for x in (*without_subject(text), *clauses(text))} == set()


def test_a_docstring_without_a_subject_is_noticed():
    text = 'class One:\n    """Thosely."""\n    def f(self):\n        """As `g`."""\ndef g():\n    """Whether it is."""'
    text += '\ndef h():\n    """Return what it is."""\ndef i():\n    """Return it, whatever it is."""'
    assert without_subject(text) == ["Whether it is.", "Return what it is.", "As `g`."]


def test_a_clause_in_place_of_a_noun_is_noticed():
    text = "A = 1  # that is told\nB = 2  # m\n# One\n# which two\n"
    text += 'def f(x, y):\n    """Do.\n\n    Args:\n        x: which of them.\n        y: the one.\n    """\n'
    assert clauses(text) == ["x: which of them.", "# that is told"]
