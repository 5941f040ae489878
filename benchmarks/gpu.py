"""Runs on an NVIDIA GPU: batches as kernels, and eager, jitted and batched calls as users write them.

With a GPU, it takes at most five minutes and needs nothing but this repository's folders, JAX, diffrax and llvmlite. Without
one it says so, and runs the threads of the kernels one after another on this processor.
"""

import json
import os
import re
import statistics
import subprocess
import time
import traceback
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import udkjax as udk
from benchmarks.batch import SPREAD, angles, ours, states
from benchmarks.emulation import calls_of, run_threads
from benchmarks.scripts import solve
from udkjax.native.gpu import target
from udkjax.native.runs import RunStates

END, OUTPUTS = 20.0, 101  # s; output times of runs with dense output
TOLERANCES = (1e-6, 1e-9)
SIZES = (1, 64, 256, 1024, 4096, 16_384, 65_536, 262_144, 1_048_576)
MANY, CHECKED = 262_144, 4096  # members of throughputs, and of comparisons
GRADIENTS = (4096, 65_536, 262_144)  # members of batches in reverse mode
SCENES = {"excavator": 20.0, "andrews_squeezer": 0.03, "n_four_bar": 20.0, "slider_crank": 20.0, "four_bar": 20.0}  # ends (s)
SCRIPT_LANES = 4096
LIMIT = 280.0  # s of all measurements together


class Report:
    """The figures of this benchmark; a measurement that fails is a figure with its error, and the others go on."""

    def __init__(self, limit: float):
        self.figures: list[dict[str, Any]] = []
        self._end = time.perf_counter() + limit

    def add(self, name: str, **values: Any):
        self.figures.append({"name": name} | values)
        print(json.dumps(self.figures[-1], default=float), flush=True)

    def take(self, measure: Callable[..., None], *arguments: Any):
        """Run a measurement, unless the time is up."""
        if time.perf_counter() > self._end:
            self.add(measure.__name__, skipped="the time is up")
            return
        try:
            measure(self, *arguments)
        except Exception as error:
            self.add(measure.__name__, failed=repr(error)[:500], where=traceback.format_exc()[-800:])


def seconds(call: Callable[[], Any], repetitions: int = 3, most: float = 10.0) -> float:
    """Return the median time of a call (s), after one that is not counted."""
    jax.block_until_ready(call())
    times: list[float] = []
    while len(times) < repetitions and sum(times) < most:
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _scene(name: str) -> Any:
    make = getattr(udk.library, name)
    return make(5) if name == "n_four_bar" else make()


def _released(members: int) -> jax.Array:
    return jax.device_put(states(angles(-45.0, members) if members > 1 else np.deg2rad([-45.0])))


def equality(report: Report):
    """Compare all bits of a kernel's results with those of the host."""
    mechanism = udk.library.parallelogram()
    for outputs in (2, 11):
        run, y = ours(mechanism, np.linspace(0.0, END, outputs)), states(angles(-45.0, CHECKED))
        for tol in TOLERANCES:
            on_card = np.asarray(jax.jit(run)(jax.device_put(y), tol))
            with jax.default_device(jax.devices("cpu")[0]):
                on_host = np.asarray(jax.jit(run)(jax.device_put(y, jax.devices("cpu")[0]), tol))
            same = np.all(on_card == on_host, axis=(1, 2))
            report.add("equality", outputs=outputs, tol=tol, equal=same.mean(), largest=np.abs(on_card - on_host).max())


class Wind(udk.ForceElement):
    """A force with elementary functions, which machine code writes itself."""

    strength: Float[Array, ""]

    def loads(self, t, *frames):
        v = frames[0].velocity((0.0, 0.0))
        along = jnp.tanh(v.x) + jnp.arctan2(v.y, 1.0 + v.x**2) + jnp.exp(-(v.x**2)) + jnp.log1p(v.y**2)
        return [(self.strength * along, jnp.arcsinh(v.x) - jnp.power(1.0 + v.y**2, 0.3), jnp.cbrt(v.x) * jnp.sinh(v.y))]


