"""Make the gallery: for each example its player (.html), a picture of its motion and its plots (.png), and a page of them all.

    python -m examples.gallery [NAME ...] [--out docs/gallery]

Each example is a script that one can read and run by itself: `python examples/gallery/peaucellier.py`.
"""

import argparse
import html
import time
from importlib import import_module
from pathlib import Path

NAMES = (
    "five_bar",
    "excavator",
    "jansen_leg",
    "peaucellier",
    "scissor_lift",
    "dwell_cam",
    "planetary_gear",
    "identification",
    "double_pendulum_map",
    "neural_friction",
)
WIDTH = 720  # px, of pictures
DPI = 96  # of plots
MOMENT = 0.3  # of the motion: when its picture is taken


def make(name: str, out: Path) -> dict:
    """Make one example, write its files, and return its title, its words, its facts and the names of its files."""
    module = import_module(f"examples.gallery.{name}")
    start = time.perf_counter()
    facts, shown = module.make()
    files = []
    for what, thing in shown.items():
        if what == "motion":
            thing.save(out / f"{name}.html")
            span = thing.data["end"] - thing.data["start"]
            moment = getattr(module, "MOMENT", MOMENT)
            picture = thing.save(out / f"{name}.png", thing.data["start"] + moment * span, width=WIDTH)
        else:
            picture = out / f"{name}_{what}.png"
            thing.savefig(picture, dpi=DPI)
        _shrink(picture)
        files.append(picture.name)
    title, _, words = module.__doc__.strip().partition("\n")
    return {
        "name": name,
        "title": title,
        "words": words.strip(),
        "facts": facts,
        "files": files,
        "seconds": time.perf_counter() - start,
    }


def _shrink(picture: Path) -> None:
    """Give a picture the few colours that it has, and a third of its size."""
    from PIL import Image

    Image.open(picture).convert("RGB").quantize(96).save(picture, optimize=True)


def page(examples: list[dict]) -> str:
    """Return the page of the gallery in Markdown, with the players that lie beside it."""
    lines = [
        "# Gallery",
        "",
        "Each picture opens a player. `python -m examples.gallery` makes them all; the scripts are in `examples/gallery`.",
        "",
    ]
    for example in examples:
        name = example["name"]
        facts = [f"- {html.escape(words)}: {value:.4g}" for words, value in example["facts"].items()]
        motion, *others = example["files"]
        lines += [f"## {example['title']}", "", example["words"], "", f"[![{name}]({motion})]({name}.html)", ""]
        lines += [f"![{name}: {file}]({file})" for file in others]
        lines += ["", *facts, "", f"Script: `examples/gallery/{name}.py`", ""]
    return "\n".join(lines)


def main() -> None:
    """Make what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m examples.gallery", description="Make the gallery.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; by default all")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), help="folder to write to")
    given = parser.parse_args()
    unknown = [name for name in given.names if name not in NAMES]
    if unknown:
        parser.error(f"there is no example {unknown[0]}")
    given.out.mkdir(parents=True, exist_ok=True)
    found = []
    for name in given.names or NAMES:
        found.append(make(name, given.out))
        print(
            f"{name}: {found[-1]['seconds']:.1f} s",
            *(f"    {words}: {value:.4g}" for words, value in found[-1]["facts"].items()),
            sep="\n",
        )
    if not given.names:
        (given.out / "index.md").write_text(page(found), encoding="utf-8")


if __name__ == "__main__":
    main()
