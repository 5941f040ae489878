"""Folders that this process may write."""

import os
from pathlib import Path


def is_writable(folder: Path) -> bool:
    """Return whether files can be written into a folder, which is created for this user alone if necessary."""
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)
