"""Fuzz: what a program does with input that nobody means, in processes of its own, which may hang or abort.

A case is a call. It may return, or raise one of the documented errors, whose message names the place; anything else is a fault:
another error, one from deep inside, a message that does not say where, a hang, an abort, a file that is not whole. Case k of a
kind is drawn from (seed, kind, k) alone, so that each can be had again: `python -m experiments.parts.fuzz KIND SEED K`.
"""

import faulthandler
import importlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

KINDS = {"files": "fuzz_files", "arguments": "fuzz_arguments", "commands": "fuzz_commands"}
LIMIT = 60.0  # s for one case, on a machine that others use, too; some compile
DOCUMENTED = (
    "SceneError",
    "SimulationError",
    "AssemblyError",
    "IdentificationError",
    "SweepError",
    "ValueError",
    "TypeError",
    "OSError",
)


class Case(NamedTuple):
    """A call, what it is about, and the names of which one must be in the message of an error (none: any will do)."""

    about: str
    call: Callable[[], Any]
    names: Sequence[str] = ()


class Fault(NamedTuple):
    """A forbidden outcome of a case: the case, its subject, the fault, and the error's text."""

    kind: str
    seed: int
    case: int
    about: str
    wrong: str
    text: str

    @property
    def signature(self) -> tuple[str, str, str]:
        """Faults of one signature are one fault."""
        return self.kind, self.about, self.wrong


def verdict(case: Case) -> tuple[str, str]:
    """Run a case; return what is wrong, empty where nothing is, and the text of the error."""
    try:
        case.call()
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        if isinstance(error, AssertionError):  # of the case itself
            return str(error).split(":")[0], text
        names = {cls.__name__ for cls in type(error).__mro__}
        if not names & set(DOCUMENTED):
            return f"{type(error).__name__} is not a documented error", text
        where = traceback.extract_tb(error.__traceback__)[-1].filename
        ours = (
            f"{os.sep}udkjax{os.sep}" in where
            or type(error).__module__.startswith("udkjax")
            or where.endswith("fuzz_arguments.py")
        )
        if not ours:
            return f"{type(error).__name__} from {Path(where).parent.name}/{Path(where).name}", text
        if case.names and not any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", str(error)) for name in case.names):
            return f"{type(error).__name__} that does not name the place", text
        return "", text
    return "", ""


def cases_of(kind: str, seed: int) -> Callable[[int], Case]:
    """Return the function that draws case k of a kind."""
    module: Any = importlib.import_module(f"experiments.parts.{KINDS[kind]}")
    number = list(KINDS).index(kind)
    return lambda k: module.draw(np.random.default_rng([seed, number, k]))


def work(kind: str, seed: int, first: int, last: int, report: Path, end: float) -> None:
    """Run cases until a time (s, of the clock); write each fault as a line of JSON, and before each case its number."""
    draw, now = cases_of(kind, seed), os.open(f"{report}.now", os.O_CREAT | os.O_WRONLY)
    os.chdir(tempfile.mkdtemp(prefix="fuzz-"))
    with report.open("a") as lines:
        for k in range(first, last):
            if time.time() > end:
                break
            os.pwrite(now, f"{k:12}".encode(), 0)
            faulthandler.dump_traceback_later(LIMIT, exit=True)
            case = draw(k)
            wrong, text = verdict(case)
            faulthandler.cancel_dump_traceback_later()
            if wrong:
                print(json.dumps([kind, seed, k, case.about, wrong, text[:300]]), file=lines, flush=True)
        else:
            k = last
    os.pwrite(now, f"{k:12}".encode(), 0)


def run(kind: str, seed: int, first: int, count: int, seconds: float) -> Iterator[tuple[int, list[Fault]]]:
    """Run cases in processes of their own, and continue after one is killed; iterate over the number done, and all faults."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-report-"))
    report, begin, last, end = folder / "faults", first, first + count, time.time() + seconds
    extra: list[Fault] = []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])}
    while first < last and time.time() < end:
        stop = min(last, first + 4_000)
        code = f"from experiments.parts.fuzz import *; work({kind!r}, {seed}, {first}, {stop}, Path({str(report)!r}), {end})"
        with (folder / "errors").open("w") as errors:
            done = subprocess.run([sys.executable, "-c", code], env=environment, stdout=subprocess.DEVNULL, stderr=errors)
        reached = int((folder / "faults.now").read_text()) if (folder / "faults.now").exists() else first
        if done.returncode:  # it hung and was ended, or aborted
            words = (folder / "errors").read_text()
            wrong = f"hangs for {LIMIT:g} s" if "Timeout" in words else f"ends the process with {done.returncode}"
            extra.append(Fault(kind, seed, reached, cases_of(kind, seed)(reached).about, wrong, words[-300:]))
            reached += 1
        first = reached
        found = [Fault(*json.loads(line)) for line in report.read_text().splitlines()] if report.exists() else []
        yield first - begin, found + extra


if __name__ == "__main__":
    chosen, given, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    one = cases_of(chosen, given)(number)
    print(one.about, one.names)
    one.call()
