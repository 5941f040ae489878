"""What importing this package sets up in JAX: float64, a cache of compiled programs on disk, and how programs run on the CPU.

Only the standard library is imported, so that the command line answers at once: before JAX is, its environment variables are set;
afterwards, its configuration.
"""

import atexit
import os
import sys
import time
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

FLOAT64 = "JAX_ENABLE_X64"
DISPATCH = "jax_cpu_enable_async_dispatch"  # JAX looks at it when it first uses the CPU
CACHE = "UDKJAX_COMPILATION_CACHE"
NO = ("0", "n", "no", "f", "false", "off")
YES = ("", "1", "y", "yes", "t", "true", "on")
XLA_FLAGS = "XLA_FLAGS"
WHOLE_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
WHOLE_BELOW = 10**9  # bytes that a round of the loop touches; JAX's own choice from 0.12 on, before that it is 1024
VECTORS = "xla_cpu_prefer_vector_width"
WIDEST = 512  # bits
OPTIONS = "xla_backend_extra_options"
MEMORY_CHECKS = "vectorize-memory-check-threshold"
MANY = 10**6  # by itself LLVM gives up after 128
# Loops of four rounds and more are not written out. Lanes are made of hundreds of eight: that takes a quarter off what those of
# the paper's linkage compile, of larger scenes a third. Those along four directions of a derivative would be no vectors any more.
NO_LONG_UNROLLING = "-unroll-full-max-count=3,-forget-scev-loop-unroll"
LIBRARY = "xla_cpu_experimental_ynn_fusion_type"
KNOWN = (0, 12)  # the newest JAX whose XLA is known to know the flag: one that it does not know ends the process

# JAX can bound the cache itself only where the package filelock is installed, and then it looks at every file for each program.
LARGEST = 512 * 2**20  # bytes; a simulation's program is about one megabyte
RARELY = 24 * 3600  # s between two looks at how large it is


def enable_float64() -> None:
    """Turn float64 on, unless the environment says `JAX_ENABLE_X64=0`."""
    os.environ[FLOAT64] = os.environ.get(FLOAT64) or "1"
    if os.environ[FLOAT64].lower() not in NO and "jax" in sys.modules:  # it has read its environment already
        sys.modules["jax"].config.update("jax_enable_x64", True)


def disable_async_dispatch() -> None:
    """Let programs on the CPU run in the thread that calls them.

    To hand one over to another thread, and to wait for it, takes up to 0.08 ms: half as long as a short run itself. JAX knows no
    environment variable for this: it is told as soon as it is imported, before anybody can use it.
    """
    if "jax" in sys.modules:
        _told_to_wait(sys.modules["jax"])
    else:
        sys.meta_path.insert(0, _JaxFinder())


def _told_to_wait(jax: ModuleType) -> None:
    jax.config.update(DISPATCH, False)


