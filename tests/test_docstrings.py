"""Public functions of the lower floors name their arguments, their results and their errors."""

import inspect
import re

import pytest

from udkjax import equations, expressions, pinv, scene

FLOORS = scene, pinv, expressions, equations
FUNCTIONS = {
    f"{floor.__name__}.{name}": found
    for floor in FLOORS
    for name, found in vars(floor).items()
    if inspect.isfunction(found) and not name.startswith("_") and found.__module__.startswith(floor.__name__)
}


def described(doc: str, section: str) -> set[str]:
    """The names that a section of a docstring in Google's style describes."""
    found = re.search(rf"^{section}:\n((?: +.*\n?|\n)+)", doc, re.M)
    return set(re.findall(r"^ {4}(\w+): ", found[1], re.M)) if found else set()


def test_functions_are_found():
    assert len(FUNCTIONS) > 25
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
