"""The processor that machine code is compiled for, and the setting that makes it the same for all machines."""

import os

import numpy as np
import pytest

from tests.fresh_process import python
from udkjax.native.code import processor

CODE = """
import jax, numpy as np, udkjax as udk
from udkjax.native.code import machine, processor
mech, ts = udk.library.parallelogram(), np.linspace(0.0, 1.0, 3)
batch = jax.jit(jax.vmap(lambda g: udk.simulate(mech.with_parameters({"gravity": g}), ts).q[-1]))
end = batch(np.linspace([0.0, -9.0], [0.0, -10.0], 5))
dense = udk.simulate(mech, ts, method=udk.SVD()).q[-1]
print(processor.lanes(), processor.target()[0], machine.digest(""), *(float(x).hex() for x in (*np.ravel(end), *np.ravel(dense))))
"""
# The kernels that NumPy, its linear algebra and XLA would choose on an older processor.
OLDER = {"OPENBLAS_CORETYPE": "Nehalem", "XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2"}


@pytest.fixture
def of_processor(monkeypatch):
    """Set what this processor has, and `UDKJAX_LANES`."""

    def choose(setting, features, triple="x86_64-unknown-linux-gnu"):
        class Llvm:
            get_host_cpu_features = staticmethod(lambda: dict.fromkeys(features, True))
            get_default_triple = staticmethod(lambda: triple)

        monkeypatch.setenv(processor.LANES_VARIABLE, setting)
        monkeypatch.setattr(processor, "llvm", Llvm)
        return processor.lanes.__wrapped__()

    return choose


@pytest.mark.parametrize("text", ["0", "3", "16", "-1", "2.0", "four", "²"])
def test_a_wrong_number_of_lanes_is_an_error(of_processor, text):
    with pytest.raises(ValueError, match=f"UDKJAX_LANES must be 1, 2, 4 or 8 lanes of machine code, not '{text}'"):
        of_processor(text, ())


def test_lanes_that_the_processor_lacks_are_an_error(of_processor):
    avx2 = (*processor.SSE.features, *processor.AVX2.features)
    for count in (1, 2, 4):
        assert of_processor(f" {count} ", avx2) == count
    with pytest.raises(ValueError, match="UDKJAX_LANES=8 needs AVX-512, which this processor lacks: it has at most 4 lanes"):
        of_processor("8", avx2)
    with pytest.raises(ValueError, match="UDKJAX_LANES=4 needs AVX2 and FMA, which this processor lacks: it has at most 2 lanes"):
        of_processor("4", ("neon",), "aarch64-unknown-linux-gnu")
    assert of_processor("2", ("neon",), "aarch64-unknown-linux-gnu") == 2


@pytest.mark.parametrize(
    "features, count", [((), 2), (("avx2", "fma"), 4), (("avx2",), 2), (("avx2", "fma", "avx512f", "avx512dq", "avx512vl"), 8)]
)
def test_by_default_lanes_are_those_of_a_register(of_processor, features, count):
    assert of_processor("", features) == count


def test_the_setting_makes_bits_independent_of_the_processor():
    """It changes code and its key, and results by rounding alone; what NumPy and XLA choose elsewhere changes no bit."""
    found = np.show_config(mode="dicts")
    dispatched = " ".join(found["SIMD Extensions"].get("found", ()) if isinstance(found, dict) else ())
    older = OLDER | {"NPY_DISABLE_CPU_FEATURES": dispatched} if processor._is_x86() else {}
    cache = os.environ["UDKJAX_CACHE"]
    settings = {"UDKJAX_LANES": ""}, {"UDKJAX_LANES": 1}, {"UDKJAX_LANES": 1} | older
    by_default, here, there = (python(CODE, UDKJAX_CACHE=cache, **setting).split() for setting in settings)
    assert here == there and here[:2] in (["1", processor.SSE.cpu], ["1", processor.ARM_BASE])
    assert by_default[2] != here[2]
    ends = [[float.fromhex(x) for x in found[3:]] for found in (by_default, here)]
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-9)
