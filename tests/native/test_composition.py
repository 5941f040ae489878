"""Runs by machine code compose with every transformation of JAX, and compiled code is stored safely on disk."""

import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from udkjax import threads
from udkjax.native import loaded_code, records
from udkjax.native.code import code_cache, machine
from udkjax.native.derivatives import record
from udkjax.native.host.ffi import handler
from udkjax.native.module.memory import Memory
from udkjax.programs.deferred import deferred_p
from udkjax.show import doctor

TS = np.array([0.0, 0.2, 0.4, 0.6])
PENDULUM = udk.library.compound_pendulum()
KNOWN = udk.analyse(PENDULUM)
INERTIAS = jnp.array([0.3, 0.35, 0.4, 0.45])


def angles(inertia, rtol=1e-10):
    """The angles of the rod at the output times as a function of its moment of inertia."""
    mechanism = PENDULUM.with_parameters({"body.rod.inertia": inertia})
    run = udk.simulate(mechanism, TS, udk.State(PENDULUM.q0, PENDULUM.v0), rtol=rtol, atol=1e-10, throw=False, analysis=KNOWN)
    return run.q[:, 0, 2]


def angle(inertia, rtol=1e-10):
    """The angle after 0.6 s."""
    return angles(inertia, rtol)[-1]


@pytest.fixture(scope="module")
def values():
    """Values one by one, by compiled programs."""
    run = jax.jit(angle)
    return np.array([run(x) for x in INERTIAS])


@pytest.fixture(scope="module")
def slopes():
    """Slopes by differences of eighth order."""
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    run = jax.jit(lambda x: jax.lax.map(angle, x))
    return np.array([weights @ np.asarray(run(x + 4e-3 * np.arange(-4, 5))) / 4e-3 for x in INERTIAS])


def scanned(xs):
    return jax.lax.scan(lambda carry, x: (carry, angle(x)), 0.0, xs)[1]


WAYS = {
    "eager": lambda xs: jnp.stack([angle(x) for x in xs]),
    "vmap": jax.vmap(angle),
    "jit of vmap": jax.jit(jax.vmap(angle)),
    "vmap of vmap": jax.jit(lambda xs: jax.vmap(jax.vmap(angle))(xs.reshape(2, 2)).ravel()),
    "map": lambda xs: jax.lax.map(angle, xs),
    "scan": jax.jit(scanned),
    "checkpoint": jax.jit(jax.vmap(jax.checkpoint(angle))),  # pyright: ignore[reportPrivateImportUsage]
}


@pytest.mark.parametrize("run", WAYS.values(), ids=WAYS)
def test_every_way_gives_the_same_values(run, values):
    """They agree up to rounding, and bitwise if a member runs alone or in a program of its own."""
    assert_allclose(run(INERTIAS), values, rtol=0, atol=1e-13)


SLOPES = {
    "jvp": lambda xs: jnp.stack([jax.jvp(angle, (x,), (1.0,))[1] for x in xs]),
    "grad": jax.vmap(jax.grad(angle)),
    "jacfwd": lambda xs: jnp.diag(jax.jacfwd(jax.vmap(angle))(xs)),
    "jacrev": lambda xs: jnp.diag(jax.jacrev(jax.vmap(angle))(xs)),
    "vmap of jacfwd": jax.vmap(jax.jacfwd(angle)),
    "grad of map": lambda xs: jax.grad(lambda xs: jnp.sum(jax.lax.map(angle, xs)))(xs),
    "grad of scan": lambda xs: jax.grad(lambda xs: jnp.sum(scanned(xs)))(xs),
    "grad of checkpoint": jax.vmap(jax.grad(jax.checkpoint(angle))),  # pyright: ignore[reportPrivateImportUsage]
}


@pytest.mark.parametrize("way", fast(["jvp", "jacrev", "grad of scan", "grad of checkpoint"], SLOPES))
def test_every_way_gives_the_same_slopes(way, slopes):
    assert_allclose(jax.jit(SLOPES[way])(INERTIAS), slopes, rtol=1e-7)


@pytest.fixture
def record_length(monkeypatch):
    """A function that sets the capacity of a record in points. JAX caches the shapes of traced functions."""

    def change(points):
        monkeypatch.setattr(record, "STORED_POINTS", points)
        jax.clear_caches()

    yield change
    jax.clear_caches()