def stone_in_wind() -> udk.Mechanism:
    """A body under this force."""
    return udk.Mechanism({"stone": udk.Body(1.0, 0.01)}, forces={"wind": Wind(["stone"], strength=jnp.asarray(0.1))})


def functions(report: Report):
    """Compare all bits of runs under a force with elementary functions."""
    stone = stone_in_wind()

    def one(x):
        moved = stone.with_parameters({"force.wind.strength": x})
        return udk.simulate(moved, np.linspace(0.0, 1.0, 3), rtol=1e-8, atol=1e-8, throw=False).q

    given, cpu = np.linspace(0.1, 2.0, CHECKED), jax.devices("cpu")[0]
    on_card = np.asarray(jax.jit(jax.vmap(one))(jax.device_put(given)))
    with jax.default_device(cpu):
        on_host = np.asarray(jax.jit(jax.vmap(one))(jax.device_put(given, cpu)))
    report.add("functions", equal=np.mean(on_card == on_host), largest=np.abs(on_card - on_host).max())


def throughput(report: Report, outputs: int, sizes: tuple[int, ...], tolerances: tuple[float, ...] = TOLERANCES):
    """Runs a second, over numbers of members."""
    run = jax.jit(ours(udk.library.parallelogram(), np.linspace(0.0, END, outputs)))
    for members in sizes:
        y = _released(members)
        for tol in tolerances:
            start = time.perf_counter()
            jax.block_until_ready(run(y, tol))
            first, each = time.perf_counter() - start, seconds(lambda y=y, tol=tol: run(y, tol))
            of = {"outputs": outputs, "members": members, "tol": tol}
            report.add("throughput", **of, first=first, ms=each * 1e3, a_second=members / each)


def numbers(report: Report):
    """Runs a second of mechanisms with different masses, which are assembled and scaled as well."""
    mechanism, ts = udk.library.parallelogram(), np.linspace(0.0, END, 2)

    def one(mass):
        return udk.simulate(mechanism.with_parameters({"body.coupler.mass": mass}), ts, rtol=1e-6, atol=1e-6, throw=False).q[-1]

    run, masses = jax.jit(jax.vmap(one)), jnp.linspace(1.0, 3.0, MANY)
    each = seconds(lambda: run(masses))
    report.add("numbers", members=MANY, ms=each * 1e3, a_second=MANY / each)


def tangents(report: Report):
    """Runs per second with a derivative with respect to a mass."""
    mechanism, ts = udk.library.parallelogram(), np.linspace(0.0, END, 2)
    known = udk.analyse(mechanism)

    def one(mass, y0):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        moved = mechanism.with_parameters({"body.coupler.mass": mass})
        return udk.simulate(moved, ts, state, 1e-6, 1e-6, throw=False, analysis=known).q[-1].ravel()

    for members in (CHECKED, MANY):
        masses, y = jnp.linspace(1.0, 3.0, members), _released(members)
        batch = lambda m, y: jax.vmap(lambda m, y: jax.jvp(lambda m: one(m, y), (m,), (1.0,)))(m, y)  # noqa: E731
        run = jax.jit(batch)
        if members == CHECKED:
            on_card = [np.asarray(x) for x in run(masses, y)]
            cpu = jax.devices("cpu")[0]
            with jax.default_device(cpu):
                on_host = [np.asarray(x) for x in jax.jit(batch)(jax.device_put(masses, cpu), jax.device_put(y, cpu))]
            report.add("tangents", equal=[bool(np.array_equal(a, b)) for a, b in zip(on_card, on_host, strict=True)])
        each = seconds(lambda m=masses, y=y, run=run: run(m, y))
        report.add("tangents", members=members, ms=each * 1e3, a_second=members / each)


