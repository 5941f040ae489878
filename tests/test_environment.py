"""What importing the package sets up: where compiled programs are kept, and that nothing suffers where they cannot be."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from udkjax import environment
from udkjax.straightline import fusion

PRINT = "import jax, udkjax; print(jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs)"
RUN = """
import udkjax as udk, jax
counts = {"hit": 0, "miss": 0}
def listen(event, **_):
    for kind in counts:
        counts[kind] += f"compilation_cache/cache_{kind}" in event
jax.monitoring.register_event_listener(listen)
mech = udk.library.double_pendulum()
a = udk.accelerations(mech, 0.0, mech.q0, mech.v0)
print([x.hex() for x in a.ravel().tolist()], counts["hit"], counts["miss"])
"""


def python(code: str, **environment: object) -> str:
    clean = {"PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu", **{k: str(v) for k, v in environment.items()}}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("order", [PRINT, PRINT.replace("jax, udkjax", "udkjax, jax")], ids=["jax first", "udkjax first"])
def test_the_cache_is_in_the_users_cache_folder(tmp_path, order):
    assert python(order, HOME=tmp_path, XDG_CACHE_HOME=tmp_path / "caches") == f"{tmp_path / 'caches' / 'udkjax' / 'jax'} 0.0"
    assert list(tmp_path.iterdir()) == []  # nothing is made before there is something to keep


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        ({"UDKJAX_COMPILATION_CACHE": "0"}, "None 1.0"),
        ({"UDKJAX_COMPILATION_CACHE": "{}/elsewhere"}, "{}/elsewhere 0.0"),
        ({"JAX_COMPILATION_CACHE_DIR": "{}/mine"}, "{}/mine 1.0"),
        ({"XDG_CACHE_HOME": "/dev/null"}, "None 1.0"),  # in which nobody can make a folder
        ({"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "5", "UDKJAX_COMPILATION_CACHE": "{}/here"}, "{}/here 5.0"),
    ],
    ids=["off", "elsewhere", "JAX has one", "not writable", "the user's threshold"],
)
def test_the_environment_decides(tmp_path, choice, expected):
    choice = {name: value.format(tmp_path) for name, value in choice.items()}
    assert python(PRINT.replace("jax, udkjax", "udkjax, jax"), HOME=tmp_path, **choice) == expected.format(tmp_path)


LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold"
VECTORS = "--xla_cpu_prefer_vector_width"
EXTRA, LIBRARY = "--xla_backend_extra_options", "--xla_cpu_experimental_ynn_fusion_type"
OPTIONS = f"{EXTRA}=-vectorize-memory-check-threshold=1000000,{environment.NO_LONG_UNROLLING}"


@pytest.mark.parametrize(
    ("enable", "installed", "given", "expected"),
    [
        (environment.enable_whole_loops, "0.10.2", None, f"{LOOPS}=1000000000"),
        (environment.enable_whole_loops, "0.11.2", "--xla_a=1", f"--xla_a=1 {LOOPS}=1000000000"),
        (environment.enable_whole_loops, "0.11.2", f"{LOOPS}=7", None),
        (environment.enable_whole_loops, "0.12.0", None, None),
        (environment.enable_whole_loops, "0.12.0", "--xla_a=1", None),
        (environment.enable_whole_loops, "our own", None, None),
        (environment.enable_wide_vectors, "0.10.2", None, f"{VECTORS}=512"),
        (environment.enable_wide_vectors, "0.12.0.1", "--xla_a=1", f"--xla_a=1 {VECTORS}=512"),
        (environment.enable_wide_vectors, "0.12.0", f"{VECTORS}=128", None),
        (environment.enable_wide_vectors, "0.13.0", None, None),  # XLA ends the process on a flag that it no longer knows
        (environment.enable_wide_vectors, "our own", None, None),
        (environment.enable_fusions_of_batches, "0.11.2", None, None),
        (environment.enable_fusions_of_batches, "0.12.0", None, f"{LIBRARY}=-reduce {OPTIONS}"),
        (environment.enable_fusions_of_batches, "0.12.0", f"{LIBRARY}=+dot", f"{LIBRARY}=+dot {OPTIONS}"),
        (environment.enable_fusions_of_batches, "0.12.0", f"{EXTRA}=a=1", f"{EXTRA}=a=1 {LIBRARY}=-reduce"),
    ],
)
def test_flags_are_added_where_they_are_known_and_not_given(monkeypatch, enable, installed, given, expected):
    monkeypatch.setenv("XLA_FLAGS", given or "")
    monkeypatch.setattr(environment, "version", {"jax": installed}.get)
    monkeypatch.delitem(sys.modules, "jax._src.xla_bridge", raising=False)  # XLA has not read its flags yet
    enable()
    assert os.environ["XLA_FLAGS"] == (expected or given or "")


def test_fusions_of_batches_look_for_the_flags_that_are_added():
    assert all(flag in f"{LIBRARY}=-reduce {OPTIONS}" for flag in fusion.NEEDED)


def test_no_flag_is_added_that_xla_would_not_read_any_more(monkeypatch):
    import jax

    jax.devices()
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(environment, "version", {"jax": "0.12.0"}.get)
    environment.enable_fusions_of_batches()
    assert not os.environ["XLA_FLAGS"]


@pytest.mark.parametrize(
    "order",
    [
        "import jax, udkjax as udk",
        "import udkjax as udk, jax",
        "import udkjax as udk, jax.numpy, jax",
        "import udkjax as udk; udk.library; import jax",
        "import udkjax as udk; from importlib.util import find_spec; assert find_spec('jax'); import jax",
        "import udkjax as udk, sys; del sys.modules['udkjax.environment'], sys.modules['udkjax']; import udkjax as udk, jax",
    ],
    ids=["jax first", "udkjax first", "a part of jax", "a name first", "looked for before", "imported twice"],
)
@pytest.mark.parametrize("then", [False, True], ids=["as it is", "changed"])
def test_programs_run_in_the_thread_that_calls_them(tmp_path, order, then):
    code = f"{order}; jax.config.update('jax_cpu_enable_async_dispatch', True)" if then else order
    # what JAX's own first use of the CPU goes by, before any name is taken from udkjax, and what is found after one was
    code += "; print(r := jax.config.read('jax_cpu_enable_async_dispatch'))"
    code += "; udk.simulate; assert r == jax.config.read('jax_cpu_enable_async_dispatch')"
    code += "; import sys; assert not any(type(f).__module__.startswith('udkjax') for f in sys.meta_path)"
    assert python(code, HOME=tmp_path) == str(then)


def test_jax_is_missed_as_ever_where_it_is_not_installed(tmp_path):
    code = "import sys, udkjax; sys.path[:] = []\ntry: import jax\nexcept ImportError as e: print(e)"
    assert python(code, HOME=tmp_path) == "No module named 'jax'"


def test_a_cache_configured_before_stays(tmp_path):
    mine = str(tmp_path / "mine")
    code = f"import jax; jax.config.update('jax_compilation_cache_dir', {mine!r});" + PRINT
    assert python(code, HOME=tmp_path) == f"{mine} 1.0"


@pytest.mark.parametrize(
    ("platform", "expected"),
    [("linux", ".cache/udkjax/jax"), ("darwin", "Library/Caches/udkjax/jax"), ("win32", "Local/udkjax/jax")],
)
def test_each_system_has_its_place_for_caches(monkeypatch, tmp_path, platform, expected):
    monkeypatch.setattr(environment.sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("UDKJAX_COMPILATION_CACHE")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "Local"))
    assert environment.cache_folder() == tmp_path / expected


@pytest.mark.slow
def test_the_second_process_compiles_nothing_and_finds_the_same(tmp_path):
    first, second = (python(RUN, HOME=tmp_path).rsplit(maxsplit=2) for _ in range(2))
    assert first[0] == second[0]
    assert int(first[2]) > 0
    assert (int(second[1]), int(second[2])) == (int(first[1]) + int(first[2]), 0)


def test_what_was_not_used_for_longest_goes_first(monkeypatch, tmp_path):
    now = time.time()
    for k in range(4):
        file = tmp_path / f"program{k}-cache"
        file.write_bytes(bytes(100))
        os.utime(file, (now - 1000 * k, now - 1000 * k))
    (tmp_path / "something else").write_bytes(bytes(1000))
    environment._bound(tmp_path, largest=250)
    assert sorted(f.name for _, _, f in environment.programs_in(tmp_path)) == ["program0-cache", "program1-cache"]
    assert (tmp_path / "something else").exists()
    environment._bound(tmp_path, largest=0)  # it has only just looked
    assert len(environment.programs_in(tmp_path)) == 2
    environment._bound(tmp_path, largest=0, rarely=0)
    assert environment.programs_in(tmp_path) == []
    environment._bound(tmp_path / "not there")