@pytest.mark.slow
def test_a_member_whose_record_is_too_long_is_run_again(record_length):
    """It is run again in the reverse pass: alone, and next to members whose record is long enough."""
    rtols = jnp.array([1e-4, 1e-6, 1e-8, 1e-10])  # of 11 to 14 points
    slopes = lambda: [jax.jit(jax.vmap(jax.jacrev(angles)))(INERTIAS[:n], rtols[:n]) for n in (1, 4)]  # noqa: E731
    expected = slopes()
    for points in (1, 12):
        record_length(points)
        for found, known in zip(slopes(), expected, strict=True):
            assert_array_equal(found, known)


IN_A_BATCH = {
    "grad of vmap": lambda xs, tols: jax.grad(lambda xs: jnp.sum(jax.vmap(angle)(xs, tols)))(xs),
    "vmap of grad": jax.vmap(jax.grad(angle)),
    "vmap of jit": jax.vmap(jax.jit(jax.grad(angle))),
    "vmap of vmap": lambda xs, tols: jax.vmap(jax.vmap(jax.grad(angle)))(xs.reshape(2, 2), tols.reshape(2, 2)).ravel(),
    "jacrev of vmap": lambda xs, tols: jnp.diag(jax.jacrev(lambda xs: jax.vmap(angle)(xs, tols))(xs)),
    "vmap of jacrev": lambda xs, tols: jax.vmap(jax.jacrev(angles))(xs, tols)[:, -1],
    "vmap of scan": lambda xs, tols: jax.vmap(jax.grad(lambda x, tol: jax.lax.map(lambda x: angle(x, tol), x[None])[0]))(
        xs, tols
    ),
}


@pytest.mark.parametrize("way", fast(["vmap of grad"], IN_A_BATCH))
def test_a_large_batch_stores_no_records(way, monkeypatch):
    """Its members are integrated again: all bits are those of a batch with records."""
    slope, rtols = IN_A_BATCH[way], jnp.array([1e-4, 1e-6, 1e-8, 1e-10])
    expected = jax.jit(slope)(INERTIAS, rtols)
    monkeypatch.setattr(records, "LARGEST_RECORDS", 0)
    jax.clear_caches()
    with calls_of(records.absent_records) as asked:
        assert_array_equal(jax.jit(slope)(INERTIAS, rtols), expected)
    assert asked
    jax.clear_caches()


def test_the_memory_of_a_gradient_is_a_few_states_of_each_member():
    members = 2000  # a record has 2,403 numbers
    program = jax.jit(jax.vmap(jax.grad(angle))).lower(jnp.linspace(0.3, 0.5, members)).compile()
    sizes = program.memory_analysis()
    if sizes is None:
        pytest.skip("this JAX does not tell")
    assert sizes.temp_size_in_bytes < members * 8 * 200


def test_threads_share_machine_code(values):
    run = jax.jit(angle)
    for way in (angle, run):
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(way, [*INERTIAS] * 4))
        assert_array_equal(np.asarray(found), np.tile(values, 4))


def test_a_member_does_not_depend_on_its_neighbours():
    """It is bitwise the same next to others, in another lane, and next to one that fails."""
    run = jax.jit(jax.vmap(angle, (0, 0)))
    xs, tols = jnp.linspace(0.3, 0.5, 11), jnp.logspace(-4, -10, 11)
    found = run(xs, tols)
    assert_array_equal(run(xs[::-1], tols[::-1])[::-1], found)
    assert_array_equal(run(xs, tols.at[1:].set(1e-3))[0], found[0])
    broken = run(xs.at[5].set(jnp.nan), tols)
    assert np.isnan(broken[5])
    assert_array_equal(np.delete(broken, 5), np.delete(found, 5))


