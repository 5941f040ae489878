"""Names of places in the memory of a module, and of the fields of its call record."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass
class Names:
    """The names that indices in the memory of a run and in its call record have in C, for readers.

    Attributes:
        places: The index of the first number of each array in the memory.
        fields: The names of the fields of the call record, in their order.
    """

    places: Mapping[str, int]
    fields: Sequence[str]

    def __post_init__(self):
        self._starts = sorted((start, name) for name, start in self.places.items())

    def index(self, pointer: str, index: str) -> str:
        """Return the expression of an index at a pointer, in which the constant that selects an array or a field has a name."""
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
        """Return C definitions of the names that the text `used` contains, with `meanings` as comments; "" if there are none."""
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
    """Return the name in C of the constant for an array or a field."""
    return re.sub(r"\W", "_", name).upper()
