"""The cache of machine code on disk.

It holds object code under a digest of the text, the processor and the compiler. Incomplete files are compiled again; the oldest
are deleted when there are too many.
"""

import hashlib
import os
import tempfile
from pathlib import Path

import platformdirs

MAX_FILES = 5_000  # object files of 10 to 75 KiB, 150 MB in all
_MAGIC = b"udkjax object 1\n"


def cache_folder() -> Path | None:
    """Return the folder of stored code: the user's cache folder, or `UDKJAX_CACHE`; None if that is 0."""
    choice = os.environ.get("UDKJAX_CACHE", "").strip()
    if choice == "0":
        return None
    return Path(choice).expanduser() if choice else platformdirs.user_cache_path("udkjax")


def cached_files() -> list[tuple[float, int, Path]]:
    """List the time of last use, the size in bytes and the path of each file."""
    folder, found = cache_folder(), []
    try:
        for file in folder.iterdir() if folder else ():
            if file.is_dir():  # JAX's own cache
                continue
            status = file.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, file))
    except OSError:  # the folder does not exist yet, or another process has just removed a file
        pass
    return found


def read(name: str) -> bytes | None:
    """Return the stored code of this name; None if the file is missing or incomplete."""
    folder = cache_folder()
    try:
        data = (folder / name).read_bytes() if folder else b""
    except OSError:
        return None
    head, code = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :]
    if not head.startswith(_MAGIC) or hashlib.sha256(code).digest() != head[len(_MAGIC) :]:
        return None
    return code


def write(name: str, code: bytes) -> None:
    """Store code atomically, as other processes may read it meanwhile."""
    folder = cache_folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_MAGIC + hashlib.sha256(code).digest() + code)
            os.replace(temporary, folder / name)
        except OSError:  # a full disk: remove the partial file
            Path(temporary).unlink(missing_ok=True)
            raise
        files = [p for p in folder.iterdir() if p.is_file()]
        if len(files) > MAX_FILES:
            for old in sorted(files, key=lambda p: p.stat().st_mtime)[: len(files) - MAX_FILES]:
                old.unlink(missing_ok=True)
    except OSError:  # not writable: run without a cache
        return
