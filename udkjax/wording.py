"""Names, values and counts in the sentences of errors, reports and pages."""

import difflib
from collections.abc import Container, Iterable, Sequence

from jax.core import Tracer

LONGEST_QUOTE = 60  # characters of a value or a name in a message
MOST_LISTED = 8  # names listed in one sentence


def suggestion(name: object, choices: Iterable[str]) -> str:
    """Return '; did you mean "..."?' with the choice that is most similar to a name; "" if none is similar."""
    if not isinstance(name, str):
        return ""
    lowered = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(name.lower(), lowered, n=1)
    return f"; did you mean {quote(lowered[close[0]])}?" if close else ""


def unknown_key(key: object, expected: Iterable[str]) -> str:
    """Return the message for an unknown key, with the most similar expected key, or else all of them."""
    known = tuple(expected)
    return "unknown key" + (suggestion(key, known) or f"; known are {', '.join(known)}")


def quote(name: str) -> str:
    """Return a name in double quotes, with unprintable characters escaped as in TOML."""
    escaped = name.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def abbreviate(value: object) -> str:
    """Return a value as text for a message, written as in a TOML file, of at most `LONGEST_QUOTE` characters."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return quote(value if len(value) <= LONGEST_QUOTE else value[: LONGEST_QUOTE - 3] + "...")
    if isinstance(value, list | tuple):
        text = f"[{', '.join(map(abbreviate, value))}]"
    else:
        text = f"shape {value.shape}" if isinstance(value, Tracer) else str(getattr(value, "tolist", lambda: value)())
    return text if len(text) <= LONGEST_QUOTE else text[: LONGEST_QUOTE - 3] + "..."


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural if needed."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def join_names(names: Sequence[str]) -> str:
    """Join names for a sentence: "a, b and c"; of more than `MOST_LISTED` names, the others are only counted."""
    if len(names) > MOST_LISTED:
        return f"{', '.join(names[:MOST_LISTED])} and {len(names) - MOST_LISTED} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def article(noun: str) -> str:
    """Return "a" or "an", as required by a noun."""
    return "an" if noun[0].lower() in "aeiou" else "a"


def numbered(title: str, texts: Sequence[str]) -> dict[str, str]:
    """Return texts by title; if there are several, the titles are numbered: "title 1", "title 2"."""
    return {title if len(texts) == 1 else f"{title} {k + 1}": text for k, text in enumerate(texts)}


def free_name(name: str, taken: Container[str]) -> str:
    """Return a free name: `name` with as many primes as needed."""
    while name in taken:
        name += "'"
    return name
