"""The cache of machine code on disk.

The name of a file is a digest of the text, the processor and the compiler. The file begins with a digest of this name and the
object code: a file that is incomplete, or belongs to another name, is ignored. So are folders and files of other users (except
root), and those that others may write: stored code is executed. The least recently used files are deleted when the total size
exceeds a limit.
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
_READ_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)  # opening a pipe does not wait for a writer


def cache_folder() -> Path | None:
    """Return the folder of stored code: the environment variable `UDKJAX_CACHE`, else the user's cache folder.

    Returns:
        The folder, which need not exist yet; None if no code is stored, because the variable is "0" or the user has no home.
    """
    choice = os.environ.get("UDKJAX_CACHE", "").strip()
    if choice == "0":
        return None
    try:
        folder = Path(choice).expanduser() if choice else platformdirs.user_cache_path("udkjax")
    except RuntimeError:  # "~" without a home
        return None
    return folder if choice or folder.is_absolute() else None  # without a home platformdirs returns "~/.cache/udkjax"


def cached_files() -> list[tuple[float, int, Path]]:
    """Return the time of last use (s since 1970), the size in bytes and the path of each file in the cache, in any order."""
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
    """Return the object code stored under a name; None if its file is missing or incomplete, or cannot be trusted."""
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
    """Return the first bytes of the file that stores some code under a name: a mark of the format, and a digest of both."""
    return _MAGIC + hashlib.sha256(name.encode() + b"\0" + code).digest()


def _read_own(path: Path) -> bytes:
    """Return the content of a file; b"" unless it is a regular file of this user (or root) that others may not write."""
    handle = os.open(path, _READ_FLAGS)
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
    """Store code under a name, atomically, as other processes may read it meanwhile; do nothing if there is no writable cache."""
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
    """Delete the least recently used files until the total size of all files is at most `most` bytes."""
    files = sorted(cached_files())
    excess = sum(size for _, size, _ in files) - most
    for _, size, file in files:
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size
