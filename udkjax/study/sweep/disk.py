"""Files that are whole: each is there as it was written, or it is not there, and says whether a bit of it has changed."""

import hashlib
import io
import os
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

UNFINISHED = ".unfinished"  # what a file's name ends with while it is written
DIGEST = 64  # characters of a SHA-256


def packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an NPZ archive of the arrays whose comment is the SHA-256 of everything before it."""
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    body = stream.getvalue()[:-2]  # a ZIP archive ends with the length of its comment, and the comment
    return body + struct.pack("<H", DIGEST) + hashlib.sha256(body).hexdigest().encode()


def unpacked(content: bytes) -> dict[str, np.ndarray] | None:
    """Return the arrays of an archive that `packed` made, or None where a bit of it is not as it was."""
    body, length, digest = content[: -DIGEST - 2], content[-DIGEST - 2 : -DIGEST], content[-DIGEST:]
    if length != struct.pack("<H", DIGEST) or digest != hashlib.sha256(body).hexdigest().encode():
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return dict(archive)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that, whenever the process or the machine stops, it is there as it was before, or all of it is."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}{UNFINISHED}")
    try:
        with open(unfinished, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    if hasattr(os, "O_DIRECTORY"):  # where folders can be opened, their entries have to reach the disk too
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