SHARDED = """
import jax, jax.numpy as jnp, numpy as np, udkjax as udk
from jax.sharding import AxisType, PartitionSpec as P
from test_composition import INERTIAS, angle
assert len(jax.devices()) == 2
mesh = jax.make_mesh((2,), ("members",), axis_types=(AxisType.Auto,))
spread = P("members")
xs = jnp.concatenate([INERTIAS, INERTIAS + 0.01])
run, slope = jax.vmap(angle)(xs), jax.vmap(jax.grad(angle))(xs)
for check in (True, False):
    shard = lambda f: jax.jit(jax.shard_map(f, mesh=mesh, in_specs=spread, out_specs=spread, check_vma=check))
    np.testing.assert_allclose(shard(jax.vmap(angle))(xs), run, rtol=0, atol=1e-13)
np.testing.assert_allclose(shard(jax.vmap(jax.grad(angle)))(xs), slope, rtol=1e-9)

# A number that all devices share: its cotangent is the sum over them.
loss = lambda factor, xs: jnp.mean(jax.vmap(angle)(factor * xs))
shared = lambda factor, xs: jax.lax.pmean(loss(factor, xs), "members")
found = jax.jit(jax.shard_map(jax.value_and_grad(shared), mesh=mesh, in_specs=(P(), spread), out_specs=P()))(1.01, xs)
np.testing.assert_allclose(found, jax.value_and_grad(loss)(1.01, xs), rtol=1e-9)

drawn = udk.library.four_bar()
closed = lambda x: udk.assemble(drawn.with_parameters({"pin.B": jnp.stack([x, 1.0])})).q.sum()
places = jnp.linspace(0.5, 0.6, 4)
found = jax.jit(jax.shard_map(jax.vmap(jax.grad(closed)), mesh=mesh, in_specs=spread, out_specs=spread))(places)
np.testing.assert_allclose(found, jax.vmap(jax.grad(closed))(places), rtol=1e-9)
"""


@pytest.mark.slow
def test_devices_run_shards():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": os.path.dirname(__file__)}
    subprocess.run([sys.executable, "-c", SHARDED], env=environment, check=True, timeout=300)


def test_threads_of_xla_share_a_large_batch():
    """Members are the same whichever thread computes them, also if many calls ask for more threads than there are."""
    xs = jnp.linspace(0.3, 0.45, 80)
    run = jax.jit(jax.vmap(angles))
    expected = jnp.concatenate([jax.vmap(angles)(part) for part in xs.reshape(10, 8)])
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: run(xs), range(64)):
            assert_array_equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [None, 3])
def test_a_limit_of_threads_holds_inside_and_outside_of_compiled_programs(monkeypatch, limit):
    monkeypatch.setattr(threads, "cores", lambda: 8)
    monkeypatch.setenv("UDKJAX_THREADS", str(limit or ""))
    with jax.disable_jit(), calls_of(loaded_code.PreparedCall.__call__) as calls:
        jax.vmap(angles)(jnp.linspace(0.3, 0.45, 800))
    assert [call.arguments["self"].threads for call in calls] == [limit or 8]
    compared = re.findall(r"icmp slt i64 %\w+, 3\b", handler(Memory(), "call_frame")[-1].text())
    assert len(compared) == (limit is not None)


WITHOUT_MEMORY = """
import resource, sys
import jax, numpy as np, udkjax as udk

mech = udk.library.four_bar()
def last(x, end):
    varied = mech.with_parameters({"body.coupler.mass": x})
    return udk.simulate(varied, jax.numpy.array([0.0, 1.0]) * end, max_steps=10**7).q[-1, 0, 2]
run = {"eager": jax.grad(last), "jit": jax.jit(jax.grad(last))}[sys.argv[1]]
before = run(1.3, 2.0)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**24, resource.RLIM_INFINITY))
try:
    jax.block_until_ready(run(1.3, 1e5))
except (MemoryError, ValueError, jax.errors.JaxRuntimeError) as error:  # JAX raises ValueError for short programs
    print(error)
print(run(1.3, 2.0) == before)
"""


# XLA's name of the error. JAX before 0.12 compiles what is called once, too (programs/deferred.py).
COMPILED = "RESOURCE_EXHAUSTED: "
EAGER = COMPILED if deferred_p is None else ""


