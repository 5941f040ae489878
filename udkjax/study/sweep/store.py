"""What a sweep has finished, on disk: whatever ends the process, what is there is whole, and what is there is not computed again.

A folder holds `sweep.json`, which says what the sweep is, and `chunks/`, one file for each chunk. A file comes into being under
its name only when all of it is on the disk, and carries its SHA-256, and that of the sweep: where `sweep.json` is damaged, the
chunks tell whether they are of the same sweep. No list says what is finished: the files are the list.
"""

import abc
import hashlib
import io
import json
import os
import socket
import struct
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from udkjax.scene.checks import abbreviate
from udkjax.study.sweep.fingerprint import Json, differences
from udkjax.study.sweep.plan import Chunk

FORMAT = 1
UNFINISHED = ".unfinished"  # what a file's name ends with while it is written
DIGEST = 64  # characters of a SHA-256
MANIFEST, CHUNKS, LOCK, WRITER = "sweep.json", "chunks", "lock", "writer"
MEMBERS, STORED = "members", "kept/"  # in a file: whom its numbers belong to, and what goes before the names of these
SWEEP = "sweep"  # in a file: the SHA-256 of what sweep.json says

Data = Mapping[str, np.ndarray]


class StoreError(OSError):
    """A sweep cannot be written where it should be, or is not the one that was begun there."""


class ChunkStore(abc.ABC):
    """What a sweep has finished. A context manager: outside of it nothing is written."""

    def __enter__(self) -> "ChunkStore":
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def read_variable(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the members that are finished, and what is stored of them under a name."""
        parts = [(members, data[name]) for members, data in self.read_chunks()] or [(np.empty(0, int), np.empty(0, int))]
        members, values = zip(*parts, strict=True)
        return np.concatenate(members), np.concatenate(values)

    @abc.abstractmethod
    def write(self, chunk: Chunk, data: Data) -> None:
        """Store what a chunk gave: one array for each name, whose first axis is the chunk's members."""

    @abc.abstractmethod
    def read_chunks(self) -> Iterator[tuple[np.ndarray, Data]]:
        """Iterate over what is finished, one chunk at a time: members, and their data."""


class MemoryStore(ChunkStore):
    """What a sweep has finished, where nothing is to outlive the process."""

    def __init__(self):
        self._done: list[tuple[np.ndarray, Data]] = []

    def write(self, chunk: Chunk, data: Data) -> None:
        self._done.append((np.asarray(chunk.members), data))

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Data]]:
        yield from self._done


