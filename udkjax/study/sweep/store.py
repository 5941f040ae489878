"""The finished chunks of a sweep, or of chains of samples, on disk, which survive a crash and are not computed again.

A folder contains `sweep.json`, the fingerprint of the sweep, and `chunks/`, with one file per chunk. A file gets its name only
when it is completely on the disk. The name ends with digests of the sweep and of the file; they identify chunks even if
`sweep.json` is damaged. There is no separate list of finished chunks.
"""

import io
import json
import os
import socket
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from udkjax.study.sweep.fingerprint import JsonValue, differences, digest
from udkjax.study.sweep.plan import Chunk
from udkjax.wording import abbreviate

FORMAT = 2  # format of the folder; a folder with another format counts as another sweep
UNFINISHED_SUFFIX = ".unfinished"  # suffix of files that are not complete
CHUNKS, LOCK, WRITER = "chunks", "lock", "writer"
MEMBERS, STORED_PREFIX = "members", "stored/"  # names in a file: that of the members' indices, and the prefix of stored variables
ADVICE = "choose another folder, or remove this one to start over"

Variables = Mapping[str, np.ndarray]


class StoreError(OSError):
    """A folder cannot be written to, or contains another sweep."""


class MemoryStore:
    """The finished chunks of a sweep in memory."""

    def __init__(self):
        self._done: list[tuple[np.ndarray, Variables]] = []

    def __enter__(self) -> "MemoryStore":
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def write(self, chunk: Chunk, data: Variables) -> None:
        """Store the variables of a chunk: arrays by name, whose first axis is the chunk's members."""
        self._done.append((np.asarray(chunk.members), data))

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Variables]]:
        """Iterate over finished chunks: the indices of members, and their data."""
        yield from self._done


class FolderStore:
    """The finished chunks of a sweep in a folder. Only one process at a time may write to it.

    `fingerprint` contains all inputs that determine the results. A folder with another sweep is refused, with a list of the
    differences. `what` is the kind of the computation, which messages name.

    Raises:
        StoreError: the folder cannot be used.
    """

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, JsonValue], what: str = "sweep"):
        self.folder, self.what = Path(folder), what
        try:
            (self.folder / CHUNKS).mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.folder / LOCK, timeout=0)
            self._lock.acquire()
        except Timeout:  # Timeout is an OSError
            text = f"{self._writer()} is writing to {self.folder}: wait for it, end it, or choose another folder"
            raise StoreError(text) from None
        except OSError as error:
            raise StoreError(_cannot_use(self.folder, error)) from error
        try:
            (self.folder / WRITER).write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
            sweep = json.loads(json.dumps({"format": FORMAT, **fingerprint}))
            self._sweep = digest(json.dumps(sweep, sort_keys=True).encode())
            self._begin(sweep)
        except BaseException as error:
            self._lock.release()
            if isinstance(error, OSError) and not isinstance(error, StoreError):
                raise StoreError(_cannot_use(self.folder, error)) from error
            raise

    def __enter__(self) -> "FolderStore":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def write(self, chunk: Chunk, data: Variables) -> None:
        """Write the variables of a chunk atomically: arrays by name; in a sweep, their first axis is the chunk's members."""
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **{MEMBERS: chunk.members}, **{STORED_PREFIX + name: x for name, x in data.items()})
        content = stream.getvalue()
        self._write(f"{CHUNKS}/{chunk.index:06d}-{self._sweep}-{digest(content)}.npz", content)

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Variables]]:
        """Iterate over finished chunks: the indices of members, and their data. Damaged files are removed."""
        for file in self._files():
            try:
                content = file.read_bytes()
            except OSError as error:
                raise StoreError(f"cannot read {file}: {error.strerror or error}; make it readable, or remove it") from error
            if not file.stem.endswith(digest(content)):
                warnings.warn(f"{file} is damaged: it is computed again", stacklevel=2)
                file.unlink()
                continue
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                data = dict(archive)
            yield data.pop(MEMBERS), {name.removeprefix(STORED_PREFIX): values for name, values in data.items()}

    def _begin(self, sweep: dict[str, JsonValue]) -> None:
        """Write the fingerprint of the sweep, or compare it with that of the folder if this has finished chunks.

        Raises:
            StoreError: the folder contains another computation.
        """
        for file in (*self.folder.glob(f"*{UNFINISHED_SUFFIX}"), *(self.folder / CHUNKS).glob(f"*{UNFINISHED_SUFFIX}")):
            file.unlink(missing_ok=True)  # file of a process that was killed while writing
        manifest = self.folder / f"{self.what}.json"
        try:
            begun = json.loads(manifest.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError, RecursionError):
            begun = None
        if isinstance(begun, dict) and (not (found := differences(begun, sweep)) or self._files()):
            if found:
                lines = "\n  ".join(found)
                raise StoreError(f"{self.folder} contains another {self.what}: {ADVICE}. Differences:\n  {lines}")
            return
        if others := [file.name for file in self._files() if f"-{self._sweep}-" not in file.name]:
            state = "damaged" if manifest.exists() else "missing"
            raise StoreError(
                f"{manifest} is {state}, and the folder contains chunks of another {self.what} ({abbreviate(others)}): {ADVICE}"
            )
        self._write(manifest.name, json.dumps(sweep, indent=1).encode())

    def _writer(self) -> str:
        """Return the name of the process that has the lock."""
        try:
            return (self.folder / WRITER).read_text(encoding="utf-8") or "another process"
        except OSError:  # not written yet
            return "another process"

    def _files(self) -> list[Path]:
        return sorted((self.folder / CHUNKS).glob("*.npz"))

    def _write(self, name: str, content: bytes) -> None:
        try:
            write_whole(self.folder / name, content)
        except OSError as error:
            valid = f"the {len(self._files())} finished chunks in {self.folder} stay valid"
            advice = f"once the folder can be written to, run the same {self.what} again to continue"
            raise StoreError(f"cannot write {name}: {error.strerror or error}; {valid}; {advice}") from error


def open_store(
    out: str | os.PathLike[str] | None, fingerprint: Mapping[str, JsonValue], what: str = "sweep"
) -> MemoryStore | FolderStore:
    """Return the store of finished chunks: the folder `out`, or memory if it is None."""
    return MemoryStore() if out is None else FolderStore(out, fingerprint, what)


def read_variable(store: MemoryStore | FolderStore, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the finished members, and their values of one stored variable."""
    chunks = [(members, data[name]) for members, data in store.read_chunks()] or [(np.empty(0, int), np.empty(0, int))]
    members, values = zip(*chunks, strict=True)
    return np.concatenate(members), np.concatenate(values)


def _cannot_use(folder: Path, error: OSError) -> str:
    return f"cannot write to the folder {folder}: {error.strerror or error}"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: if the process or the machine stops, either the old or the complete new file is on the disk."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}{UNFINISHED_SUFFIX}")
    try:
        with open(unfinished, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    if hasattr(os, "O_DIRECTORY"):  # the folder's entry must also reach the disk
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
