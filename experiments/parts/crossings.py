"""Cells of the table of public functions and commands by models: `python -m experiments.parts.crossings [MINUTES] [WORD ...]`.

Each cell runs one function on one model, one after another in one process, and is compared with another way to the same numbers,
or is refused by udkjax with a sentence. Anything else is a fault. WORD limits the table to rows and models of this name. The
study `python -m experiments crossings` computes all of it and writes its page.
"""

import re
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import udkjax as udk
from experiments.parts.crossing_case import Case, WrongError
from experiments.parts.crossing_commands import COMMANDS, RefusedError, command
from experiments.parts.crossing_functions import FUNCTIONS
from experiments.parts.crossing_models import MODELS

PACKAGE = Path(udk.__file__).parent


class Cell(NamedTuple):
    """The result of a function and a model: "runs", "refuses" or "fault", with the compared quantity or the reason."""

    function: str
    model: str
    result: str
    text: str
    seconds: float


def rows() -> list[str]:
    """Return the names of all rows."""
    functions = [f"{name} ({mode})" if mode else name for name, by_mode in FUNCTIONS.items() for mode in by_mode]
    return functions + [f"udkjax {name}" for name in COMMANDS]


def cell(row: str, case: Case) -> Cell:
    """Compute a cell."""
    start = time.process_time()
    try:
        if row.startswith("udkjax "):
            result, text = "runs", command(row.removeprefix("udkjax "), case)
        else:
            found = re.fullmatch(r"(\w+)(?: \((\w+)\))?", row)
            assert found is not None
            result, text = "runs", FUNCTIONS[found[1]][found[2] or ""](case)
    except WrongError as error:
        result, text = "fault", f"wrong: {error}"
    except RefusedError as error:
        result, text = "refuses" if len(str(error)) > 20 else "fault", str(error)
    except Exception as error:
        result = "refuses" if _is_ours(error) else "fault"
        text = f"{type(error).__name__}: {error}"
    return Cell(row, case.name, result, " ".join(text.split())[:300], time.process_time() - start)


def _is_ours(error: Exception) -> bool:
    """Return whether udkjax refuses by name: an exception of its own, or an error that a line of it raises, with a sentence."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    is_raised = (place.line or "").startswith("raise") and Path(place.filename).is_relative_to(PACKAGE)
    return (type(error).__module__.startswith("udkjax") or is_raised) and len(str(error)) > 20


def cells(minutes: float = 1e9, words: tuple[str, ...] = ()) -> Iterator[Cell]:
    """Iterate over the cells of the table, model by model, within a time."""
    end = time.time() + 60 * minutes
    for name, model in MODELS.items():
        chosen = [row for row in rows() if not words or any(word in (name, row) or word in row.split() for word in words)]
        case = Case(name, model) if chosen else None
        for row in chosen:
            if time.time() > end:
                return
            assert case is not None
            yield cell(row, case)


def summary(found: list[Cell]) -> str:
    """Return the counts of the table."""
    counts = Counter(x.result for x in found)
    size = (
        f"{len({x.function for x in found})} functions and commands, {len({x.model for x in found})} models, {len(found)} cells"
    )
    return f"{size}: {counts['runs']} run and agree, {counts['refuses']} are refused by name, {counts['fault']} faults"


def main() -> None:
    """Print each fault as it is found, then the counts."""
    warnings.simplefilter("ignore")
    arguments, found = sys.argv[1:], []
    minutes = float(arguments.pop(0)) if arguments and arguments[0].replace(".", "").isdigit() else 1e9
    for x in cells(minutes, tuple(arguments)):
        found.append(x)
        if x.result == "fault":
            print(f"{x.model} | {x.function} | {x.text}", flush=True)
    print(summary(found))


if __name__ == "__main__":
    main()
