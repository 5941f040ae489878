"""`python -m benchmarks [NAME ...] [--smoke] [--out FOLDER]`."""

import argparse
import json
import os
from importlib import import_module
from pathlib import Path

NAMES = (
    "right_hand_side",
    "methods",
    "integrators",
    "trajectory",
    "batch",
    "gradients",
    "stiff",
    "friction",
    "events",
    "systems",
    "mechanisms",
    "startup",
    "waiting",
    "scaling",
    "sweep",
    "identification",
    "uniqueness",
    "live",
    "export",
    "gpu",
    "peers",
)


def main(words: list[str] | None = None) -> None:
    """Run the benchmarks, then compare all figures, including earlier ones in the folder, with the promised targets."""
    parser = argparse.ArgumentParser("python -m benchmarks", description="Measure udkjax against what would be used without it.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; without one: all")
    parser.add_argument("--smoke", action="store_true", help="run everything once, tiny, to see that it runs; measures nothing")
    parser.add_argument("--out", type=Path, help="folder for the figures (NAME.json, table.json) and the page (index.html)")
    arguments = parser.parse_args(words)
    if unknown := set(arguments.names) - set(NAMES):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")

    from benchmarks import native, page, peers, table
    from benchmarks.common import machine, write

    out, figures = arguments.out, {}
    if out:
        out.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        file = out / f"{name}.json" if out else None
        if name in (arguments.names or NAMES):
            about = machine()
            print(f"\n--- {name}\n{'; '.join(f'{k} {v}' for k, v in about.items())}")
            figures[name] = import_module(f"benchmarks.{name}").main(smoke=arguments.smoke)
            if file:
                write(about, figures[name], file)
        elif file and file.exists():
            figures[name] = json.loads(file.read_text())["figures"]
    about, judged = machine(), table.judge(figures)
    table.show(judged)
    if out:
        write(about, judged, out / "table.json")
        missing = [name for name in NAMES if name not in figures]
        missing += ["C++ (no compiler)"] if native.program() is None else []
        missing += [f"{package} (not installed)" for package in peers.missing()]
        page.write(figures, judged, about, missing, out / "index.html")


if __name__ == "__main__":
    os.environ["UDKJAX_CACHE"] = "0"  # otherwise programs compiled earlier would be found; `startup` measures that separately
    main()
