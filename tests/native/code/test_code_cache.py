"""Stored machine code is executed only under its own name, and only if nobody else may have written it."""

import ctypes
import os
import shutil

import pytest

from udkjax import folders
from udkjax.native.code import code_cache, machine
from udkjax.show import doctor

TEXT = """
define double @value() {{
  ret double {}
}}
"""


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    path = tmp_path / "own" / "cache"
    monkeypatch.setenv("UDKJAX_CACHE", str(path))
    return path


def value(number):
    """The number that a module returns whose text says so."""
    library = machine.library(TEXT.format(f"{number:.1f}"), ["value"])
    return ctypes.CFUNCTYPE(ctypes.c_double)(library["value"])()


def test_code_under_the_name_of_other_code_is_compiled_again(folder):
    assert value(1) == 1.0
    (first,) = folder.iterdir()
    assert value(2) == 2.0
    (second,) = set(folder.iterdir()) - {first}
    shutil.copy(first, second)
    assert code_cache.read(second.name) is None and value(2) == 2.0
    assert code_cache.read(second.name) is not None  # stored anew
    second.write_bytes(second.read_bytes()[:-1] + b"?")
    assert code_cache.read(second.name) is None and value(2) == 2.0


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of Unix")
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_a_folder_that_others_may_write_is_not_used(folder, mode):
    code_cache.write("name", b"code")
    assert folder.stat().st_mode & 0o777 == 0o700 and code_cache.read("name") == b"code"
    folder.chmod(mode)
    code_cache.write("other", b"code")
    assert code_cache.read("name") is None and [x.name for x in folder.iterdir()] == ["name"]
    assert value(3) == 3.0
    found = doctor.facts()
    assert "nothing in " in doctor.summary(found) and found["cache_refused"] == "others may write to it"
    assert any(f"chmod go-w {folder}" in line for line in found["advice"])
    folder.chmod(0o755)  # others may read
    assert code_cache.read("name") == b"code" and doctor.facts()["cache_refused"] is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of Unix")
def test_files_of_others_and_files_that_others_may_write_are_not_used(folder, monkeypatch):
    code_cache.write("name", b"code")
    for mode in (0o620, 0o602):
        (folder / "name").chmod(mode)
        assert code_cache.read("name") is None
    code_cache.write("name", b"code")
    assert code_cache.read("name") == b"code"
    monkeypatch.setattr(folders.os, "getuid", lambda: folder.stat().st_uid + 1, raising=False)
    is_root = folder.stat().st_uid == 0  # whose code everybody runs
    assert (folders.refusal(folder) is None) == is_root
    assert code_cache.read("name") == (b"code" if is_root else None)
    status = os.stat_result((0o100600, 0, 0, 1, folder.stat().st_uid + 2, 0, 0, 0, 0, 0))
    assert folders.distrust(status) == "it belongs to another user"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of Unix")
@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_a_name_that_is_no_regular_file_is_no_code(folder, kind):
    folder.mkdir(parents=True, mode=0o700)
    path = folder / "name"
    {"pipe": os.mkfifo, "folder": os.mkdir, "device": lambda path: os.symlink("/dev/zero", path)}[kind](path)
    assert code_cache.read("name") is None
    code_cache.write("name", b"code")
    assert code_cache.read("name") == (None if kind == "folder" else b"code")
    assert not [x for x in folder.iterdir() if x != path]
