"""Keys of user-defined objects by their source, by which the text of machine code is stored on disk."""

import subprocess
import sys
import textwrap
from types import ModuleType

import pytest

from tests.calls import calls_of
from tests.integrate.systems.test_own_methods import BenIsrael
from udkjax.native.lowering import own_objects
from udkjax.native.lowering.source_key import source_key
from udkjax.native.pseudoinverses.own import OwnCode

PLAIN = """
import functools, math, jax, jax.numpy as jnp, numpy as np, equinox as eqx, udkjax as udk

TABLE = np.array([1.0, 2.0])
FACTOR = 2.0

def helper(x, scale=1.0):
    return scale * FACTOR * jnp.sum(x * TABLE[0])

@jax.jit
def compiled(x):
    return jax.lax.cond(x > 0, lambda: x, lambda: -x)

def make(shift):
    return lambda x: x + shift

class Base(udk.MatrixPseudoinverse):
    count: int = eqx.field(static=True, default=3)
    weights = (1, 2)

    def step(self, x):
        return functools.partial(helper, scale=3.0)(x)

    @property
    def most(self):
        return max(4, len(self.weights))

class Own(Base):
    shifted = staticmethod(make(1.0))

    def matrix(self, D):
        total = 0.0
        for k in range(self.count):
            total = total + compiled(self.step(D)) + math.pi + self.shifted(k)
        return total * D.T
"""

CHANGES = {
    "a global number": ("FACTOR = 2.0", "FACTOR = 3.0"),
    "a global array": ("[1.0, 2.0]", "[1.5, 2.0]"),
    "an operation": ("scale * FACTOR", "scale + FACTOR"),
    "a default": ("scale=1.0", "scale=1.5"),
    "a compiled function": ("lambda: -x", "lambda: 2 * x"),
    "an attribute of a function": ("@jax.jit", "helper.offset = 1.0\n@jax.jit"),
    "a closure": ("make(1.0)", "make(2.0)"),
    "a static field": ("default=3", "default=4"),
    "an attribute of the class": ("weights = (1, 2)", "weights = (1, 3)"),
    "a base class": ("scale=3.0", "scale=4.0"),
    "a property": ("max(4,", "max(5,"),
    "a function of a library": ("jnp.sum", "jnp.max"),
    "an integer for a number": ("FACTOR = 2.0", "FACTOR = 2"),
}
UNKNOWN = {
    "a module": ("math.pi", "helpers.value"),
    "an import": ("total = 0.0", "import helpers; total = helpers.value"),
    "a file": ("total = 0.0", "total = len(open('/dev/null').read())"),
    "chance": ("total = 0.0", "total = np.random.rand()"),
    "data": ("total = 0.0", "total = np.load('x.npy')"),
    "an object": ("FACTOR = 2.0", "FACTOR = object()"),
    "a changing global": ("total = 0.0", "global FACTOR; FACTOR = 2.0; total = 0.0"),
    "a derivative": ("@jax.jit", "@jax.custom_jvp"),
    "a missing name": ("total = 0.0", "total = missing"),
}


def key_of(text):
    helpers = ModuleType("helpers")
    helpers.__dict__["value"] = 1.0
    names = {"__name__": "script", "helpers": helpers}
    exec(textwrap.dedent(text), names)
    return source_key(names["Own"]())


def test_equal_sources_have_equal_keys():
    """Also in another process, and further down in a file."""
    assert key_of(PLAIN) == key_of("\n\n# a comment\n" + PLAIN) is not None
    call = f"import sys; sys.path.insert(0, '.')\nfrom {__name__} import key_of, PLAIN\nprint(key_of(PLAIN))"
    assert subprocess.run([sys.executable, "-c", call], capture_output=True, text=True).stdout.strip() == key_of(PLAIN)


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_other_sources_have_other_keys(change):
    changed = PLAIN.replace(*change)
    assert changed != PLAIN
    assert key_of(changed) not in (None, key_of(PLAIN))


@pytest.mark.parametrize("change", UNKNOWN.values(), ids=UNKNOWN)
def test_unknown_content_has_no_key(change):
    assert key_of(PLAIN.replace(*change)) is None


def test_text_is_stored(tmp_path, monkeypatch):
    """A stored text is the one that was written, and is read without tracing the method again."""
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    own_objects.written.cache_clear()
    code = OwnCode.of(BenIsrael())
    found = code.written(3, 4)
    assert len(list(tmp_path.glob("text-*"))) == 2
    with calls_of(own_objects._write) as writes:
        own_objects.written.cache_clear()
        again = code.written(3, 4)
        assert again.function.text() == found.function.text()
        assert again.size == found.size and writes == []
        own_objects.written.cache_clear()
        monkeypatch.setenv("UDKJAX_CACHE", "0")
        code.written(3, 4)
        assert writes != []