def gradients(report: Report):
    """Gradients in reverse mode with respect to a mass: over 2 s with 11 outputs, and over 20 s of the end."""
    mechanism = udk.library.parallelogram()
    known, cpu = udk.analyse(mechanism), jax.devices("cpu")[0]

    def gradient(ts: Array | np.ndarray) -> Callable[[Array], Array]:
        def loss(mass: Array) -> Array:
            moved = mechanism.with_parameters({"body.coupler.mass": mass})
            return jnp.sum(udk.simulate(moved, ts, rtol=1e-6, atol=1e-6, throw=False, analysis=known).q ** 2)

        return jax.grad(loss)

    short, long = gradient(np.linspace(0.0, 2.0, 11)), gradient(np.linspace(0.0, END, 2))
    each = seconds(lambda run=jax.jit(short): run(jnp.asarray(2.0)))
    report.add("gradients", kind="one", members=1, ms=each * 1e3)
    for kind, batch, sizes in (("batch", jax.vmap(short), GRADIENTS[:1]), ("end", jax.vmap(long), GRADIENTS)):
        masses = np.linspace(1.0, 3.0, sizes[0])
        with jax.default_device(cpu):
            on_host = np.asarray(jax.jit(batch)(jax.device_put(masses, cpu)))
        on_card = np.asarray(jax.jit(batch)(jax.device_put(masses)))
        report.add("gradients", kind=kind, equal=np.mean(on_card == on_host), largest=np.abs(on_card / on_host - 1.0).max())
        for members in sizes:
            run, given = jax.jit(batch), jnp.linspace(1.0, 3.0, members)
            start = time.perf_counter()
            jax.block_until_ready(run(given))
            first, each = time.perf_counter() - start, seconds(lambda run=run, given=given: run(given))
            report.add("gradients", kind=kind, members=members, first=first, ms=each * 1e3, a_second=members / each)


def scenes(report: Report, name: str):
    """Runs a second of a mechanism from the library under 80 to 120 percent of gravity, or, without gravity, of a mass."""
    mechanism, members, end = _scene(name), 65_536, SCENES[name]
    known, gravity = udk.analyse(mechanism), np.asarray(mechanism.gravity)
    mass = next(x for x in mechanism.parameters() if x.endswith(".mass"))
    varied, given = ("gravity", gravity) if gravity.any() else (mass, mechanism.parameters()[mass])

    def one(share):
        moved = mechanism.with_parameters({varied: jnp.asarray(given) * share})
        return udk.simulate(moved, np.linspace(0.0, end, 2), rtol=1e-6, atol=1e-6, throw=False, analysis=known).q[-1]

    run, shares = jax.jit(jax.vmap(one)), jnp.linspace(0.8, 1.2, members)
    start = time.perf_counter()
    few = np.asarray(run(shares)[:64])
    first, each = time.perf_counter() - start, seconds(lambda: run(shares))
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu):
        on_host = np.asarray(jax.jit(jax.vmap(one))(jax.device_put(np.asarray(shares[:64]), cpu)))
    equal = np.mean(np.all(few == on_host, axis=(1, 2)))
    report.add("scenes", scene=name, members=members, first=first, ms=each * 1e3, a_second=members / each, equal=equal)


def calls(report: Report):
    """Time one run: eager, jitted, in a scan; on the default device, and on the CPU."""
    mechanism, ts = udk.library.parallelogram(), np.linspace(0.0, END, 2)
    y = states(np.deg2rad([-45.0]))[0]

    def one(y0):
        state = udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3))
        return udk.simulate(mechanism, ts, state, 1e-6, 1e-6, throw=False).q[-1]

    def many(y0):
        return jax.lax.scan(lambda y, _: (y, one(y)[0, 0]), y0, length=100)[1]

    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        with jax.default_device(device):
            given = jax.device_put(y, device)
            start = time.perf_counter()
            udk.simulate(mechanism, ts, rtol=1e-6, atol=1e-6)
            first = time.perf_counter() - start
            eager = seconds(lambda: udk.simulate(mechanism, ts, rtol=1e-6, atol=1e-6).q, 20)
            jitted, scanned = jax.jit(one), jax.jit(many)
            report.add(
                "calls",
                device=device.platform,
                first=first,
                eager_ms=eager * 1e3,
                jitted_ms=seconds(lambda given=given, jitted=jitted: jitted(given), 50) * 1e3,
                of_scan_ms=seconds(lambda given=given, scanned=scanned: scanned(given)) * 10,
            )