class _JaxFinder:
    """Finds JAX as the other finders do, and tells it once it has been imported."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if fullname != "jax":
            return None
        sys.meta_path.remove(self)
        try:
            spec = find_spec(fullname)
        finally:
            sys.meta_path.insert(0, self)  # found is not imported
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def then_tell(module: ModuleType) -> None:
                execute(module)
                sys.meta_path.remove(self)
                _told_to_wait(module)

            spec.loader.exec_module = then_tell
        return spec


def enable_whole_loops() -> None:
    """Let XLA make one function of a loop on the CPU, as it does by itself from JAX 0.12 on.

    Before, it starts each operation of each round by itself, for 50 to 150 ns, unless the loop is tiny: a run takes 20 to 40
    times as long. XLA reads its flags when it is first used; what they say of this already stays.
    """
    if _jax_version() < (0, 12):
        _add_flag(WHOLE_LOOPS, f"--xla_backend_extra_options={WHOLE_LOOPS}={WHOLE_BELOW}")


def enable_wide_vectors() -> None:
    """Let XLA use vectors of 512 bits where the CPU has them; by itself it uses half of that.

    Lanes take two thirds of the time then, and less to compile. Where the CPU has none, the flag changes nothing.
    """
    if _jax_version() <= KNOWN:
        _add_flag(VECTORS, f"--{VECTORS}={WIDEST}")


def enable_fusions_of_batches() -> None:
    """Let XLA and LLVM make vector code of loops along many arrays, as a batch's fusions are (straightline/fusion.py).

    LLVM looks first whether any two of the arrays overlap, however many looks that takes, and leaves long loops as they are,
    which compiles in less time. XLA calls no library for reductions of 4,096 numbers and more: it could not make one function of
    the loop that they are in, and fusions work in no other. There are none where XLA had read its flags before.
    """
    if _jax_version() != KNOWN:
        return
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None or not bridge.backends_are_initialized():
        _add_flag(LIBRARY, f"--{LIBRARY}=-reduce")
        _add_flag(OPTIONS, f"--{OPTIONS}=-{MEMORY_CHECKS}={MANY},{NO_LONG_UNROLLING}")


def _jax_version() -> tuple[int, ...]:
    try:
        return tuple(map(int, version("jax").split(".")[:2]))
    except (PackageNotFoundError, ValueError):  # a version of somebody's own: taken for a new one
        return (1 << 30,)


def _add_flag(name: str, flag: str) -> None:
    flags = os.environ.get(XLA_FLAGS, "")
    if name not in flags:
        os.environ[XLA_FLAGS] = f"{flags} {flag}".strip()


def enable_compilation_cache() -> None:
    """Let JAX keep compiled programs on disk, so that the next process need not compile them again.

    `UDKJAX_COMPILATION_CACHE` says where, or 0: nowhere; a cache that JAX was given already stays as it is. Programs are found by
    their text, the versions of JAX's compiler, its flags and the processor's type and features, all of which JAX sees to. Where
    nothing can be written, nothing is kept.
    """
    configured = sys.modules["jax"].config.jax_compilation_cache_dir if "jax" in sys.modules else None
    folder = cache_folder()
    if folder is None or configured is not None or "JAX_COMPILATION_CACHE_DIR" in os.environ or not _writable(folder):
        return
    # By default JAX keeps only what took a second to compile. The many small programs of a start take as long together.
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        os.environ.setdefault(name.upper(), str(value))
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)
    atexit.register(_bound, folder)


def cache_folder() -> Path | None:
    """Where compiled programs are kept if nothing else is configured: the user's cache folder, or what the environment says."""
    choice = os.environ.get(CACHE, "").strip()
    if choice.lower() in NO:
        return None
    if choice.lower() not in YES:
        return Path(choice).expanduser()
    try:
        home = Path.home()
    except RuntimeError:  # there is none
        return None
    if sys.platform == "darwin":
        caches = home / "Library" / "Caches"
    elif sys.platform == "win32":
        caches = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    else:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return caches / "udkjax" / "jax"


def programs_in(folder: Path) -> list[tuple[float, int, Path]]:
    """When each program in a cache was last used or made, its size in bytes, and its file."""
    found = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.endswith("-cache"):
                    status = entry.stat()
                    found.append((max(status.st_atime, status.st_mtime), status.st_size, Path(entry.path)))
    except OSError:  # not there yet, or another process has just removed a file
        pass
    return found


def _writable(folder: Path) -> bool:
    there = next((f for f in (folder, *folder.absolute().parents) if f.exists()), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _bound(folder: Path, largest: int = LARGEST, rarely: float = RARELY) -> None:
    """Remove what was not used for longest until the rest is small enough, now and then."""
    looked = folder / ".looked-at"
    try:
        if "jax" not in sys.modules or (looked.exists() and time.time() - looked.stat().st_mtime < rarely):
            return
        looked.touch()
        programs = sorted(programs_in(folder))
        size = sum(s for _, s, _ in programs)
        for _, s, file in programs:
            if size <= largest:
                break
            file.unlink(missing_ok=True)
            size -= s
    except OSError:  # no such folder, or no longer writable
        pass
