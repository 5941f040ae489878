"""Folders in which commands let JAX store compiled programs."""

import os
import sys
from pathlib import Path

import pytest

from udkjax import folders
from udkjax.cli import store_compiled_programs

CASES = {
    "beside machine code": ({"UDKJAX_CACHE": "/somewhere"}, False, "/somewhere/jax"),
    "nowhere, as the folder cannot be written": ({"UDKJAX_CACHE": "/sealed"}, False, None),
    "nowhere": ({"UDKJAX_CACHE": "0"}, False, None),
    "where it was told to": ({"UDKJAX_CACHE": "/somewhere", "JAX_COMPILATION_CACHE_DIR": "/elsewhere"}, False, "/elsewhere"),
    "left alone where JAX is imported already": ({"UDKJAX_CACHE": "/somewhere"}, True, None),
}


@pytest.mark.parametrize(("given", "imported", "expected"), CASES.values(), ids=list(CASES))
def test_programs_are_stored_beside_machine_code(monkeypatch, given, imported, expected):
    monkeypatch.setattr(os, "environ", dict(given))
    if not imported:
        monkeypatch.delitem(sys.modules, "jax")
    monkeypatch.setattr(folders, "is_writable", lambda folder: folder != Path("/sealed"))
    store_compiled_programs()
    assert os.environ.get("JAX_COMPILATION_CACHE_DIR") == expected
