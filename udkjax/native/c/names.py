"""Names of places in the memory of a module, and of the fields of its call record."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass
class Names:
    """The names of places in the memory of a module, for readers: arrays by their first number, and fields of the call record."""

    places: Mapping[str, int]
    fields: Sequence[str]

    def __post_init__(self):
        self._starts = sorted((start, name) for name, start in self.places.items())

    def index(self, pointer: str, index: str) -> str:
        """Return an index, by name where a constant tells which array it is in."""
        head, plus, rest = index.rpartition(" + ")
        if not re.fullmatch(r"\d+", rest):
            return index
        number = int(rest)
        if pointer == "call" and not plus:
            return f"CALL_{identifier(self.fields[number])}" if number < len(self.fields) else index
        if pointer != "work" or not self._starts:
            return index
        start, name = max((x for x in self._starts if x[0] <= number), default=(0, ""))
        if not name:
            return index
        return f"{head}{plus}{identifier(name)}{f' + {number - start}' if number > start else ''}"

    def text(self, meanings: Mapping[str, str], used: str) -> str:
        """Return the definitions of the names that are used."""
        words = set(re.findall(r"\b[A-Z][A-Z0-9_]*\b", used))
        lines = [
            f"    {identifier(name)} = {start},{f' /* {meanings[name]} */' if name in meanings else ''}"
            for start, name in self._starts
            if identifier(name) in words
        ]
        fields = [(k, f"CALL_{identifier(name)}") for k, name in enumerate(self.fields)]
        record = [f"    {name} = {k}," for k, name in fields if name in words]
        if not lines + record:
            return ""
        comment = "/* Places of numbers in the memory of a run, and fields of its call record. */"
        return f"{comment}\nenum {{\n{chr(10).join(lines + record)}\n}};\n"


def identifier(name: str) -> str:
    """Return the name of a constant of C."""
    return re.sub(r"\W", "_", name).upper()
