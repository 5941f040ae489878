"""C compilers for the platforms of FMUs: the compiler of this machine, and the extra `zig` for all platforms."""

import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args

from udkjax.extras import ZIG_PACKAGES, cure
from udkjax.requirements import ArgumentError

Platform = Literal["x86_64-linux", "aarch64-linux", "x86_64-windows", "x86_64-darwin", "aarch64-darwin"]  # as in FMI
ZIG_TARGETS: dict[str, str] = {
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos",
    "aarch64-darwin": "aarch64-macos",
}
LIBRARY_SUFFIXES = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}
COMPILER_OPTIONS = ("-std=c99", "-shared", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off")
MOST_COMPILE_SECONDS = 1200  # s, of a compilation


def this_platform() -> str:
    """Return FMI's name of this platform."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    return f"{machine}-{platform.system().lower()}"


def compiler_for(name: str) -> list[str]:
    """Return the command of a C compiler for a platform.

    Raises:
        ArgumentError: there is no compiler for the platform, or the platform is unknown.
    """
    if name not in get_args(Platform):
        raise ArgumentError(f"platforms must be among {', '.join(get_args(Platform))}, not {name}")
    if name == this_platform() and (own := next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)):
        return [own]
    if find_spec(*ZIG_PACKAGES) is None:
        raise ArgumentError(
            f"there is no C compiler for {name}: {cure(ZIG_PACKAGES)}, or give platforms=[] for an FMU of sources"
        )
    return [sys.executable, "-m", "ziglang", "cc", "-target", ZIG_TARGETS[name]]


def compile_library(command: Sequence[str], name: str, sources: Sequence[Path], to: Path, options: Sequence[str]) -> None:
    """Compile C to the shared library `to` of the platform `name`.

    Raises:
        ArgumentError: the compiler failed; the message has its output.
    """
    libraries = [] if name.endswith("windows") else ["-lm"]
    words = [*command, *COMPILER_OPTIONS, *options, *(x.name for x in sources), "-o", str(to.resolve()), *libraries]
    found = subprocess.run(
        words, cwd=sources[0].parent, capture_output=True, text=True, timeout=MOST_COMPILE_SECONDS, check=False
    )
    if found.returncode:
        raise ArgumentError(f"{' '.join(words[:3])} failed for {name}: {found.stderr.strip()[-2000:]}")
