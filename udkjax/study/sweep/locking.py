"""One process at a time."""

import errno
import os
import socket
import warnings
from pathlib import Path
from typing import IO

HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)  # what the systems answer where another process has the lock


class Lock:
    """A lock on a file, which the system gives back when the process ends, in whatever way it does."""

    def __init__(self, path: Path):
        self.path = path
        self._file: IO[bytes] | None = None

    def take(self) -> str | None:
        """Take the lock; where another process has it, return who."""
        file = open(self.path, "a+b")  # noqa: SIM115  (it is open for as long as the lock is held)
        try:
            _lock(file)
        except OSError as error:
            if error.errno not in HELD:  # a file system that knows no locks
                warnings.warn(
                    f"{self.path} cannot be locked ({error.strerror}): let one process at a time write there", stacklevel=3
                )
                self._file = file
                return None
            file.seek(0)
            holder = file.read().decode(errors="replace").strip()
            file.close()
            return holder or "another process"
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
        file.flush()
        self._file = file
        return None

    def give_back(self) -> None:
        """Give the lock back; does nothing where it is not held."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _lock(file: IO[bytes]) -> None:
    try:
        import fcntl
    except ImportError:  # Windows, where what is locked cannot be read: a byte far behind the text
        import msvcrt

        file.seek(1 << 20)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        file.seek(0)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
