"""TOML text, whatever it holds, as tables or as an error that names the mistake."""

import tomllib
from typing import Any

from udkjax.scene.checks import Mistakes


def parse_toml(text: str, source: str, error: type[Mistakes]) -> dict[str, Any]:
    """Return the tables of a text.

    Args:
        text: TOML; a byte order mark before it is passed over.
        source: The file that it stands in, or empty.
        error: The class of the error.

    Returns:
        The tables.

    Raises:
        Mistakes: `error`; the text is not TOML, nests too deeply, or holds a number of thousands of digits.
    """
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except RecursionError:
        raise error(["not valid here: lists or tables nest too deeply to be read; three levels are enough"], source) from None
    except ValueError as problem:  # not TOML, or a whole number of more digits than Python reads
        raise error([f"not valid TOML: {problem}"], source) from None


def is_xml(text: str) -> bool:
    """Return whether a text is XML rather than TOML, or the name of a file."""
    return text.removeprefix("\ufeff").lstrip().startswith("<")
