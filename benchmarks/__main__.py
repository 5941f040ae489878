"""`python -m benchmarks NAME [--smoke] [--out FILE]`."""

import argparse
from importlib import import_module
from pathlib import Path

NAMES = ("right_hand_side", "simulate", "integrators")

parser = argparse.ArgumentParser("python -m benchmarks", description="Measure udkjax against what a user would write without it.")
parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; without one: all")
parser.add_argument("--smoke", action="store_true", help="run everything once, to see that it runs; measures nothing")
parser.add_argument("--out", type=Path, help="also write the figures to this JSON file (with several names: into this folder)")
arguments = parser.parse_args()
if unknown := set(arguments.names) - set(NAMES):
    parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
names = arguments.names or NAMES
for name in names:
    out = arguments.out
    if out and len(names) > 1:
        out.mkdir(parents=True, exist_ok=True)
        out = out / f"{name}.json"
    import_module(f"benchmarks.{name}").main(smoke=arguments.smoke, out=out)
