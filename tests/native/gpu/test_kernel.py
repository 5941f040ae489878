"""Kernels without a graphics card: their threads run one after another, bitwise equal to the engine, also in JAX programs."""

import ctypes
import itertools
import platform
import shutil
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import mlir
from numpy.testing import assert_array_equal

import udkjax as udk
from tests.integrate.systems.test_own_methods import BenIsrael, Together
from tests.integrate.systems.test_own_stabilizations import NewtonAndRates
from tests.native.gpu import ptx_as_c
from tests.native.gpu.test_host_handler import ADDRESS, ERROR, STREAM, Card
from udkjax.native import loaded_code, primitive, records
from udkjax.native.code import processor
from udkjax.native.gpu import launch, launch_handler, target
from udkjax.native.gpu.driver import CudaError
from udkjax.native.gpu.kernel import VECTOR_LENGTH
from udkjax.native.host import ffi
from udkjax.native.runs import RunCotangents

emulation = pytest.importorskip("benchmarks.emulation", reason="not in a source tree")
gpu = pytest.importorskip("benchmarks.gpu")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="JAX has no CUDA there")

LINKAGE, FOUR_BAR, PENDULUM = udk.library.parallelogram(), udk.library.four_bar(), udk.library.compound_pendulum()
START, KNOWN = udk.assemble(LINKAGE), udk.analyse(LINKAGE)
MASSES = np.linspace(1.0, 2.0, 5)
BOUNCER = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0))})
FLOOR = udk.Contact("ball", restitution=0.8, name="floor")


def last(mechanism, name, times=2, end=0.5, **options):
    """The last positions as a function of a parameter."""
    ts = np.linspace(0.0, end, times)

    def run(x):
        return udk.simulate(mechanism.with_parameters({name: x}), ts, rtol=1e-7, atol=1e-7, throw=False, **options).q

    return run


def with_tangent(f):
    return lambda x: jax.jvp(f, (x,), (1.0,))


def with_gradient(f):
    return jax.grad(lambda x: jnp.sum(jnp.sin(f(x))))


def with_second(f):
    return lambda x: jax.jvp(jax.jacfwd(f), (x,), (1.0,))


STONE = gpu.stone_in_wind()

RUNS = {
    "redundant": last(LINKAGE, "body.coupler.mass"),
    "outputs": last(LINKAGE, "body.coupler.mass", 7),
    "closed": last(FOUR_BAR, "pin.B[0]", 3),
    "Baumgarte": last(LINKAGE, "body.coupler.mass", stabilization=udk.Baumgarte()),
    "elementary functions": last(STONE, "force.wind.strength", 3),
    "Tsit5": last(LINKAGE, "body.coupler.mass", solver=diffrax.Tsit5()),
    "SVD": last(LINKAGE, "body.coupler.mass", method=udk.SVD()),
    "own pseudoinverse": last(LINKAGE, "body.coupler.mass", method=BenIsrael()),
    "own formulation": last(FOUR_BAR, "pin.B[0]", 3, formulation=Together()),
    "own stabilization": last(LINKAGE, "body.coupler.mass", 4, stabilization=NewtonAndRates()),
    "tangent": with_tangent(last(PENDULUM, "body.rod.mass", 4)),
    "two tangents": jax.jacfwd(lambda x: last(FOUR_BAR, "pin.B", 3)(jnp.stack([x, 1.0]))),
    "gradient": with_gradient(last(PENDULUM, "body.rod.mass", 4)),
    "gradient of a closed one": with_gradient(last(FOUR_BAR, "pin.B[0]", 3)),
    "gradient by Baumgarte": with_gradient(last(LINKAGE, "body.coupler.mass", stabilization=udk.Baumgarte())),
    "second tangent": with_second(last(PENDULUM, "body.rod.mass", 3)),
    "control step": lambda x: udk.step(LINKAGE, START, {"body.coupler.mass": x}, 0.05, analysis=KNOWN).q,
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.slow
def test_threads_compute_what_the_engine_computes(name):
    calls = emulation.calls_of(jax.vmap(RUNS[name]), MASSES)
    assert calls
    for call in calls:
        results = emulation.run_threads(call.kernel, call)
        for found, known in zip(results, call.outputs, strict=True):
            assert_array_equal(found, known)


@pytest.mark.slow
def test_constants_that_all_members_share_are_in_the_memory_of_the_block(tmp_path):
    """Members that differ only by their starts: with threads, and with LLVM's PTX if there is a C compiler."""
    run = gpu.ours(LINKAGE, np.linspace(0.0, 0.5, 4))
    (call,) = emulation.calls_of(run, gpu.states(gpu.angles(-45.0, 5)), 1e-7)
    assert call.kernel.constants > 0 and "@block_memory" in call.kernel.text
    found = [emulation.run_threads(call.kernel, call)]
    if shutil.which("cc") and platform.machine() == "x86_64":
        arrays = emulation.Arrays(call.kernel, call)
        ptx_as_c.compiled(target.ptx(call.kernel.text), tmp_path)(arrays.address, 5)
        found.append(arrays.outputs)
    for outputs in found:
        for x, known in zip(outputs, call.outputs, strict=True):
            assert_array_equal(x, known)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(udk.library.__all__))