class FolderStore(ChunkStore):
    """What a sweep has finished, in a folder that only one process may write to at a time.

    `fingerprint` says what decides the result. A folder in which another sweep was begun is refused, and the difference spelled
    out. Raises `StoreError`.
    """

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, Json]):
        self.folder = Path(folder)
        try:
            (self.folder / CHUNKS).mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.folder / LOCK, timeout=0)
            self._lock.acquire()
        except Timeout:  # an OSError, too
            other = self._writer()
            text = f"{self.folder} is being written to by {other}: wait for it, end it, or choose another folder"
            raise StoreError(text) from None
        except OSError as error:
            raise StoreError(_cannot_use(self.folder, error)) from error
        try:
            (self.folder / WRITER).write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
            sweep = json.loads(json.dumps({"format": FORMAT, **fingerprint}))
            self._sweep = np.frombuffer(hashlib.sha256(json.dumps(sweep, sort_keys=True).encode()).digest(), np.uint8)
            self._begin(sweep)
        except BaseException as error:
            self._lock.release()
            if isinstance(error, OSError) and not isinstance(error, StoreError):
                raise StoreError(_cannot_use(self.folder, error)) from error
            raise

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _writer(self) -> str:
        """Name the process that has the lock."""
        try:
            return (self.folder / WRITER).read_text(encoding="utf-8") or "another process"
        except OSError:  # it has only just begun
            return "another process"

    def write(self, chunk: Chunk, data: Data) -> None:
        """Write what a chunk gave, whole or not at all."""
        members = np.asarray(chunk.members)
        self._write(
            f"{CHUNKS}/{_name(chunk.index, members)}",
            pack({MEMBERS: members, SWEEP: self._sweep, **{STORED + name: values for name, values in data.items()}}),
        )

    def read_chunks(self) -> Iterator[tuple[np.ndarray, Data]]:
        """Iterate over what is finished, one file at a time: members, and their data. Damaged files are removed."""
        for file in self._files():
            data = self._read(file)
            if data is None:
                warnings.warn(f"{file} is damaged: what it held is computed again", stacklevel=2)
                file.unlink()
            else:
                stored = {name.removeprefix(STORED): values for name, values in data.items() if name.startswith(STORED)}
                yield data[MEMBERS], stored

    def _begin(self, sweep: dict[str, Json]) -> None:
        """Say what the sweep is; where something is there already, compare."""
        for file in (*self.folder.glob(f"*{UNFINISHED}"), *(self.folder / CHUNKS).glob(f"*{UNFINISHED}")):
            file.unlink(missing_ok=True)  # of a process that was killed while it wrote
        manifest = self.folder / MANIFEST
        try:
            begun = json.loads(manifest.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError, RecursionError):
            begun = None
        if isinstance(begun, dict):
            if found := differences(begun, sweep):
                lines = "\n  ".join(found)
                advice = "choose another folder, or remove this one to begin anew"
                raise StoreError(f"another sweep was begun in {self.folder}: {advice}. What differs:\n  {lines}")
            return
        others = [file.name for file in self._files() if not self._is_of_this_sweep(file)]
        if others:
            state = "damaged" if manifest.exists() else "missing"
            advice = "choose another folder, or remove this one to begin anew"
            raise StoreError(
                f"{manifest} is {state}, and chunks beside it are not of this sweep ({abbreviate(others)}): {advice}"
            )
        self._write(MANIFEST, json.dumps(sweep, indent=1).encode())

    def _is_of_this_sweep(self, file: Path) -> bool:
        """Return whether a chunk is of this sweep, or damaged and so of none."""
        data = self._read(file)
        return data is None or np.array_equal(data.get(SWEEP, ()), self._sweep)

    def _read(self, file: Path) -> dict[str, np.ndarray] | None:
        """Return what a chunk's file holds, None where it is damaged."""
        try:
            return unpack(file.read_bytes())
        except OSError as error:
            raise StoreError(f"cannot read {file}: {error.strerror or error}; make it readable, or remove it") from error

    def _files(self) -> list[Path]:
        return sorted((self.folder / CHUNKS).glob("*.npz"))

    def _write(self, name: str, content: bytes) -> None:
        try:
            write_whole(self.folder / name, content)
        except OSError as error:
            valid = f"{len(self._files())} chunks in {self.folder} are finished and stay valid"
            advice = "once it can be written to, run the same sweep again: it goes on from there"
            raise StoreError(f"cannot write {name}: {error.strerror or error}; {valid}; {advice}") from error


def open_store(out: str | os.PathLike[str] | None, fingerprint: Mapping[str, Json]) -> ChunkStore:
    """Return what stores the finished chunks: the folder `out`, or, without one, memory."""
    return MemoryStore() if out is None else FolderStore(out, fingerprint)


def _cannot_use(folder: Path, error: OSError) -> str:
    return f"cannot write to the folder {folder}: {error.strerror or error}"


def _name(index: int, members: np.ndarray) -> str:
    """Name a chunk's file by its place and by whom it holds, so that it replaces no other."""
    return f"{index:06d}-{hashlib.sha256(members.astype('<i8').tobytes()).hexdigest()[:12]}.npz"


# --- files that are whole: each is there as it was written, or it is not there


def pack(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an NPZ archive of the arrays whose comment is the SHA-256 of everything before it."""
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    body = stream.getvalue()[:-2]  # a ZIP archive ends with the length of its comment, and the comment
    return body + struct.pack("<H", DIGEST) + hashlib.sha256(body).hexdigest().encode()


def unpack(content: bytes) -> dict[str, np.ndarray] | None:
    """Return the arrays of an archive that `pack` made, or None where a bit of it is not as it was."""
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
