"""Where commands let JAX store what it compiles."""

import os
import subprocess
import sys

import pytest

SHOW = """
import os
from udkjax.cli import store_compiled_programs
store_compiled_programs()
print(os.environ.get("JAX_COMPILATION_CACHE_DIR"))
"""


@pytest.mark.parametrize(
    "given, expected",
    [
        ({"UDKJAX_CACHE": "/somewhere"}, "/somewhere/jax"),
        ({"UDKJAX_CACHE": "0"}, "None"),
        ({"UDKJAX_CACHE": "/somewhere", "JAX_COMPILATION_CACHE_DIR": "/elsewhere"}, "/elsewhere"),
    ],
    ids=["beside machine code", "nowhere", "where it was told to"],
)
def test_programs_are_stored_beside_machine_code(given, expected):
    environment = {name: text for name, text in os.environ.items() if not name.startswith("JAX_")} | given
    shown = subprocess.run([sys.executable, "-c", SHOW], env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == expected


def test_who_has_imported_jax_is_left_alone():
    code = f"import jax\n{SHOW}"
    environment = {name: text for name, text in os.environ.items() if not name.startswith("JAX_")}
    shown = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "None"
