"""The processor that machine code is compiled for, and the setting that makes it the same for all machines."""

import os

import numpy as np
import pytest

from tests.fresh_process import python
from udkjax.native.base import processor

CODE = """
import jax, numpy as np, udkjax as udk
from udkjax.native.base import machine, processor
mech, ts = udk.library.parallelogram(), np.linspace(0.0, 1.0, 3)
end = jax.vmap(lambda g: udk.simulate(mech.with_parameters({"gravity": g}), ts).q[-1])(np.linspace([0.0, -9.0], [0.0, -10.0], 5))
print(processor.lanes(), *processor.target()[:1], machine.digest(""), *np.ravel(end))
"""


@pytest.fixture
def of_processor(monkeypatch):
    """Set what this processor has, and `UDKJAX_LANES`."""

    def choose(setting, features, triple="x86_64-unknown-linux-gnu"):
        class Llvm:
            get_host_cpu_features = staticmethod(lambda: dict.fromkeys(features, True))
            get_default_triple = staticmethod(lambda: triple)

        monkeypatch.setenv(processor.SETTING, setting)
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


def test_the_setting_changes_code_and_its_key_but_no_result():
    suits = 1, max(filter(processor._suits, processor.LEVELS))
    cache = os.environ["UDKJAX_CACHE"]
    by_default, *chosen = (python(CODE, UDKJAX_CACHE=cache, UDKJAX_LANES=count).split() for count in ("", *suits))
    found = dict(zip(suits, chosen, strict=True))
    expected = np.array(by_default[3:], float)
    for count, (lanes, cpu, _, *end) in found.items():
        assert int(lanes) == count and cpu in (processor.LEVELS[count].cpu, processor.ARM_BASE)
        np.testing.assert_allclose(np.array(end, float), expected, rtol=0.0, atol=1e-9)
    keys = {digest for _, _, digest, *_ in (by_default, *found.values())}
    assert len(keys) == 1 + len({cpu for _, cpu, *_ in found.values()})
