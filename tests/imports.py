"""Imports of a file, read from its text."""

import ast
from collections.abc import Iterator
from pathlib import Path


def imports(file: Path, package: str) -> Iterator[str]:
    """Every name that a file imports, in full, wherever in the file it does so. `package` is the one that the file is in."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{name.name}" for name in node.names)
