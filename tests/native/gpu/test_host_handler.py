"""Operations of the host in programs of a graphics card: the same handler, with a driver that copies from and to the host itself.

Programs are lowered as for a card and run on the CPU. XLA gives the handler its own frames, in which the function that returns
the stream is replaced.
"""

import ctypes
import itertools
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import mlir
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.calls import calls_of
from tests.choices import needs_deferred
from udkjax.native import primitive, records
from udkjax.native.gpu import host_handler
from udkjax.native.gpu.driver import CudaError
from udkjax.native.host import ffi, host_function, host_program
from udkjax.programs.deferred import deferred

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="JAX has no CUDA there")
STREAM, CONTEXT, ERROR = 0x5EED, 0xC0DE, 700
ADDRESS = ctypes.c_uint64


class Card:
    """A driver that copies within the host. It records its calls, fails on `failing`, and counts running threads."""

    def __init__(self):
        self.calls, self.failing, self._functions, self._frames = [], {}, {}, itertools.count()
        self.text = ctypes.c_char_p(b"an illegal memory access was encountered")
        move = lambda to, source, size, _: ctypes.memmove(to, source, size)  # noqa: E731
        self.add("cuStreamGetCtx", 2, lambda stream, place: self.write(place, CONTEXT))
        self.add("cuCtxPushCurrent_v2", 1, lambda context: None)
        self.add("cuCtxPopCurrent_v2", 1, lambda place: self.write(place, CONTEXT))
        self.add("cuMemcpyDtoHAsync_v2", 4, move)
        self.add("cuMemcpyHtoDAsync_v2", 4, move)
        self.add("cuMemHostAlloc", 3, self.pin)
        self.add("cuStreamSynchronize", 1, lambda stream: None)
        self.add("cuGetErrorString", 2, lambda answer, place: self.write(place, ctypes.cast(self.text, ctypes.c_void_p).value))

    def add(self, name, arguments, act):
        @ctypes.CFUNCTYPE(ctypes.c_int, *[ADDRESS] * arguments)
        def function(*given):
            self.calls.append((name, *given))
            if self.names.count(name) == self.failing.get(name):
                return ERROR
            act(*given)
            return 0

        self._functions[name] = function

    def __call__(self, name, *arguments):
        if self._functions[name](*arguments):
            raise CudaError(name)

    @contextmanager
    def current(self, ordinal):
        yield

    def pin(self, place, size, flags):
        self.pinned = np.full(size // 8, -1)
        self.write(place, self.pinned.ctypes.data)

    @property
    def names(self):
        return [call[0] for call in self.calls]

    def write(self, place, number):
        ADDRESS.from_address(place).value = number

    def address(self, name):
        return ctypes.cast(self._functions[name], ctypes.c_void_p).value

    def within_cpu(self, library, name="copy_and_call"):
        """A handler of the CPU that calls the handler of a library in a frame with functions of a card (`functions_of_xla`)."""
        handle = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(library[name])

        @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
        def trampoline(frame):
            if ADDRESS.from_address(frame + ffi.EXTENSIONS).value:
                return handle(frame)
            api = ADDRESS.from_address(frame + ffi.API).value
            copied = ctypes.create_string_buffer(ctypes.string_at(api, ADDRESS.from_address(api).value))
            replaced = {
                offset: ctypes.CFUNCTYPE(ctypes.c_void_p, ADDRESS)(partial(function, api))
                for offset, function in self.functions_of_xla().items()
            }
            for offset, function in replaced.items():
                self.write(ctypes.addressof(copied) + offset, ctypes.cast(function, ctypes.c_void_p).value)
            self.write(frame + ffi.API, ctypes.addressof(copied))
            try:
                return handle(frame)
            finally:
                self.write(frame + ffi.API, api)

        self._functions[next(self._frames)] = trampoline, library
        return {name: ctypes.cast(trampoline, ctypes.c_void_p).value}

    def functions_of_xla(self):
        """The functions of XLA that differ on a card, by their offsets: of the API's address and that of their arguments."""
        return {ffi.STREAM: lambda api, struct: self.write(struct + 24, STREAM)}


@pytest.fixture
def card(monkeypatch):
    """A card; in the test, programs of the CPU are lowered as for the card."""
    card, load, registered = Card(), host_handler.load, host_handler.register
    number = next(NUMBERS)
    monkeypatch.setattr(host_handler, "PLATFORM", "cpu")
    monkeypatch.setattr(host_handler, "driver", lambda: card)
    monkeypatch.setattr(host_handler, "_device", lambda: 0)
    monkeypatch.setattr(host_handler, "load", lambda of, handler: card.within_cpu(load(of, handler, threads=3)))
    monkeypatch.setattr(host_handler, "register", lambda name, handler: registered(f"{name}_{number}", handler))
    for p, module in ((primitive.native_p, primitive), (host_function.host_p, host_function)):
        mlir.register_lowering(p, mlir.lower_fun(module._lower_for_card), platform="cpu")
    monkeypatch.setattr(host_program, "HOST", "none")
    jax.clear_caches()
    yield card
    for p, module in ((primitive.native_p, primitive), (host_function.host_p, host_function)):
        mlir.register_lowering(p, mlir.lower_fun(module._lower), platform="cpu")
    jax.clear_caches()


NUMBERS = itertools.count()
PENDULUM, TS = udk.library.compound_pendulum(), np.array([0.0, 0.2, 0.4, 0.6])
KNOWN = udk.analyse(PENDULUM)


def angles(inertia):
    """The angles of the rod at the output times."""
    mechanism = PENDULUM.with_parameters({"body.rod.inertia": inertia})
    return udk.simulate(mechanism, TS, udk.State(PENDULUM.q0, PENDULUM.v0), throw=False, analysis=KNOWN).q[:, 0, 2]


def slopes(inertia):
    return jax.jvp(angles, (inertia,), (1.0,))[1], jax.jacrev(angles)(inertia)


@pytest.mark.slow
def test_runs_and_their_derivatives_are_those_of_the_cpu(request):
    expected = [np.asarray(x) for x in (jax.jit(angles)(0.3), *jax.jit(slopes)(0.3))]
    card = request.getfixturevalue("card")
    found = [jax.jit(angles)(0.3), *jax.jit(slopes)(0.3)]
    for x, y in zip(found, expected, strict=True):
        assert_array_equal(x, y)
    runs = card.names.count("cuStreamGetCtx")
    assert runs == 4  # one, one forward, and two passes of reverse mode
    assert [card.names.count(x) for x in ("cuCtxPushCurrent_v2", "cuCtxPopCurrent_v2", "cuStreamSynchronize")] == [4, 4, 8]
    assert all(STREAM in call for call in card.calls if call[0].startswith(("cuMemcpy", "cuStream")))


@pytest.mark.slow
def test_batches_do_not_copy_their_records(request):
    inertias = jnp.linspace(0.3, 0.5, records.LARGEST_ON_CARD)
    slope = jax.vmap(jax.grad(lambda x: angles(x)[-1]))
    expected = np.asarray(jax.jit(slope)(inertias))
    card = request.getfixturevalue("card")
    assert_array_equal(jax.jit(slope)(inertias), expected)
    assert (
        max(call[3] for call in card.calls if call[0].startswith("cuMem")) < 8 * len(inertias) * 100
    )  # a record has 2,403 numbers


@pytest.mark.slow
def test_a_batch_runs_on_several_threads(request):
    inertias = jnp.linspace(0.3, 0.5, 200)
    expected = np.asarray(jax.jit(jax.vmap(angles))(inertias))
    request.getfixturevalue("card")
    assert_array_equal(jax.jit(jax.vmap(angles))(inertias), expected)


def test_it_runs_within_loops(card):
    found = jax.jit(lambda xs: jax.lax.scan(lambda carry, x: (carry, angles(x)), 0.0, xs)[1])(jnp.array([0.3, 0.4, 0.5]))
    assert card.names.count("cuStreamGetCtx") == 3 and np.isfinite(found).all()


@dataclass(frozen=True)
class Norm:
    """The norm of each row, or an error."""

    fails: bool = False

    def shapes(self, members):
        return [(members,)]

    def __call__(self, *inputs):
        if self.fails:
            raise ValueError("no norm today")
        return [np.linalg.norm(inputs[0], axis=1)]


def norms(rows, fails=False):
    return host_function.call_host(Norm(fails), [rows])[0]


def test_functions_of_python_are_called(card):
    rows = jnp.arange(6.0).reshape(3, 2)
    assert_array_equal(jax.jit(norms)(rows), np.linalg.norm(rows, axis=1))
    assert [x[:1] + x[3:4] for x in card.calls if x[0].startswith("cuMemcpy")] == [
        ("cuMemcpyDtoHAsync_v2", 48),
        ("cuMemcpyHtoDAsync_v2", 24),
    ]
    assert jax.jit(norms)(jnp.zeros((0, 2))).shape == (0,)


def test_small_calls_use_pinned_memory_one_at_a_time(card):
    """A call uses other memory if the pinned memory is in use or too small."""

    def places(rows):
        card.calls.clear()
        assert_array_equal(jax.jit(norms)(rows), np.linalg.norm(rows, axis=1))
        copies = [x for x in card.calls if x[0].startswith("cuMem")]
        ends = [copies[-2][1], copies[-1][2]]  # on the host
        start = card.pinned.ctypes.data
        return [start <= x < start + card.pinned.nbytes for x in ends]

    jax.jit(norms)(jnp.ones((3, 2)))
    assert card.names[0] == "cuMemHostAlloc"
    assert places(jnp.ones((3, 2))) == [True, True] and card.pinned[0] == 0
    card.pinned[0] = 1  # in use
    assert places(jnp.ones((3, 2))) == [False, False] and card.pinned[0] == 1
    card.pinned[0] = 0
    assert places(jnp.ones((host_handler.PINNED_BYTES // 16, 2))) == [False, False] and card.pinned[0] == 0


def test_pinned_memory_is_not_necessary(card):
    card.failing["cuMemHostAlloc"] = 1
    assert jax.jit(norms)(jnp.ones((1, 4))) == 2.0 and "cuMemcpyHtoDAsync_v2" in card.names


def test_the_error_of_an_operation_is_that_of_the_program(card):
    with pytest.raises(Exception, match="no norm today"):
        jax.block_until_ready(jax.jit(lambda x: norms(x, fails=True))(jnp.ones((1, 2))))
    assert "cuMemcpyHtoDAsync_v2" not in card.names and card.names[-1] == "cuCtxPopCurrent_v2"


FAILING = {  # which call of a function fails, and the last function called before the error is reported
    "cuStreamGetCtx": (1, "cuStreamGetCtx"),
    "cuCtxPushCurrent_v2": (1, "cuCtxPushCurrent_v2"),
    "cuMemcpyDtoHAsync_v2": (1, "cuCtxPopCurrent_v2"),
    "cuStreamSynchronize": (2, "cuCtxPopCurrent_v2"),
    "cuMemcpyHtoDAsync_v2": (1, "cuCtxPopCurrent_v2"),
}


@pytest.mark.parametrize("name", FAILING)
def test_an_error_of_the_driver_is_in_its_words(card, name):
    card.failing[name], last = FAILING[name]
    with pytest.raises(Exception, match="copying between the graphics card and the host failed: an illegal memory access was"):
        jax.block_until_ready(jax.jit(norms)(jnp.ones((1, 2))))
    assert card.names[-2:] == [last, "cuGetErrorString"] and card.calls[-1][1] == ERROR
    if name == "cuMemcpyDtoHAsync_v2":  # the copies before it end before their memory is freed
        assert "cuStreamSynchronize" in card.names and "cuMemcpyHtoDAsync_v2" not in card.names


def test_without_words_the_error_says_so(card):
    card.failing |= {"cuStreamSynchronize": 1, "cuGetErrorString": 1}
    with pytest.raises(Exception, match="failed: the driver does not say why"):
        jax.block_until_ready(jax.jit(norms)(jnp.ones((1, 2))))


def test_an_operation_finds_threads_in_its_frame(card):
    """It finds their number, and runs one task on each besides the caller's thread."""
    found, done = [], threading.Event()

    @ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    def task(data):
        found.append((data, threading.get_ident()))
        done.set()

    @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
    def handle(frame):
        api, context = (ADDRESS.from_address(frame + offset).value for offset in (ffi.API, ffi.CONTEXT))
        number = ctypes.c_int64()
        for function, *arguments in (
            (ffi.THREAD_COUNT, ctypes.addressof(number)),
            (ffi.SCHEDULE, ctypes.cast(task, ctypes.c_void_p).value, 42),
        ):
            call = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(ADDRESS.from_address(api + function).value)
            given = (ctypes.c_uint64 * 5)(40, 0, context, *arguments)
            assert call(ctypes.addressof(given)) is None
        assert done.wait(10.0)
        found.append((number.value, threading.get_ident()))
        return

    address = ctypes.cast(handle, ctypes.c_void_p).value
    assert address
    name = host_handler.register("threads", address)
    jax.block_until_ready(jax.jit(lambda x: jax.ffi.ffi_call(name, x)(x))(jnp.zeros(1)))
    assert [x for x, _ in found] == [42, 3] and found[0][1] != found[1][1]


def test_calls_of_several_threads_do_not_mix(card):
    """Some use the pinned memory; the others find it in use."""
    run = jax.jit(norms)
    given = [jnp.full((3, 2), float(k)) for k in range(40)]
    run(given[0])
    with ThreadPoolExecutor(8) as pool:
        for x, found in zip(given, pool.map(run, given), strict=True):
            assert_array_equal(found, np.linalg.norm(x, axis=1))


FOUR = udk.library.four_bar(np.pi / 3)
TABLE = jnp.array([2, 3, 5])


@deferred
def root(x, first=3, large=2**62 + 1):
    """The square root by Newton's method, and numbers of other types."""

    def step(state):
        r, k = state
        return 0.5 * (r + x / r), k + 1

    r, k = jax.lax.while_loop(lambda state: jnp.abs(state[0] ** 2 - x) > 1e-12 * x, step, (x, jnp.asarray(0)))
    values = jnp.linalg.svd(jnp.outer(TABLE, TABLE) * x, compute_uv=False)
    return r, k, k > first, jnp.asarray(large) + k, r * 1j, jnp.asarray(k, np.int32), jnp.asarray(r, np.float32), values


@deferred
def singular_values(x):
    return jnp.linalg.svd(jnp.array([[2.0, 1.0], [0.0, 1.0]]) * x + jnp.eye(2), compute_uv=False)


def in_a_scan(xs):
    def step(carry, x):
        found = jax.lax.cond(x > 2.0, lambda: root(x)[0], lambda: -x)
        return carry + found, found

    return jax.lax.scan(step, 0.0, xs)


SEVERAL = jnp.array([2.0, 3.0, 1.0])
NESTED = {  # a function, its argument, and the number of its calls
    "alone": (root, 2.0, 1),
    "in a batch": (jax.vmap(root), SEVERAL, 1),
    "in a loop and a branch": (in_a_scan, SEVERAL, 1),
    "forward mode": (lambda x: jax.jvp(singular_values, (x,), (1.0,)), 2.0, 1),
    "reverse mode": (jax.jacrev(singular_values), 2.0, 1),  # what follows the factorization is linear
    "batch of gradients": (jax.vmap(jax.grad(lambda x: singular_values(x)[0])), SEVERAL, 1),
}


@needs_deferred
@pytest.mark.parametrize("name", NESTED)
def test_a_program_with_loops_or_factorizations_is_one_call(request, name):
    function, x, calls = NESTED[name]
    expected = [np.asarray(y) for y in jax.tree.leaves(jax.jit(function)(x))]
    card = request.getfixturevalue("card")
    found = jax.tree.leaves(jax.jit(function)(x))
    assert [y.dtype for y in found] == [y.dtype for y in expected]
    for y, known in zip(found, expected, strict=True):
        assert_allclose(y, known, rtol=1e-14)
    assert card.names.count("cuStreamGetCtx") == calls
    assert card.names.count("cuMemcpyDtoHAsync_v2") == card.names.count("cuMemcpyHtoDAsync_v2") == calls


@needs_deferred
def test_such_a_program_is_compiled_once_and_runs_under_strict_settings(card):
    """It produces NaN in places that the surrounding program discards."""

    @deferred
    def undefined(x):
        return singular_values(x) / (x - x)

    x = jnp.asarray(2.0)
    programs = [jax.jit(f) for f in (lambda x: jnp.nan_to_num(undefined(x)), lambda x: jnp.where(x > 0, x, undefined(x)))]
    with calls_of(host_program.HostProgram._packed) as calls:
        for program in programs:
            program(x)
    made = [id(call.arguments["self"]) for call in calls]
    assert len(set(made)) == len(made)
    with jax.transfer_guard("disallow"), jax.debug_nans(True):
        jax.block_until_ready([program(x) for program in programs])


def rest(mass):
    return udk.equilibrium(PENDULUM.with_parameters({"body.rod.mass": mass})).q[0]


def moved(gravity):
    mechanism = FOUR.with_parameters({"gravity": jnp.stack([0.0 * gravity, gravity])})
    return udk.kinematics(mechanism, "body.crank.angle", np.linspace(1.0, 1.2, 3)).q[:, 1]


@needs_deferred
@pytest.mark.slow  # their programs take XLA seconds
@pytest.mark.parametrize(("solve", "x", "calls"), [(rest, 2.0, 3), (moved, -9.81, 4)])
def test_a_solve_is_one_call(request, solve, x, calls):
    """The scales, the assembly and the solve are one call each; `kinematics` adds another one, since all data are copied here."""
    expected = np.asarray(jax.jit(solve)(x))
    card = request.getfixturevalue("card")
    assert_allclose(jax.jit(solve)(x), expected, rtol=1e-12, atol=1e-12)
    assert card.names.count("cuStreamGetCtx") == calls
