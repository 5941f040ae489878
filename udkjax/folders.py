"""Checks of folders: write access of this process, and protection against other users."""

import os
import stat
from pathlib import Path


def is_writable(folder: Path) -> bool:
    """Return True if this process can write files into a folder; a missing folder is created first, for this user alone."""
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def refusal(folder: Path) -> str | None:
    """Return the reason not to execute code in a folder, as a clause for messages; None if there is none, or no such folder."""
    try:
        return distrust(folder.stat())
    except OSError:
        return None


def distrust(status: os.stat_result) -> str | None:
    """Return the reason to assume that another user may have written a file or folder with this status, as a clause for messages.

    Return None if only this user and root can write it, and always on Windows.
    """
    if not hasattr(os, "getuid"):  # Windows: the user's own folders are closed to others by default
        return None
    if status.st_uid not in (os.getuid(), 0):
        return "it belongs to another user"
    return "others may write to it" if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) else None