def swept(report: Report):
    """Members a second of `udk.sweep`; it needs xarray."""
    ts, members = np.linspace(0.0, END, 2), 1_000_000
    axes = {"body.coupler.mass": np.linspace(1.0, 3.0, members)}
    start = time.perf_counter()
    data = udk.sweep(udk.library.parallelogram(), axes, ts, rtol=1e-6, atol=1e-6)
    each = time.perf_counter() - start
    report.add("swept", members=members, seconds=each, a_second=members / each, succeeded=float((data.result == 0).mean()))


def script(report: Report):
    """Runs a second by a script with diffrax under vmap, on the same card."""
    ts = jnp.linspace(0.0, END, 2)
    run, y = jax.jit(jax.vmap(solve(ts), in_axes=(0, None))), _released(SCRIPT_LANES)
    each = seconds(lambda: run(y, 1e-6), 2)
    report.add("script", members=SCRIPT_LANES, ms=each * 1e3, a_second=SCRIPT_LANES / each)


def assembled(name: str) -> dict[str, Any] | None:
    """Compile the kernel of a mechanism's run; return what `ptxas` says of it. None without `ptxas`."""
    assembler, mechanism = target.ptxas(), _scene(name)
    if assembler is None:
        return None
    ts, gravity = np.linspace(0.0, SCENES.get(name, END) / 100, 2), np.asarray(mechanism.gravity)
    known = udk.analyse(mechanism)

    def one(share):
        moved = mechanism.with_parameters({"gravity": jnp.asarray(gravity) * share})
        return udk.simulate(moved, ts, rtol=1e-6, atol=1e-6, throw=False, analysis=known).q[-1]

    (call,) = (x for x in calls_of(jax.vmap(one), np.array([0.9, 1.0])) if isinstance(x.operation, RunStates))
    start = time.perf_counter()
    code = target.ptx(call.kernel.text)
    middle = time.perf_counter()
    given = [assembler, "-arch=sm_90", "-O3", "-v", "-", "-o", os.devnull]
    said = subprocess.run(given, input=code, capture_output=True, text=True, check=True).stderr
    spilled = sum(int(x) for x in re.findall(r"(\d+) bytes spill loads", said))
    return {
        "scene": name,
        "thread_bytes": 8 * call.kernel.code.size,
        "registers": int((re.findall(r"Used (\d+) registers", said) or [0])[-1]),
        "spilled_bytes": spilled,
        "ptx_kb": len(code) // 1000,
        "llvm_s": middle - start,
        "ptxas_s": time.perf_counter() - middle,
    }


def emulated(smoke: bool) -> list[dict[str, Any]]:
    """Compare the threads of kernels, one after another on this processor, with the engine."""
    figures, mechanism = [], udk.library.parallelogram()
    members, end = (3, 0.2) if smoke else (64, END)
    for outputs in (2, 11):
        ts = np.linspace(0.0, end, outputs)
        run, y = ours(mechanism, ts), states(angles(-45.0, members))
        gradients = jax.vmap(jax.grad(lambda y, run=run: jnp.sum(run(y[None], 1e-6))))
        for call in [*calls_of(run, y, 1e-6), *calls_of(gradients, y)]:
            results = run_threads(call.kernel, call)
            same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(results, call.outputs, strict=True))
            figures.append({"name": "emulation", "operation": type(call.operation).__name__, "outputs": outputs, "equal": same})
            print(figures[-1])
    for name in () if smoke else sorted(udk.library.__all__):
        if (figure := assembled(name)) is not None:
            figures.append({"name": "assembled"} | figure)
            print(figures[-1])
    return figures


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the figures, a line for each."""
    if jax.default_backend() != "gpu":
        print("no graphics card: the threads of kernels one after another on this processor, beside the engine")
        return emulated(smoke)
    report = Report(LIMIT)
    report.add("card", card=jax.devices()[0].device_kind, jax=jax.__version__, cores=os.cpu_count(), spread=SPREAD)
    report.take(equality)
    report.take(functions)
    report.take(throughput, 2, SIZES)
    report.take(calls)
    report.take(throughput, OUTPUTS, (4096, 65_536, 262_144), (1e-6,))
    report.take(tangents)
    report.take(numbers)
    report.take(gradients)
    report.take(script)
    report.take(swept)
    for name in SCENES:
        report.take(scenes, name)
    return report.figures
