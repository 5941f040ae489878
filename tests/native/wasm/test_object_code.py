"""Modules made from LLVM's object code: exports, imports and constants, and refusal of other bytes."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.calls import calls_of
from tests.wasm_host import Host
from udkjax.native.code import machine
from udkjax.native.language import elementary
from udkjax.native.language.ir import POINTER, Function
from udkjax.native.language.text import text_of_module
from udkjax.native.wasm import compile_wasm
from udkjax.native.wasm.object_code import MAGIC, Reader, leb128, link


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, 2**21 - 1, 2**32])
def test_whole_numbers_are_read_as_they_are_written(number):
    reader = Reader(leb128(number) + b"\x05")
    assert reader.number() == number and reader.byte() == 5 and not reader


@pytest.mark.parametrize(("number", "code"), [(624485, b"\xe5\x8e\x26"), (3, b"\x03")])
def test_leb128_is_that_of_the_specification(number, code):
    assert leb128(number) == code


def doubled(name, factor):
    f = Function(name, [(POINTER, "x"), (POINTER, "y")])
    f.store(f.load(f.given["x"]) * factor, f.given["y"])
    return f


def test_each_of_several_functions_is_exported_by_its_name():
    text = "\n".join(doubled(name, factor).text() for name, factor in (("twice", 2.0), ("hidden", 5.0), ("thrice", 3.0)))
    linked = compile_wasm(text, ("thrice", "twice"))
    host = Host(linked.code, linked.data_end)
    host.begin()
    x, y = host.put([7.0]), host.put([0.0])
    for name, expected in (("twice", 14.0), ("thrice", 21.0)):
        host.call(name, x, y)
        assert host.numbers(y, 1)[0] == expected
    assert linked.imports == () and linked.data_end == 0


def test_functions_that_a_module_does_not_define_are_imports():
    text = "declare void @free(ptr)\ndefine void @forget(ptr %x) {\n  call void @free(ptr %x)\n  ret void\n}\n"
    assert compile_wasm(text, ("forget",)).imports == ("free",)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_elementary_functions_are_in_the_module(width):
    f, names = (
        Function("all", [(POINTER, "x"), (POINTER, "y")], width),
        sorted(elementary.FUNCTION_NAMES - {"atan2", "pow", "rem"}),
    )
    x = f.load(f.given["x"], 0, width)
    for k, name in enumerate(names):
        f.store(elementary.call(f, name, x), f.given["y"], k * width, width)
    linked = compile_wasm(text_of_module([f]), ("all",))
    assert linked.imports == ()
    host = Host(linked.code, linked.data_end)
    host.begin()
    numbers = np.linspace(0.3, 0.9, width)
    x, y = host.put(numbers), host.put(np.zeros((len(names), width)))
    host.call("all", x, y)
    library = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh"}
    with np.errstate(invalid="ignore"):
        exact = [(getattr(np, library.get(name, name), None) or np.vectorize(getattr(math, name)))(numbers) for name in names]
    assert_allclose(host.numbers(y, len(names) * width).reshape(-1, width), exact, rtol=1e-15)


def test_constants_are_at_the_beginning_of_memory():
    text = "@table = private unnamed_addr constant [2 x double] [double 1.5, double 2.5], align 8\n"
    f = Function("read", [(POINTER, "k"), (POINTER, "y")])
    place = f.op(f"fptosi double {f.load(f.given['k']).name} to i64", "i64")
    f.store(f.load(f.at("@table", place)), f.given["y"])
    linked = compile_wasm(text + f.text(), ("read",))
    assert linked.data_end == 16
    host = Host(linked.code, linked.data_end)
    host.begin()
    y = host.put([0.0])
    host.call("read", host.put([1.0]), y)
    assert host.numbers(y, 1)[0] == 2.5


def test_what_is_compiled_once_is_read_from_disk(monkeypatch, tmp_path):
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    linked = compile_wasm(doubled("run", 2.0).text(), ("run",))
    with calls_of(machine.object_code) as compiled:
        assert compile_wasm(doubled("run", 2.0).text(), ("run",)) == linked and not compiled
        (tmp_path / next(iter(tmp_path.iterdir())).name).write_bytes(b"half")
        assert compile_wasm(doubled("run", 2.0).text(), ("run",)) == linked and compiled


def test_what_is_missing_is_named():
    with pytest.raises(ValueError, match="the module has no function 'walk'"):
        compile_wasm(doubled("run", 2.0).text(), ("run", "walk"))


@pytest.mark.parametrize("code", [b"", b"\x7fELF\x02\x01\x01\x00"])
def test_what_is_no_webassembly_is_refused(code):
    with pytest.raises(ValueError, match="not a WebAssembly module"):
        link(code, ("run",))
    assert code != MAGIC
