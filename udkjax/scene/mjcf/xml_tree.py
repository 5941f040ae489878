"""XML with line numbers, and attributes read as numbers; mistakes are collected, not raised."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.parsers import expat

import numpy as np

from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate, quote, suggestion

MOST_INCLUDED = 100_000  # elements of included files, each counted as often as it is included, 0.5 s of reading
MOST_LEVELS = 50  # of files that include each other


class XmlElement:
    """An element: its tag, attributes, children, its first line, and the name of the included file that contains it, if any."""

    def __init__(self, tag: str, attributes: Mapping[str, str], line: int, file: str = ""):
        self.tag, self.attributes, self.line, self.file = tag, attributes, line, file
        self.children: list[XmlElement] = []

    @property
    def where(self) -> str:
        """The element and its line, for error messages."""
        name = self.attributes.get("name", "")
        return f"<{self.tag}> {f'{quote(name)} ' if name else ''}(line {self.line}{f' of {self.file}' if self.file else ''})"

    def walk(self) -> Iterator[tuple["XmlElement", "XmlElement"]]:
        """Iterate over all elements below this one, in order, each with its parent."""
        pending: list[tuple[XmlElement, XmlElement]] = [(child, self) for child in reversed(self.children)]
        while pending:
            element, parent = pending.pop()
            yield element, parent
            pending.extend((child, element) for child in reversed(element.children))


class _Included:
    """The files included so far: their texts, and the number of elements in all."""

    def __init__(self):
        self.texts: dict[str, str] = {}
        self.elements = 0


def parse_xml(
    text: str, source: str, file: str = "", within: tuple[str, ...] = (), included: _Included | None = None
) -> XmlElement:
    """Return the root element of a text, with each <include> replaced by the content of the file.

    Args:
        text: XML; a leading byte order mark is skipped.
        source: The file of the model, whose folder contains included files; or empty.
        file: The name of the included file whose text this is; empty for the model itself.
        within: The names of the files that are being included, outermost first; the last one is `file`.
        included: The files included so far.

    Raises:
        SceneError: The text is not XML, or a file cannot be included.
    """
    included = included or _Included()
    parser, roots, opened = expat.ParserCreate(), [], []

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = XmlElement(tag, attributes, parser.CurrentLineNumber, file)
        (opened[-1].children if opened else roots).append(element)
        opened.append(element)

    parser.StartElementHandler, parser.EndElementHandler = start, lambda tag: opened.pop()
    try:
        parser.Parse(text.removeprefix("\ufeff"), True)
    except expat.ExpatError as error:
        raise SceneError([f"{f'{file}: ' if file else ''}not valid XML: {error}"], source) from None
    for parent in [roots[0], *(element for element, _ in roots[0].walk())]:
        if any(child.tag == "include" for child in parent.children):
            replacements = [_include(c, source, within, included) if c.tag == "include" else [c] for c in parent.children]
            parent.children = [child for elements in replacements for child in elements]
    return roots[0]


def _include(element: XmlElement, source: str, within: tuple[str, ...], included: _Included) -> list[XmlElement]:
    """Return the elements of the file that an <include> names."""
    name = element.attributes.get("file", "")
    try:
        if not source or name in within:
            why = "it includes itself" if source else "a string has no folder to find it in: read the model from its file"
            raise SceneError([f"{element.where}: file={quote(name)} cannot be included: {why}"], source)
        if len(within) >= MOST_LEVELS:
            raise SceneError([f"{element.where}: files include each other on more than {MOST_LEVELS} levels"], source)
        if name not in included.texts:
            included.texts[name] = (Path(source).parent / name).read_text(encoding="utf-8")
        text = included.texts[name]
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError([f"{element.where}: file={quote(name)} cannot be read: {error}"], source) from None
    included.elements += max(text.count("<"), 1)
    if included.elements > MOST_INCLUDED:
        problem = f"files included again and again have more than {MOST_INCLUDED:,} elements: include each of them once"
        raise SceneError([f"{element.where}: {problem}"], source)
    return parse_xml(text, source, name, (*within, name), included).children


class AttributeReader:
    """The attributes of one element, including defaults; mistakes are added to `problems`."""

    def __init__(self, element: XmlElement, values: Mapping[str, str], problems: list[str]):
        self.element, self.values, self._problems = element, values, problems

    def refuse(self, text: str) -> None:
        """Add a message about this element to the mistakes."""
        self._problems.append(f"{self.element.where}: {text}")

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def text(self, name: str, default: str = "") -> str:
        """Return an attribute as text; `default` if it is absent."""
        return self.values.get(name, default)

    def choice(self, name: str, choices: Sequence[str], default: str) -> str:
        """Return an attribute that is one of the choices; `default` if it is absent or, with a mistake, if it is none of them."""
        value = self.values.get(name, default)
        if value in choices:
            return value
        self.refuse(f"{name}={quote(value)} must be one of {', '.join(choices)}{suggestion(value, choices)}")
        return default

    def numbers(self, name: str, default: Sequence[float] | np.ndarray, fewest: int | None = None) -> np.ndarray:
        """Return an attribute as finite numbers, as many as `default` has.

        If at least `fewest` are given, `default` supplies the rest. It is returned if the attribute is absent or, with a mistake,
        if it is wrong.
        """
        if name not in self.values:
            return np.array(default, float)
        words = self.values[name].split()
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([np.nan])
        most_allowed, fewest_allowed = len(default), len(default) if fewest is None else fewest
        if np.all(np.isfinite(values)) and fewest_allowed <= len(values) <= most_allowed:
            return np.concatenate([values, np.array(default[len(values) :], float)])
        wanted = f"{fewest_allowed} to {most_allowed}" if fewest_allowed < most_allowed else f"{most_allowed}"
        self.refuse(f"{name}={abbreviate(self.values[name])} must be {wanted} finite number{'s' * (most_allowed > 1)}")
        return np.array(default, float)

    def number(self, name: str, default: float = 0.0) -> float:
        """Return an attribute that is a single number; `default` if it is absent or, with a mistake, if it is wrong."""
        return float(self.numbers(name, [default])[0])
