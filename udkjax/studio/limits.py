"""Limits of the studio's input, so that no page and no file can overload the machine."""

from collections.abc import Mapping
from typing import Any

MOST_BODY_BYTES = 2_000_000  # of a request; a drawing of a thousand elements has 100 kB
MOST_TEXT_CHARACTERS = 500_000  # of a scene file
MOST_ADDRESS_CHARACTERS = 8_000  # of a shared drawing: a command line of Windows takes 8,191; templates have 300 to 700
MOST_ELEMENTS = 1_000  # of a drawing; an excavator has 30, and pins are compared in pairs
MOST_LISTED = 500  # files of a folder
MOST_FOLDERS_DEEP = 3  # levels below the served folder
COMPILE_SECONDS = 60.0  # to read and compile a drawing, which takes 0.2 to 4 s on an idle machine
DIAGNOSE_SECONDS = 120.0  # to diagnose a drawing, which takes 0.1 to 8 s
EXPORT_SECONDS = 300.0  # to export a drawing: films are drawn frame by frame


class RefusedError(Exception):
    """A request that the studio refuses.

    Attributes:
        status: HTTP status of the answer.
        details: further facts for the page.
    """

    def __init__(self, status: int, problem: str, **details: Any):
        super().__init__(problem)
        self.status, self.details = status, details


def count_elements(document: Mapping[str, Any]) -> int:
    """Return the number of pins and other entries in all tables and lists of a document."""
    return sum(len(value) for value in document.values() if isinstance(value, list | dict))


def require_size(text: object) -> str:
    """Return the text of a scene; raise `RefusedError` if it is not a string or too long."""
    if not isinstance(text, str):
        raise RefusedError(400, "text: must be a string")
    if len(text) > MOST_TEXT_CHARACTERS:
        raise RefusedError(413, f"the file has {len(text)} characters; the studio's limit is {MOST_TEXT_CHARACTERS}")
    return text


def require_few(document: Mapping[str, Any]) -> None:
    """Raise `RefusedError` if a document has more elements than the studio allows."""
    count = count_elements(document)
    if count > MOST_ELEMENTS:
        raise RefusedError(413, f"the drawing has {count} pins and elements; the studio's limit is {MOST_ELEMENTS}: use Python")
