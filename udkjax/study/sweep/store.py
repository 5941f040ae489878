"""The finished chunks of a sweep, on disk: however a process ends, its finished chunks are whole, and are not computed again.

A folder holds `sweep.json`, which says what the sweep is, and `chunks/`, one file for each chunk. A file comes into being under
its name only when all of it is on the disk; the name ends with digests of the sweep and of the file. So where `sweep.json` is
damaged, the chunks tell whether they are of the same sweep. No list says what is finished: the files are the list.
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

from udkjax.scene.checks import abbreviate
from udkjax.study.sweep.fingerprint import JsonValue, differences, digest
from udkjax.study.sweep.plan import Chunk

FORMAT = 2  # of what a folder holds: another one is another sweep
UNFINISHED_SUFFIX = ".unfinished"  # suffix of a file while it is written
MANIFEST, CHUNKS, LOCK, WRITER = "sweep.json", "chunks", "lock", "writer"
MEMBERS, STORED_PREFIX = "members", "stored/"  # in a file: whom its numbers belong to, and what goes before the names of these
ADVICE = "choose another folder, or remove this one to begin anew"

Variables = Mapping[str, np.ndarray]


class StoreError(OSError):
    """A sweep cannot be written where it should be, or is not the one that was begun there."""


class MemoryStore:
    """The finished chunks of a sweep, where nothing is to outlive the process."""

    def __init__(self):
        self._done: list[tuple[np.ndarray, Variables]] = []

    def __enter__(self) -> "MemoryStore":
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def write(self, chunk: Chunk, data: Variables) -> None:
        """Store the results of a chunk: one array for each name, whose first axis is the chunk's members."""
        self._done.append((np.asarray(chunk.members), data))

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Variables]]:
        """Iterate over finished chunks: members, and their data."""
        yield from self._done


class FolderStore:
    """The finished chunks of a sweep, in a folder that only one process may write to at a time.

    `fingerprint` says what decides the result. A folder in which another sweep was begun is refused, and the difference spelled
    out. Raises `StoreError`.
    """

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, JsonValue]):
        self.folder = Path(folder)
        try:
            (self.folder / CHUNKS).mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.folder / LOCK, timeout=0)
            self._lock.acquire()
        except Timeout:  # an OSError, too
            text = f"{self.folder} is being written to by {self._writer()}: wait for it, end it, or choose another folder"
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
        """Write the results of a chunk, whole or not at all: one array for each name, whose first axis is the chunk's members."""
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, **{MEMBERS: chunk.members}, **{STORED_PREFIX + name: x for name, x in data.items()})
        content = stream.getvalue()
        self._write(f"{CHUNKS}/{chunk.index:06d}-{self._sweep}-{digest(content)}.npz", content)

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Variables]]:
        """Iterate over finished chunks, one file at a time: members, and their data. Damaged files are removed."""
        for file in self._files():
            try:
                content = file.read_bytes()
            except OSError as error:
                raise StoreError(f"cannot read {file}: {error.strerror or error}; make it readable, or remove it") from error
            if not file.stem.endswith(digest(content)):
                warnings.warn(f"{file} is damaged: what it held is computed again", stacklevel=2)
                file.unlink()
                continue
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                data = dict(archive)
            yield data.pop(MEMBERS), {name.removeprefix(STORED_PREFIX): values for name, values in data.items()}

    def _begin(self, sweep: dict[str, JsonValue]) -> None:
        """Write the description of the sweep; compare it with one that is there already."""
        for file in (*self.folder.glob(f"*{UNFINISHED_SUFFIX}"), *(self.folder / CHUNKS).glob(f"*{UNFINISHED_SUFFIX}")):
            file.unlink(missing_ok=True)  # of a process that was killed while it wrote
        manifest = self.folder / MANIFEST
        try:
            begun = json.loads(manifest.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError, RecursionError):
            begun = None
        if isinstance(begun, dict):
            if found := differences(begun, sweep):
                lines = "\n  ".join(found)
                raise StoreError(f"another sweep was begun in {self.folder}: {ADVICE}. What differs:\n  {lines}")
            return
        if others := [file.name for file in self._files() if f"-{self._sweep}-" not in file.name]:
            state = "damaged" if manifest.exists() else "missing"
            raise StoreError(
                f"{manifest} is {state}, and chunks beside it are not of this sweep ({abbreviate(others)}): {ADVICE}"
            )
        self._write(MANIFEST, json.dumps(sweep, indent=1).encode())

    def _writer(self) -> str:
        """Name the process that has the lock."""
        try:
            return (self.folder / WRITER).read_text(encoding="utf-8") or "another process"
        except OSError:  # it has only just begun
            return "another process"

    def _files(self) -> list[Path]:
        return sorted((self.folder / CHUNKS).glob("*.npz"))

    def _write(self, name: str, content: bytes) -> None:
        try:
            write_whole(self.folder / name, content)
        except OSError as error:
            valid = f"{len(self._files())} chunks in {self.folder} are finished and stay valid"
            advice = "once it can be written to, run the same sweep again: it goes on from there"
            raise StoreError(f"cannot write {name}: {error.strerror or error}; {valid}; {advice}") from error


def open_store(out: str | os.PathLike[str] | None, fingerprint: Mapping[str, JsonValue]) -> MemoryStore | FolderStore:
    """Return the store of finished chunks: the folder `out`, or, without one, memory."""
    return MemoryStore() if out is None else FolderStore(out, fingerprint)


def read_variable(store: MemoryStore | FolderStore, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the members that are finished, and what is stored of them under a name."""
    parts = [(members, data[name]) for members, data in store.read_chunks()] or [(np.empty(0, int), np.empty(0, int))]
    members, values = zip(*parts, strict=True)
    return np.concatenate(members), np.concatenate(values)


def _cannot_use(folder: Path, error: OSError) -> str:
    return f"cannot write to the folder {folder}: {error.strerror or error}"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that, whenever the process or the machine stops, it is there as it was before, or all of it is."""
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
    if hasattr(os, "O_DIRECTORY"):  # where folders can be opened, their entries have to reach the disk too
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
