"""What a run of tests skipped, and what would bring it."""

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any

# What installs a package that tests import, by the option of install.sh.
OPTIONS = {
    "--test": ("wasmtime", "mujoco"),
    "--fmi": ("fmpy", "ziglang"),
    "--notebook": ("nbformat", "nbconvert", "ipykernel", "IPython"),
}


def skipped_for(reports: Iterable[Any]) -> list[str]:
    """Return a line for each reason, the most frequent first: the number of tests, or of files none of whose tests were found."""
    counts = Counter((reason_of(report), "file" if report.nodeid.endswith(".py") else "test") for report in reports)
    return [f"{count} {kind}{'s'[: count > 1]} skipped: {reason}" for (reason, kind), count in counts.most_common()]


def reason_of(report: Any) -> str:
    """Return the reason of a skipped test; that of a missing package with the command that installs it."""
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple | list) else str(report.longrepr)
    reason = reason.removeprefix("Skipped: ")
    missing = re.match(r"could not import '(\w+)[\w.]*'", reason)
    if missing is None:
        return reason
    cures = [f": sh install.sh --test {option}" for option, names in OPTIONS.items() if missing[1] in names]
    return f"{missing[1]} is not installed{''.join(cures).replace('--test --test', '--test')}"
