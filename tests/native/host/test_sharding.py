"""Programs of several devices: each device computes the members that it holds."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.native.sharding import _rule

HEAD = """
import re, jax, jax.numpy as jnp, numpy as np, udkjax as udk
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
assert len(jax.devices()) == 2
mesh = jax.make_mesh((2,), ("members",), axis_types=(AxisType.Auto,))
xs, mech, ts = jnp.linspace(1.0, 1.001, 24), udk.library.four_bar(), np.array([0.0, 0.05, 0.1])
run = lambda k, g=-9.81: udk.simulate(mech.with_parameters({"pin.C": k * mech.parameters()["pin.C"], "gravity[1]": g}), ts).q[-1]

def check(f, rtol):
    spread = jax.device_put(xs, NamedSharding(mesh, P("members")))
    program = jax.jit(f).lower(spread).compile()
    sizes = [int(n) for n in re.findall(r"= \\(?f64\\[(\\d+)[^=]*? custom-call\\(.*?target=.udkjax_[0-9a-f]", program.as_text())]
    assert sizes and all(n % 12 == 0 and n % 24 for n in sizes), sizes  # 12 of 24 members, some with nine directions each
    np.testing.assert_allclose(program(spread), jax.jit(f)(xs), rtol=rtol, atol=1e-13)
"""
RUN = HEAD + "check(jax.vmap(run), 0)\n"
MORE = (
    HEAD
    + """
check(jax.vmap(jax.jacfwd(run)), 0)
check(jax.vmap(lambda k: jax.grad(lambda k: run(k).sum())(k)), 0)
check(lambda xs: jax.grad(lambda g: jax.vmap(lambda k: run(k, g).sum())(xs).sum())(-9.81), 1e-12)  # summed over devices
places = lambda k: udk.kinematics(mech.with_parameters({"pin.C": k * mech.parameters()["pin.C"]}), "body.crank.angle", 1.1 + ts).q
check(jax.vmap(places), 0)
"""
)


def on_two_devices(code):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "XLA_FLAGS": flags}, check=True, timeout=500)


def test_a_sharded_batch_runs_each_member_once():
    on_two_devices(RUN)


@pytest.mark.slow
def test_derivatives_and_positions_of_a_sharded_batch_are_computed_once():
    on_two_devices(MORE)


def test_only_the_axis_of_members_is_divided():
    assert _rule([(24, 5), (1, 24)], [(24, 3, 24), (24,), (1,)], 24) == "m a2, a3 a4 -> m a6 a7, m, a9"


def test_a_program_of_one_device_has_no_rule():
    mech, ts = udk.library.four_bar(), np.array([0.0, 0.05])
    run = jax.vmap(lambda m: udk.simulate(mech.with_parameters({"body.coupler.mass": m}), ts).q)
    assert "CustomSPMDPartitioning" not in jax.jit(run).lower(jnp.ones(4)).as_text()
