"""Limits of the studio's input: nothing that a page or a file asks for may take this machine away from its user."""

from collections.abc import Mapping
from typing import Any

MOST_BODY_BYTES = 2_000_000  # of a request: a drawing of a thousand elements has 100 kB
MOST_TEXT_CHARACTERS = 500_000  # of a scene file
MOST_ELEMENTS = 1_000  # of a drawing; an excavator has 30, and pins are compared two by two
MOST_LISTED = 500  # files of a folder
MOST_FOLDERS_DEEP = 3  # below the one that is served
COMPILE_SECONDS = 60.0  # for reading and compiling one drawing, which takes 0.2 to 4 s where nothing else runs
DIAGNOSE_SECONDS = 120.0  # 0.1 to 8 s
EXPORT_SECONDS = 300.0  # a film is drawn frame by frame


class RefusedError(Exception):
    """A request that the studio does not serve.

    Attributes:
        status: of HTTP.
        details: further facts for the page.
    """

    def __init__(self, status: int, problem: str, **details: Any):
        super().__init__(problem)
        self.status, self.details = status, details


def count_elements(document: Mapping[str, Any]) -> int:
    """Return the number of pins and tables of a document."""
    return sum(len(value) for value in document.values() if isinstance(value, list | dict))


def require_size(text: object) -> str:
    """Return the text of a scene; raise `RefusedError` where it is none or too long."""
    if not isinstance(text, str):
        raise RefusedError(400, "text: must be a text")
    if len(text) > MOST_TEXT_CHARACTERS:
        raise RefusedError(413, f"the file has {len(text)} characters; the studio takes {MOST_TEXT_CHARACTERS}")
    return text


def require_few(document: Mapping[str, Any]) -> None:
    """Raise `RefusedError` where a document has more elements than the studio takes."""
    count = count_elements(document)
    if count > MOST_ELEMENTS:
        raise RefusedError(413, f"the drawing has {count} pins and elements; the studio takes {MOST_ELEMENTS}: use Python for it")
