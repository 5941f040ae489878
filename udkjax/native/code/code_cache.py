"""The cache of machine code on disk.

Object code is stored under a digest of the text, the processor and the compiler, with a digest of this name and the code: a file
that is incomplete, or belongs to another name, is ignored. So are folders and files of other users (except root), and those that
others may write: stored code is executed. The least recently used files are deleted when the total size exceeds a limit.
"""

import hashlib
import itertools
import os
import stat
import tempfile
import time
from pathlib import Path

import platformdirs

from udkjax.folders import distrust, refusal

MAX_BYTES = 2**28  # maximum total size of the files; each has 10 to 75 KiB
WRITES_OF_CHECK = 500  # number of writes between two checks of the limit, as listing thousands of files takes 20 ms
TOUCH_AFTER = 86_400.0  # accuracy (s) of a file's time of last use: most reads need not update it
_MAGIC = b"udkjax object 2\n"
_READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)  # opening a pipe does not wait for a writer


def cache_folder() -> Path | None:
    """Return the folder of stored code, `UDKJAX_CACHE` or the user's cache folder; None without a home, or for "0"."""
    choice = os.environ.get("UDKJAX_CACHE", "").strip()
    if choice == "0":
        return None
    try:
        folder = Path(choice).expanduser() if choice else platformdirs.user_cache_path("udkjax")
    except RuntimeError:  # "~" without a home
        return None
    return folder if choice or folder.is_absolute() else None  # without a home platformdirs returns "~/.cache/udkjax"


def cached_files() -> list[tuple[float, int, Path]]:
    """List the time of last use, the size in bytes and the path of each file."""
    folder, files = cache_folder(), []
    try:
        for file in folder.iterdir() if folder else ():
            if file.is_dir():  # JAX's own cache
                continue
            status = file.stat()
            files.append((status.st_mtime, status.st_size, file))
    except OSError:  # the folder does not exist yet, or another process has just removed a file
        pass
    return files


def read(name: str) -> bytes | None:
    """Return the stored code of this name; None if the file is missing or incomplete, or cannot be trusted."""
    folder = cache_folder()
    if folder is None or refusal(folder):
        return None
    try:
        data = _read_own(folder / name)
    except OSError:
        return None
    head, code = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :]
    return code if head == _head(name, code) else None


def _head(name: str, code: bytes) -> bytes:
    """Return the first bytes of the file with the code of a name."""
    return _MAGIC + hashlib.sha256(name.encode() + b"\0" + code).digest()


def _read_own(path: Path) -> bytes:
    """Return the content of a regular file of this user that others may not write; nothing of any other file."""
    handle = os.open(path, _READING)
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or distrust(status):
            return b""
        with open(handle, "rb", closefd=False) as file:
            data = file.read()
    finally:
        os.close(handle)
    _touch(path, status.st_mtime)
    return data


def _touch(file: Path, last: float) -> None:
    try:
        if time.time() - last > TOUCH_AFTER:
            os.utime(file)
    except OSError:  # a folder of someone else, or the file has just been removed
        pass


def write(name: str, code: bytes) -> None:
    """Store code atomically, as other processes may read it meanwhile."""
    folder = cache_folder()
    if folder is None or refusal(folder):
        return
    try:
        folder.mkdir(stat.S_IRWXU, parents=True, exist_ok=True)  # also where new folders are writable for a group
        handle, temporary = tempfile.mkstemp(dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_head(name, code) + code)
            os.replace(temporary, folder / name)
        except OSError:  # a full disk: remove the partial file
            Path(temporary).unlink(missing_ok=True)
            raise
        if next(_writes) % WRITES_OF_CHECK == 0:
            evict(MAX_BYTES)
    except OSError:  # not writable: run without a cache
        return


_writes = itertools.count()  # of this process


def evict(most: int) -> None:
    """Delete the least recently used files above a limit of their total size (bytes)."""
    files = sorted(cached_files())
    excess = sum(size for _, size, _ in files) - most
    for _, size, file in files:
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size
