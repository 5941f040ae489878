"""Steps that are written into a function are what they are if they run one by one."""

import itertools
import math

import pytest

from udkjax.expressions.scalars import scalar_program
from udkjax.expressions.scalars.written_steps import PythonFunction

VALUES = (-2.0, -0.0, 0.0, 1.5, 3.0, math.inf, math.nan)
FUNCTIONS = {
    **{
        name: f
        for name, f in scalar_program._NUMBER_FUNCTIONS.items()
        if name in ("max", "min", "square", "lt", "ge", "eq", "ne")
    },
    "select": scalar_program._SELECT_OF_TWO,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_expression_is_what_its_function_returns(name):
    function, count = FUNCTIONS[name], {"square": 1, "select": 3}.get(name, 2)
    text = PythonFunction("values")
    arguments = [text.assign(f"values[{k}]") for k in range(count)]
    text.lines.append(f"return {text.call(function, *arguments)}")
    assert not any("f1" in line for line in text.lines)  # nothing is called
    run = text.compile()
    for values in itertools.product(VALUES, repeat=count):
        given = (bool(values[0] > 0), *values[1:]) if name == "select" else values
        assert repr(run(given)) == repr(function(*given))
