"""Where commands let JAX store what it compiles."""

import pytest

from tests.fresh_process import python

SHOW = """
import os
from udkjax.cli import store_compiled_programs
store_compiled_programs()
print(os.environ.get("JAX_COMPILATION_CACHE_DIR"))
"""


@pytest.mark.parametrize(
    "code, given, expected",
    [
        (SHOW, {"UDKJAX_CACHE": "/somewhere"}, "/somewhere/jax"),
        (SHOW, {"UDKJAX_CACHE": "0"}, "None"),
        (SHOW, {"UDKJAX_CACHE": "/somewhere", "JAX_COMPILATION_CACHE_DIR": "/elsewhere"}, "/elsewhere"),
        (f"import jax\n{SHOW}", {"UDKJAX_CACHE": "/somewhere"}, "None"),
    ],
    ids=["beside machine code", "nowhere", "where it was told to", "left alone where JAX is imported already"],
)
def test_programs_are_stored_beside_machine_code(code, given, expected):
    assert python(code, **given) == expected
