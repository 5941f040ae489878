"""Files of one folder: listed, read, and written atomically, never over a file that has changed on disk in the meantime."""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from udkjax.studio.limits import MOST_FOLDERS_DEEP, MOST_LISTED, MOST_TEXT_CHARACTERS, RefusedError

SCENE_SUFFIX = ".toml"
MOST_CHARACTERS_OF_A_PATH = 200  # file systems allow 255 per name


class Folder:
    """The folder in which the studio was started. No path leads out of it, neither through `..` nor through a symbolic link.

    Args:
        root: the folder.
    """

    def __init__(self, root: Path):
        self.root = root.resolve(strict=True)

    def list(self) -> list[str]:
        """Return the scene files below the folder in alphabetical order, at most `MOST_LISTED`."""
        return sorted(self._walk(self.root, MOST_FOLDERS_DEEP))

    def _walk(self, folder: Path, deep: int) -> Iterator[str]:
        count = 0
        with contextlib.suppress(OSError):
            for entry in sorted(os.scandir(folder), key=lambda e: e.name):
                if entry.name.startswith(".") or entry.is_symlink():
                    continue
                if entry.is_dir(follow_symlinks=False) and deep > 1 and not (Path(entry.path) / "pyvenv.cfg").exists():
                    names = self._walk(Path(entry.path), deep - 1)
                elif entry.is_file(follow_symlinks=False) and entry.name.endswith(SCENE_SUFFIX):
                    names = iter([Path(entry.path).relative_to(self.root).as_posix()])
                else:
                    continue
                for name in names:
                    count += 1
                    if count > MOST_LISTED:
                        return
                    yield name

    def locate(self, name: object, suffixes: tuple[str, ...]) -> Path:
        """Return the file of a relative path, which need not exist.

        Raises:
            RefusedError: the path is not that of a file inside the folder, has another suffix, or its subfolder does not exist.
        """
        if not isinstance(name, str) or not 0 < len(name) <= MOST_CHARACTERS_OF_A_PATH:
            raise RefusedError(400, "path: must be the path of a file in the studio's folder")
        parts = PurePosixPath(name).parts
        is_invalid = any(not character.isprintable() or character in '\\:*?"<>|' for character in name)
        if is_invalid or name.startswith("/") or any(part.startswith(".") for part in parts):
            raise RefusedError(400, f"path: {name!r} is not a plain path in the studio's folder")
        if not name.lower().endswith(suffixes):
            raise RefusedError(400, f"path: {name!r} must end in {' or '.join(suffixes)}")
        path = self.root.joinpath(*parts)
        try:
            inside = path.parent.resolve(strict=True).is_relative_to(self.root)
        except OSError:
            raise RefusedError(404, f"there is no folder {PurePosixPath(*parts[:-1]).as_posix()!r}") from None
        if not inside or path.is_symlink() or (path.exists() and not path.is_file()):
            raise RefusedError(403, f"path: {name!r} leads out of the studio's folder, or is not a regular file")
        return path

    def read(self, name: object) -> tuple[str, str]:
        """Return the text and the revision of a scene file; raise `RefusedError` if it cannot be read or is too long."""
        path = self.locate(name, (SCENE_SUFFIX,))
        try:
            if path.stat().st_size > 4 * MOST_TEXT_CHARACTERS:
                raise RefusedError(413, f"{name} is longer than the studio's limit of {MOST_TEXT_CHARACTERS} characters")
            data = path.read_bytes()
            return data.decode("utf-8"), revision_of(data)
        except UnicodeDecodeError as error:
            raise RefusedError(422, f"{name} is not a text file in UTF-8 ({error})") from None
        except OSError as error:
            raise RefusedError(404, f"cannot read {name}: {error.strerror}") from None

    def write(self, name: object, data: bytes, revision: str | None, suffixes: tuple[str, ...] = (SCENE_SUFFIX,)) -> str:
        """Write a file atomically, and return its new revision.

        Args:
            name: path of the file.
            data: content of the file.
            revision: revision expected on disk; None if no such file is expected.
            suffixes: allowed file name suffixes.

        Raises:
            RefusedError: the file on disk has another revision (status 409, with that revision), or it cannot be written.
        """
        path = self.locate(name, suffixes)
        present = revision_of(path.read_bytes()) if path.exists() else None
        if present != revision:
            change = "has been deleted" if present is None else "has been created or changed by another program"
            raise RefusedError(409, f"{name} {change} since it was opened here", revision=present)
        try:
            handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".studio-")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                if present is None:
                    os.chmod(temporary, 0o666 & ~_umask())
                    os.link(temporary, path)  # fails if the file exists by now
                else:
                    os.chmod(temporary, path.stat().st_mode & 0o7777)
                    os.replace(temporary, path)
            finally:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(temporary)
        except FileExistsError:
            raise RefusedError(409, f"{name} has just been created by another program", revision=None) from None
        except OSError as error:
            raise RefusedError(500, f"cannot write {name}: {error.strerror}") from None
        return revision_of(data)


def revision_of(data: bytes) -> str:
    """Return the digest that identifies the content of a file."""
    return hashlib.sha256(data).hexdigest()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
