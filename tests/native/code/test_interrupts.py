"""Ctrl-C during a long run of machine code."""

import subprocess
import sys
import textwrap

import pytest

SCRIPT = """
    import os, signal, sys, threading
    import jax, jax.numpy as jnp, numpy as np
    import udkjax as udk

    mech, soon, never = udk.library.simple_pendulum(), np.array([0.0, 0.1]), np.array([0.0, 1e9])

    def end(mass, ts):
        return udk.simulate(mech.with_parameters({"body.bob.mass": mass}), ts, max_steps=10**9).q[-1, 0, 2]

    runs = {
        "eager": lambda ts: end(1.0, ts),
        "jit": lambda ts, f=jax.jit(end): f(1.0, ts),
        "lanes": lambda ts, f=jax.jit(jax.vmap(end, (0, None))): f(jnp.linspace(1.0, 2.0, 40), ts),
        "slope": lambda ts, f=jax.jit(jax.jacfwd(end)): f(1.0, ts),
    }
    for name, run in runs.items():
        before = np.asarray(run(soon))  # compiles everything
        signal.signal(signal.SIGINT, signal.default_int_handler)  # as notebooks do before each cell
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            jax.block_until_ready(run(never))
            print(name, "ended")
        except KeyboardInterrupt:
            print(name, "interrupted", np.array_equal(run(soon), before))
"""

OWN_HANDLER = """
    import os, signal, threading
    import numpy as np
    import udkjax as udk

    signals = []
    signal.signal(signal.SIGINT, lambda *_: signals.append(1))
    mech, ts = udk.library.simple_pendulum(), np.array([0.0, 1e5])
    udk.simulate(mech, [0.0, 0.1])
    threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    print(udk.simulate(mech, ts, max_steps=10**9).result, len(signals))
"""


def _output_of(script: str) -> str:
    found = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, timeout=300)
    assert not found.returncode, found.stderr
    return found.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
def test_ctrl_c_ends_runs_and_the_process_goes_on():
    """Otherwise each of these runs takes hours."""
    names = ("eager", "jit", "lanes", "slope")
    assert _output_of(SCRIPT).splitlines() == [f"{name} interrupted True" for name in names]


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
def test_a_handler_of_the_user_decides():
    """A program that only notes the signal gets its run."""
    assert _output_of(OWN_HANDLER).split() == ["successful", "1"]
