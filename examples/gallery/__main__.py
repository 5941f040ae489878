"""Make the gallery: players (.html, with one player.js), pictures (.png), a film (.gif), and a page of them all.

    python -m examples.gallery [NAME ...] [--out docs/gallery]

Each example is a script to read and run by itself: `python examples/gallery/peaucellier.py`. The others are drawings,
files of at most 25 lines: `udkjax animate examples/drawings/door_closer.toml`.
"""

import argparse
import html
import re
import time
from importlib import import_module
from pathlib import Path

NAMES = (
    "four_bar",
    "five_bar",
    "parallelogram",
    "excavator",
    "jansen_leg",
    "peaucellier",
    "scissor_lift",
    "dwell_cam",
    "planetary_gear",
    "hammer",
    "toggle_clamp",
    "woodpecker",
    "rod_on_floor",
    "identification",
    "double_pendulum_map",
    "neural_friction",
    "designed_paths",
    "six_bar_dwell",
)
DRAWINGS = {"toggle_press": 1.0, "quick_return": 2.0, "cam_follower": 0.5, "door_closer": 6.0, "scissor_lift_spring": 2.0}  # s
PLAYER = "player.js"  # the script of all pages
FRAMES = 121  # of their players
WIDTH = 720  # px, of pictures
DPI = 96  # of plots
MOMENT = 0.3  # fraction of the motion at which its picture is taken


def make(name: str, out: Path) -> dict:
    """Make one example, write its files, and return its title, text, facts and the names of its files."""
    start = time.perf_counter()
    if name in DRAWINGS:
        module, text, (facts, shown) = None, *make_drawing(name)
    else:
        module = import_module(f"examples.gallery.{name}")
        text, (facts, shown) = module.__doc__ or "", module.make()
    files = []
    for what, thing in shown.items():
        if what == "motion":
            share_player(thing.save(out / f"{name}.html"))
            span = thing.data["end"] - thing.data["start"]
            moment = getattr(module, "MOMENT", MOMENT)
            picture = thing.save(out / f"{name}.png", thing.data["start"] + moment * span, width=WIDTH)
        elif what == "film":
            thing.save(out / f"{name}.gif", **getattr(module, "FILM", {}))
            continue
        else:
            picture = out / f"{name}_{what}.png"
            thing.savefig(picture, dpi=DPI)
        _shrink(picture)
        files.append(picture.name)
    title, _, words = text.strip().partition("\n")
    return {
        "name": name,
        "source": f"examples/drawings/{name}.toml" if name in DRAWINGS else f"examples/gallery/{name}.py",
        "title": title,
        "words": words.strip(),
        "facts": facts,
        "files": files,
        "seconds": time.perf_counter() - start,
    }


def make_drawing(name: str) -> tuple[str, tuple[dict, dict]]:
    """Simulate a drawing, and return its first comment, its facts and its player."""
    import numpy as np

    import udkjax as udk

    path = Path("examples/drawings") / f"{name}.toml"
    lines = path.read_text(encoding="utf-8").splitlines()
    words = [line.lstrip("# ") for line in lines if line.startswith("# ")]
    mech = udk.load(path)
    sol = udk.simulate(mech, np.linspace(0.0, DRAWINGS[name], FRAMES))
    facts = {
        "lines of the drawing": float(len(lines)),
        "largest violation of a constraint (m or rad)": float(np.abs(udk.violation(mech, sol)).max()),
    }
    return "\n".join(words), (facts, {"motion": udk.animate(mech, sol, live=True)})


def share_player(player: Path) -> None:
    """Take the script out of a page, and put that of live pages, which serves all pages, into `player.js` in the same folder.

    It is a script, since browsers read no modules from a disk, and the page loses its policy, which allows no other scripts.
    """
    from udkjax.show.player.page import module

    text = player.read_text(encoding="utf-8")
    start, _, rest = text.partition('<script type="module">\n')
    _, mount, end = rest.rpartition("\nmount(")
    start = re.sub(r'<meta http-equiv="Content-Security-Policy"[^\n]*\n', "", start)
    player.write_text(f'{start}<script src="{PLAYER}"></script>\n<script>{mount}{end}', encoding="utf-8")
    program = re.sub(r"^export (default .*|)", "", module(), flags=re.MULTILINE)
    shared = f'const mount = (() => {{\n"use strict";\n{program}\nreturn mount;\n}})();\n'
    (player.parent / PLAYER).write_text(shared, encoding="utf-8")


def _shrink(picture: Path) -> None:
    """Reduce a picture to its few colours, and to a third of its size."""
    from PIL import Image

    Image.open(picture).convert("RGB").quantize(96).save(picture, optimize=True)


def page(examples: list[dict]) -> str:
    """Return the page of the gallery in Markdown, with the players in the same folder."""
    lines = [
        "# Gallery",
        "",
        "Each picture opens a player. Players of single runs are live: sliders change numbers, bodies can be dragged, and the",
        "page computes the motion again. `python -m examples.gallery` makes them all; the scripts are in `examples/gallery`,",
        "the drawings in `examples/drawings`.",
        "",
    ]
    for example in examples:
        name = example["name"]
        facts = [f"- {html.escape(words)}: {value:.4g}" for words, value in example["facts"].items()]
        motion, *others = example["files"]
        lines += [f"## {example['title']}", "", example["words"], "", f"[![{name}]({motion})]({name}.html)", ""]
        lines += [f"![{name}: {file}]({file})" for file in others]
        kind = "Drawing" if name in DRAWINGS else "Script"
        lines += ["", *facts, "", f"{kind}: `{example['source']}`", ""]
    return "\n".join(lines)


def main() -> None:
    """Make the chosen examples."""
    parser = argparse.ArgumentParser(prog="python -m examples.gallery", description="Make the gallery.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join((*DRAWINGS, *NAMES))}; by default all")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), help="folder to write to")
    given = parser.parse_args()
    unknown = [name for name in given.names if name not in (*DRAWINGS, *NAMES)]
    if unknown:
        parser.error(f"there is no example {unknown[0]}")
    given.out.mkdir(parents=True, exist_ok=True)
    found = []
    for name in given.names or (*DRAWINGS, *NAMES):
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