@pytest.mark.skipif(sys.platform != "linux", reason="the size of the process is read from /proc")
@pytest.mark.slow
@pytest.mark.parametrize(("way", "name"), [("eager", EAGER), ("jit", COMPILED)])
def test_a_record_without_memory_is_an_error(way, name):
    """The record of a gradient grows with the number of steps. Later calls are unaffected."""
    done = subprocess.run([sys.executable, "-c", WITHOUT_MEMORY, way], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines() == [f"{name}no memory for a computation by machine code", "True"]


def closed_angle(x):
    """Angle of a closed four-bar that was drawn with one pin at x. x is traced, as small scenes are closed by NumPy otherwise."""
    close = lambda x: udk.assemble(udk.library.four_bar().with_parameters({"pin.B": jnp.stack([x, 1.0])})).q[1, 2]  # noqa: E731
    return jax.vmap(close)(jnp.stack([x, x + 0.1]))


RUNS = {
    "run": lambda: angle(0.3),
    "batch": lambda: jax.vmap(angle)(INERTIAS),
    "forward": lambda: jax.jvp(angle, (0.3,), (1.0,)),
    "closing": lambda: closed_angle(0.5),
    "closing forward": lambda: jax.jacfwd(closed_angle)(0.5),
    "reverse": lambda: jax.grad(angle)(0.3),
}


@pytest.mark.parametrize(("refused", "run"), [*(("malloc", name) for name in RUNS), ("realloc", "reverse")])
def test_every_allocation_is_checked(monkeypatch, record_length, refused, run):
    """All allocations of one kind fail: a call of malloc or realloc in the code is replaced by null."""
    call, replaced, load = re.compile(rf"call ptr @{refused}\([^)]*\)"), [], loaded_code.load

    def load_refused(text, *arguments):  # under the name of the changed text: code of the other stays in use
        replaced.extend(call.findall(text))
        return load(call.sub("inttoptr i64 0 to ptr", text), *arguments)

    monkeypatch.setattr(loaded_code, "load", load_refused)
    record_length(1)  # so that the second pass allocates records,
    monkeypatch.setattr(record, "FIRST_POINTS", -4)  # too short ones

    def forget():  # what holds code under the name of an operation
        loaded_code.machine_code.cache_clear()
        loaded_code.generate.cache_clear()
        jax.clear_caches()

    forget()
    try:
        with pytest.raises((MemoryError, jax.errors.JaxRuntimeError), match="no memory for a computation by machine code"):
            RUNS[run]()
    finally:
        forget()
    assert replaced


def test_positions_without_memory_are_an_error(monkeypatch):
    compiled = machine.library
    replace = lambda text: re.sub(r"call ptr @malloc\([^)]*\)", "inttoptr i64 0 to ptr", text)  # noqa: E731
    monkeypatch.setattr(machine, "library", lambda text, *arguments: compiled(replace(text), *arguments))
    batch = udk.PositionBatch(udk.library.four_bar(), "body.crank.angle", ["pin.B"])
    with pytest.raises(MemoryError, match="no memory for a batch of positions"):
        batch({"pin.B": np.array([[0.5, 1.0]])}, np.array([0.1, 0.2]))


# --- object code on disk

TEXT = "define void @answer(ptr %x) {\n  store double 4.2e1, ptr %x\n  ret void\n}\n"


def answer(text: str = TEXT) -> float:
    library, x = machine.library(text, ["answer"]), np.zeros(1)
    machine.function(library["answer"], machine.ctypes.c_void_p)(x.ctypes.data)
    return float(x[0])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize(
    "spoil", [lambda data: data[:-7], lambda data: b"", lambda data: data[:60] + b"\0" + data[61:], lambda data: b"\0" * 99]
)
def test_a_file_that_is_not_whole_is_made_again(folder, spoil):
    assert answer() == 42.0
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(spoil(whole))
    assert answer() == 42.0
    assert file.read_bytes() == whole


def test_the_least_recently_used_files_are_deleted(folder):
    """Reading a file marks it as used, at most once a day."""
    for name, days in (("daily", 40), ("never", 30), ("today", 0)):
        code_cache.write(name, bytes(1000))
        os.utime(folder / name, (time.time(), time.time() - days * 86_400 - 60))
    before = (folder / "today").stat().st_mtime
    assert code_cache.read("daily") == code_cache.read("today") == bytes(1000)
    assert (folder / "today").stat().st_mtime == before
    code_cache.write("new", bytes(1000))
    code_cache.evict(3500)
    assert {file.name for file in folder.iterdir()} == {"daily", "today", "new"}


def test_the_folder_stays_bounded_by_a_look_at_it_in_many_writes(folder):
    with calls_of(code_cache.evict, code_cache.cached_files) as calls:
        for k in range(2 * code_cache.WRITES_OF_CHECK):
            code_cache.write(str(k), b"")
    assert [call.arguments.get("most") for call in calls] == [None, code_cache.MAX_BYTES] * 2


@pytest.mark.skipif(os.name != "posix", reason="homes are found otherwise")
@pytest.mark.parametrize("choice", ["", "~/code"])
def test_a_user_without_a_home_gets_no_cache(tmp_path, monkeypatch, choice):
    import pwd

    monkeypatch.setattr(pwd, "getpwuid", dict[int, object]().__getitem__)  # KeyError, as for a user without a name
    monkeypatch.setenv("UDKJAX_CACHE", choice)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    assert answer() == 42.0
    assert code_cache.cache_folder() is None and list(tmp_path.iterdir()) == []
    assert any("set UDKJAX_CACHE to a folder" in line for line in doctor._advice("native", ""))


def test_a_folder_that_cannot_be_written_is_no_obstacle(folder, monkeypatch):
    (folder / "file").write_bytes(b"")
    monkeypatch.setenv("UDKJAX_CACHE", str(folder / "file" / "cache"))
    assert answer() == 42.0


def test_a_full_disk_leaves_nothing_behind(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(code_cache.os, "replace", full)
    assert answer() == 42.0
    assert list(folder.iterdir()) == []


MANY = """
from test_composition import TEXT, answer
for k in range(20):
    assert answer(TEXT.replace("4.2e1", f"{k}.0")) == k
"""


@pytest.mark.slow
def test_processes_share_the_folder(folder):
    """Several processes write and read the same files at once."""
    environment = {**os.environ, "UDKJAX_CACHE": str(folder), "PYTHONPATH": os.path.dirname(__file__)}
    processes = [subprocess.Popen([sys.executable, "-c", MANY], env=environment) for _ in range(2)]
    assert [p.wait(timeout=300) for p in processes] == [0, 0]
    assert len(list(folder.iterdir())) == 20


def test_a_module_is_compiled_in_parts_that_others_share(monkeypatch):
    """Large functions separately, the others together. Functions that call each other, and constants, are linked."""
    monkeypatch.setattr(machine, "PART_LINES", 4)
    body = "".join(f"  %x{k} = fadd double %x{k - 1}, 1.0e0\n" for k in range(1, 9))
    large = "define double @eight(double %x0) {\n" + body + "  ret double %x8\n}\n"
    text = (
        "declare double @llvm.sqrt.f64(double)\n@two = private constant double 2.0e0\n"
        + large
        + "define void @answer(ptr %x) {\n  %a = load double, ptr @two\n  %b = call double @eight(double %a)\n"
        + "  %c = call double @root(double %b)\n  store double %c, ptr %x\n  ret void\n}\n"
        + "define double @root(double %x) {\n  %y = call double @llvm.sqrt.f64(double %x)\n  ret double %y\n}\n"
    )
    parts = machine.split_module(text)
    assert len(parts) == 3 and parts[0] == large
    assert machine.split_module(TEXT + large)[0] == large  # the same text in another module, hence the same file
    assert answer(text) == np.sqrt(10.0)


@pytest.mark.slow
def test_equal_programs_are_equal_texts_in_every_process():
    """Otherwise the code of derivatives would be compiled again in each."""
    program = """
import udkjax as udk
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.programs.unrolled import Unrolled
import hashlib
mechanism = udk.library.parallelogram()
programs = scene_programs(mechanism, udk.analyse(mechanism).redundant_rows)
unrolled = Unrolled(programs, [], [("q1", "v1 at q1")], [True] * programs.number_count, mode="reverse")
program = unrolled.derivative("q1", "v1 at q1").derivative.program
graph, order = program.graph, program.order
text = str([(graph.nodes[k].kind, [a.index for a in graph.nodes[k].arguments]) for k in order])
print(hashlib.sha256(text.encode()).hexdigest())
"""
    found = [
        subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True
        )
        for seed in "12"
    ]
    assert all(not one.returncode for one in found), found[0].stderr
    assert found[0].stdout == found[1].stdout
