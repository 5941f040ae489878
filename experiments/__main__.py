"""`python -m experiments NAME ... [--smoke] [--redraw] [--out DIR] [--set CHOICE=NUMBER]`."""

import argparse
from pathlib import Path

from experiments.common import NAMES, redraw, run


def main() -> None:
    """Run or redraw the studies that the command line names."""
    parser = argparse.ArgumentParser(
        "python -m experiments", description="Compute a claim's data, then draw its figure from them."
    )
    parser.add_argument("names", nargs="+", metavar="NAME", help=f"of {', '.join(NAMES)}; or all")
    parser.add_argument("--smoke", action="store_true", help="the same in small, in seconds; writes to a temporary folder")
    parser.add_argument("--redraw", action="store_true", help="compute nothing: draw the figure anew from the data file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write DIR/NAME.nc and DIR/NAME.png, not the committed files")
    parser.add_argument(
        "--set", action="append", default=[], metavar="CHOICE=NUMBER", help="a choice of the study's own, if it has any"
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - {*NAMES, "all"}:
        parser.error(f"no study {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    choices = {
        key: float(value) if "." in value else int(value) for key, _, value in (text.partition("=") for text in arguments.set)
    }
    for name in NAMES if "all" in arguments.names else arguments.names:
        if arguments.redraw:
            redraw(name, arguments.out)
        else:
            run(name, arguments.smoke, arguments.out, **choices)


if __name__ == "__main__":  # also imported by processes of a study
    main()