def test_threads_run_every_mechanism_of_the_library(name):
    """Runs with outputs and with a derivative, of members under different gravity."""
    make = getattr(udk.library, name)
    mechanism = make(3) if name == "n_four_bar" else make()
    known, gravity = udk.analyse(mechanism), jnp.array([0.0, -9.81])
    end = 1e-3 if name == "andrews_squeezer" else 0.2

    def run(x):
        moved = mechanism.with_parameters({"gravity": gravity * x})
        return udk.simulate(moved, np.linspace(0.0, end, 4), rtol=1e-7, atol=1e-7, throw=False, analysis=known).q

    for f in (run, with_tangent(run), with_gradient(run)):
        calls = emulation.calls_of(jax.vmap(f), np.array([0.8, 1.0, 1.1]))
        assert any("Run" in type(x.operation).__name__ for x in calls)
        for call in calls:
            for found, known_output in zip(emulation.run_threads(call.kernel, call), call.outputs, strict=True):
                assert_array_equal(found, known_output)


class Launching(Card):
    """A card that runs the threads of a kernel one after another, and lends at most `most` bytes."""

    most = 2**40

    def __init__(self):
        super().__init__()
        self.threads, self.grids, self.lent = [], [], []
        self.add("cuLaunchKernel", 11, self._launch)

    def _launch(self, kernel, *given):
        x, y, z, threads, *others, shared = (word & 0xFFFFFFFF for word in given[:7])
        stream, parameters, extra = given[7:]
        assert (y, z, *others, shared, stream, extra) == (1, 1, 1, 1, 0, STREAM, 0)
        self.grids.append((x, threads))
        for thread in range(x * threads):
            self.threads[kernel - 1](ADDRESS.from_address(parameters).value, thread)

    def load_kernel(self, of, code):
        assert of is self
        self.threads.append(emulation.Thread(code))
        return len(self.threads)

    def functions_of_xla(self):
        return super().functions_of_xla() | {ffi.ALLOCATE: self._lend, ffi.FREE: self._take_back}

    def _lend(self, api, struct):
        size, alignment = (ADDRESS.from_address(struct + offset).value for offset in (24, 32))
        assert alignment <= 16  # as XLA demands
        if size > self.most:
            create = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(ADDRESS.from_address(api + ffi.CREATE_ERROR).value)
            words = ctypes.c_char_p(b"the card is full")
            given = (ctypes.c_uint64 * 4)(32, 0, ctypes.cast(words, ctypes.c_void_p).value, ffi.RESOURCE_EXHAUSTED)
            return create(ctypes.addressof(given))
        self.lent.append(np.full(size // 8 + alignment // 8, np.nan))
        self.write(struct + 40, -(-self.lent[-1].ctypes.data // alignment) * alignment)
        return None

    def _take_back(self, api, struct):
        size, place = (ADDRESS.from_address(struct + offset).value for offset in (24, 32))
        assert size == self.lent[-1].nbytes - 16 and 0 <= place - self.lent[-1].ctypes.data < 16
        self.lent[-1] = size


@pytest.fixture
def card(monkeypatch):
    """A card; in the test, programs of the CPU are lowered as for the card, and all batches are kernels."""
    card, load = Launching(), launch.load_handler
    for name, value in {
        "PLATFORM": "cpu",
        "TARGET_PREFIX": f"udkjax_test_{next(NUMBERS)}_",
        "MEMBERS_OF_CORE": 1,
        "thread_count": lambda: 2,
        "driver": lambda: card,
        "load_kernel": card.load_kernel,
        "load_handler": lambda *given: card.within_cpu(load(*given), "launch"),
        "_has_memory": lambda of, kernel: True,
    }.items():
        monkeypatch.setattr(launch, name, value)
    monkeypatch.setattr(launch_handler, "BLOCK_THREADS", 4)
    monkeypatch.setattr(processor, "lanes", lambda: VECTOR_LENGTH)
    monkeypatch.setattr(loaded_code.LoadedCode, "name_on_card", loaded_code.LoadedCode.name)
    mlir.register_lowering(primitive.native_p, mlir.lower_fun(primitive._lower_for_card), platform="cpu")
    _forget()
    yield card
    mlir.register_lowering(primitive.native_p, mlir.lower_fun(primitive._lower), platform="cpu")
    _forget()


def _forget():
    for cache in (launch._load, loaded_code.generate, loaded_code.machine_code):
        cache.cache_clear()
    jax.clear_caches()


NUMBERS = itertools.count()


def both(request, function, *given):
    """Results of a compiled function with the CPU's code and with kernels; and the card."""
    machine_lanes = processor.lanes
    processor.lanes = lambda: VECTOR_LENGTH
    try:
        _forget()
        known = jax.tree.map(np.asarray, jax.jit(function)(*given))
    finally:
        processor.lanes = machine_lanes
    card = request.getfixturevalue("card")
    return known, jax.tree.map(np.asarray, jax.jit(function)(*given)), card


@pytest.mark.parametrize("name", [pytest.param("redundant", marks=pytest.mark.slow), "tangent"])
def test_programs_launch_batches(request, name):
    known, found, card = both(request, jax.vmap(RUNS[name]), MASSES)
    jax.tree.map(assert_array_equal, found, known)
    assert card.grids and set(card.grids) == {(2, 4)}  # five members
    pushed = [x for x in card.names if x.startswith("cuCtx")]
    assert pushed == ["cuCtxPushCurrent_v2", "cuCtxPopCurrent_v2"] * len(card.grids)


@pytest.mark.slow
def test_scans_and_gradients_launch_batches(request):
    """Batches this small store the records of their steps on the card."""
    run = jax.vmap(lambda x: RUNS["tangent"](x)[0].sum())

    def scanned(xs):
        return jax.lax.scan(lambda total, x: (total + run(x * MASSES).sum(), run(x * MASSES)), 0.0, xs)

    def slopes(xs):
        return jax.grad(lambda xs: (run(xs) ** 2).sum())(xs)

    known, found, card = both(request, lambda xs: (scanned(xs), slopes(MASSES * xs[0])), np.array([1.0, 1.1]))
    jax.tree.map(assert_array_equal, found, known)
    assert len(card.grids) >= 2


def gradients(masses):
    return jax.vmap(RUNS["gradient"])(masses)


ELEVEN = np.linspace(1.0, 2.0, 11)


@pytest.fixture
def without_records(monkeypatch):
    """Reverse mode without records between its passes, as of large batches."""
    monkeypatch.setattr(records, "LARGEST_ON_CARD", 1)


RECORD = 8 * (3 + 3 * PENDULUM.q0.size) * 8  # bytes: eight points


@pytest.mark.slow
@pytest.mark.usefixtures("without_records")
@pytest.mark.parametrize(
    ("limit", "members", "chunks"),
    [("none", 11, 1), ("card", 2, 6), ("steps", 11, 1), ("buffer", 4, 3)],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_reverse_mode_runs_in_chunks_for_which_there_is_memory(request, monkeypatch, limit, members, chunks):
    """With memory for all members, for some, on a card that refuses more, and for more steps than the first pass made."""
    if limit == "buffer":
        monkeypatch.setattr(launch_handler, "MOST_RECORDS", 5 * RECORD)
    if limit == "steps":
        longest, at = records.with_longest, -records.GIVEN_STEPS

        def third(inputs, operation):
            found = longest(inputs, operation)
            return [*found[:at], found[at] / 3.0, *found[at + 1 :]] if isinstance(operation, RunCotangents) else found

        monkeypatch.setattr(records, "with_longest", third)
    if limit == "card":
        monkeypatch.setattr(Launching, "most", 3 * RECORD)
    known, found, card = both(request, gradients, ELEVEN)
    assert_array_equal(found, known)
    assert card.lent[-1] == members * RECORD + launch_handler.SHARED_BYTES
    whole, blocks = (3, 4), (-(-members // 4), 4)
    assert len(card.lent) == 1 + (limit == "steps")
    assert card.grids == [*[whole] * 3, *[blocks] * chunks * len(card.lent), whole]


@pytest.mark.slow
@pytest.mark.usefixtures("without_records")
def test_a_card_without_memory_for_a_single_record_is_an_error(card):
    card.most = RECORD // 2
    with pytest.raises(Exception, match="RESOURCE_EXHAUSTED: the card is full"):
        jax.block_until_ready(jax.jit(gradients)(ELEVEN))
    assert card.names[-1] == "cuCtxPopCurrent_v2"


@pytest.mark.slow
def test_an_error_of_the_launch_is_that_of_the_program(card):
    card.failing["cuLaunchKernel"] = 1
    with pytest.raises(Exception, match="launching a kernel for a batch failed: an illegal memory access was"):
        jax.block_until_ready(jax.jit(jax.vmap(RUNS["redundant"]))(MASSES))
    assert card.names[-2:] == ["cuCtxPopCurrent_v2", "cuGetErrorString"] and card.calls[-1][1] == ERROR


def test_small_batches_stay_with_the_host(monkeypatch):
    (call,) = (x for x in emulation.calls_of(jax.vmap(RUNS["redundant"]), MASSES) if type(x.operation).__name__ == "RunStates")
    least = launch.MEMBERS_OF_CORE * launch.thread_count()

    def target_of(members):
        return launch.kernel_target(call.operation, [np.zeros((members, *x.shape[1:])) for x in call.inputs])

    assert target_of(least - 1) is None
    assert (target_of(least) or "").startswith(launch.TARGET_PREFIX)
    for setting, members, served in (("7", 7, True), ("7", 6, False), ("never", 10**4, False)):
        monkeypatch.setenv("UDKJAX_KERNEL_MEMBERS", setting)
        assert (target_of(members) is not None) == served
    monkeypatch.setenv("UDKJAX_KERNEL_MEMBERS", "few")
    with pytest.raises(ValueError, match='UDKJAX_KERNEL_MEMBERS is "few", not a number of members or "never"'):
        target_of(7)


@pytest.mark.parametrize("name", ["redundant", "tangent", "gradient"])
@pytest.mark.slow
def test_kernels_are_assembled(name):
    assembler = target.ptxas()
    if assembler is None:
        pytest.skip("no ptxas")
    texts = {call.kernel.text: call for call in emulation.calls_of(jax.vmap(RUNS[name]), MASSES)}
    for kernel, call in texts.items():
        if isinstance(call.operation, RunCotangents) and name != "gradient":
            continue  # the first pass of another test
        text = target.ptx(kernel)
        assert "ld.local" in text or type(call.operation).__name__ == "FindScales"
        assert target.assemble(text, target.NEWEST_CAPABILITY, assembler)[:4] == b"\x7fELF"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None or platform.machine() != "x86_64", reason="no C compiler for this processor")
@pytest.mark.parametrize("name", ["redundant", "elementary functions", "own formulation", "tangent", "gradient"])
def test_ptx_computes_what_the_engine_computes(name, tmp_path):
    """LLVM's PTX, transliterated to C, is bitwise right, and so are the address spaces of its pointers."""
    programs = {}
    for call in emulation.calls_of(jax.vmap(RUNS[name]), MASSES):
        code = call.kernel
        if isinstance(call.operation, RunCotangents) and name != "gradient":
            continue  # the first pass of another test
        if code.text not in programs:
            folder = tmp_path / str(len(programs))
            folder.mkdir()
            programs[code.text] = ptx_as_c.compiled(target.ptx(code.text), folder)
        arrays = emulation.Arrays(code, call)
        programs[code.text](arrays.address, len(arrays.outputs[0]))
        for found, known in zip(arrays.outputs, call.outputs, strict=True):
            assert_array_equal(found, known)


class Loading:
    """A driver with several devices that loads only certain kinds of kernels."""

    def __init__(self, capabilities, accepted=(b"\x7fELF", b"//\n/")):
        self.capabilities, self.accepted, self.images = capabilities, accepted, []

    def device_count(self):
        return len(self.capabilities)

    def attribute(self, which, ordinal):
        return self.capabilities[ordinal][which == launch.MINOR]

    def __call__(self, name, place, *given):
        if name == "cuLibraryLoadData":
            self.images.append(given[0][:4])
            if given[0][:4] not in self.accepted:
                raise CudaError("the provided PTX was compiled with an unsupported toolchain")
        ADDRESS.from_address(place).value = 42


@pytest.mark.parametrize(
    ("driver", "images", "handle"),
    [
        (Loading([(9, 0)]), 1, 42),
        (Loading([(9, 0)], accepted=(b"//\n/",)), 2, 42),  # `ptxas` is newer than the driver
        (Loading([(9, 0)], accepted=()), 2, None),
        (Loading([(9, 0), (8, 0)]), 1, 42),  # two kinds of cards: the driver assembles
        (Loading([(6, 1)]), 0, None),
    ],
)
def test_kernels_are_loaded_or_left_to_the_host(driver, images, handle):
    call = next(x for x in emulation.calls_of(jax.vmap(RUNS["elementary functions"]), MASSES))
    if target.ptxas() is None:
        images = min(images, 1)
    assert launch.load_kernel(driver, call.kernel) == handle
    assert len(driver.images) == images
    if driver.device_count() > 1:
        assert driver.images == [b"//\n/"]
