from functools import partial
from types import SimpleNamespace

import jax
import pytest

import udkjax as udk
from udkjax.show import doctor


def test_a_good_environment_gets_no_advice():
    found = doctor.facts()
    assert found["advice"] == [] and set(found["missing_extras"]) <= {"notebook", "zig"}  # extras of their own
    assert (found["engine"], found["precision"]) == ("native", "float64")
    assert {"udkjax", "jax", "jaxlib", "equinox", "diffrax", "llvmlite", "numpy", "python"} <= set(found["versions"])
    shown = doctor.summary(found)
    assert "no problems found" in shown and found["versions"]["jax"] in shown and "engine" in shown


def test_single_precision_is_reported():
    with jax.enable_x64(False):
        assert any("float64 is off" in line for line in doctor._advice("native", ""))


def test_a_graphics_card_without_the_cpu_beside_it_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "default_devices", lambda: [SimpleNamespace(platform="gpu")])
    monkeypatch.setattr(doctor, "host_device", lambda: jax.devices()[0])
    assert list(doctor._advice("native", "")) == []
    monkeypatch.setattr(doctor, "host_device", lambda: None)
    assert ["JAX_PLATFORMS must name the cpu, too, as in cuda,cpu" in line for line in doctor._advice("native", "")] == [True]


def test_the_cache_of_machine_code_is_reported(monkeypatch, tmp_path):
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    (tmp_path / "0123").write_bytes(bytes(3 * 2**20))
    assert f"1 in {tmp_path}, 3.0 MiB" in doctor.summary(doctor.facts())
    monkeypatch.setenv("UDKJAX_CACHE", "0")
    assert "nothing, because UDKJAX_CACHE=0 is set" in doctor.summary(doctor.facts())


def test_a_broken_engine_is_reported():
    def broken(*_, **__):
        raise OSError("no executable memory")

    found = doctor.facts(broken)
    assert found["engine"] == "none" and "no executable memory" in found["engine_reason"]
    assert any("machine code is not used" in line for line in found["advice"])


@pytest.mark.slow
def test_the_reason_is_that_of_the_run():
    assert doctor.engine_here(partial(udk.simulate, engine="diffrax")) == ("diffrax", "it was asked for")
