"""Folders that this process may write, and those that it may trust."""

import os
import stat
from pathlib import Path


def is_writable(folder: Path) -> bool:
    """Return whether files can be written into a folder, which is created for this user alone if necessary."""
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def refusal(folder: Path) -> str | None:
    """Return why code in a folder must not be executed; None if it may be, or if there is no such folder."""
    try:
        return distrust(folder.stat())
    except OSError:
        return None


def distrust(status: os.stat_result) -> str | None:
    """Return why other users may have written a file or folder; None if they cannot."""
    if not hasattr(os, "getuid"):  # Windows: the user's own folders are closed to others by default
        return None
    if status.st_uid not in (os.getuid(), 0):
        return "it belongs to another user"
    return "others may write to it" if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) else None
