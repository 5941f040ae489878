"""Where JAX computes: the default device, the host, and devices chosen by the user. CPU devices represent all others."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from udkjax import arrays, devices


def test_the_default_devices_are_those_of_the_choice():
    everywhere = jax.local_devices()
    assert devices.default_devices() == everywhere
    with jax.default_device(everywhere[0]):
        assert devices.default_devices() == everywhere[:1]
    with jax.default_device("cpu"):
        assert devices.default_devices() == everywhere[:1]
    assert devices.host_device() is None


def test_without_a_cpu_device_nothing_changes(monkeypatch):
    def no_cpu(backend=None):
        raise RuntimeError("Unknown backend cpu")

    monkeypatch.setattr(devices, "default_devices", lambda: [SimpleNamespace(platform="cuda")])
    monkeypatch.setattr(jax, "local_devices", no_cpu)
    assert devices.host_device() is None
    assert devices.on_host(jnp.sin)(0.0) == 0.0


def test_results_are_put_on_a_graphics_card_in_one_copy(monkeypatch):
    """They are put there often enough for a program to be worth compiling; all bits stay."""
    given = {"q": np.array([[0.1, np.nan], [-0.0, np.inf]]), "steps": np.int64(-7), "code": np.int64(0), "none": np.zeros((0, 3))}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(arrays, "_WORTH_A_PROGRAM", 0)
    copied, unpacked = [], arrays._unpacked
    monkeypatch.setattr(arrays, "_unpacked", lambda *packed: copied.append(packed) or unpacked(*packed))
    found = arrays.put_arrays(given)
    assert len(copied) == 1 and all(isinstance(x, jax.Array) for x in found.values())
    for name, x in given.items():
        assert (found[name].shape, found[name].dtype) == (x.shape, x.dtype)
        assert np.asarray(found[name]).tobytes() == x.tobytes()


def test_numbers_are_arrays_of_jax_also_without_programs(monkeypatch):
    monkeypatch.setattr(arrays, "_WORTH_A_PROGRAM", 0)
    with jax.disable_jit():
        assert all(isinstance(x, jax.Array) for x in (arrays.number(1.0), *arrays.put_arrays([np.ones(2), 1.0])))


def test_a_run_reads_nothing_back_from_a_graphics_card(monkeypatch):
    put = []

    class OnCard:
        """An array that cannot be read."""

        def __init__(self, x):
            put.append(x)

    monkeypatch.setattr(sys.modules[udk.simulate.__module__], "put_arrays", lambda tree: jax.tree.map(OnCard, tree))
    udk.simulate(udk.library.compound_pendulum(), [0.0, 0.1])
    assert put


BESIDE = """
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from udkjax import devices

host, card, other, _ = jax.devices()
jax.config.update("jax_default_device", card)
devices.default_devices = lambda: [SimpleNamespace(platform="cuda")]
assert devices.host_device() == host

places = []


@devices.on_host
def program(x):
    places.append(jax.config.jax_default_device)
    return {"y": x + 1.0, "text": "unchanged"}


found = program(jnp.ones(3))
assert places == [host] and found["y"].device == card and found["text"] == "unchanged"
assert devices.on_host(jax.jit(jnp.sin))(jax.device_put(0.0, other)).device == card
assert jax.jit(lambda x: program(x)["y"])(1.0).device == card and places == [host, card]

pendulum, ts = udk.library.compound_pendulum(), np.linspace(0.0, 0.2, 3)
turn = lambda x: udk.simulate(pendulum.with_parameters({"body.rod.inertia": x}), ts).q[-1, 0, 2]
run = udk.simulate(pendulum, ts)
assert run.settings["engine"] == "native" and run.q.device == card
values = [turn(0.3), jax.jit(turn)(0.3), jax.grad(turn)(0.3)]
assert {x.device for x in values} == {card} and values[0] == values[1]
assert jax.jit(turn)(jax.device_put(0.3, other)).device == other
with jax.default_device(other):
    assert udk.simulate(pendulum, ts).q.device == other
"""


def test_numbers_of_the_user_are_computed_beside_the_default_device():
    """Programs outside of others run on the host; their results are on the default device."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    environment = {**os.environ, "XLA_FLAGS": flags}
    subprocess.run([sys.executable, "-c", BESIDE], env=environment, check=True, timeout=300)
