"""`python -m benchmarks.peers MODULE [--smoke]`: the figures of one module, each a line of JSON."""

import argparse
import json

from benchmarks.peers import MODULES, rows

parser = argparse.ArgumentParser("python -m benchmarks.peers", description=__doc__)
parser.add_argument("module", choices=MODULES)
parser.add_argument("--smoke", action="store_true", help="run the smallest thing; measures nothing")
arguments = parser.parse_args()
for row in rows(arguments.module, arguments.smoke):
    print(json.dumps(row), flush=True)
