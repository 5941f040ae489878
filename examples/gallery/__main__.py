"""Make the gallery: players (.html, with one player.js), pictures (.png), a film (.gif), and a page of them all.

    python -m examples.gallery [NAME ...] [--out docs/gallery]

Each example is a script to read and run by itself: `python examples/gallery/peaucellier.py`. The others are drawings,
files of at most 25 lines: `udkjax animate examples/drawings/door_closer.toml`.
"""

import argparse
import html
import re
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

# Groups of the page: names with a short title, and what to try on the page of the example.
GROUPS = {
    "Classic linkages": {
        "four_bar": ("Four-bar", "drag the crank, and make the coupler longer until the motor cannot turn on"),
        "peaucellier": ("Peaucellier's straight line", "change the length of one bar, and see the line bend"),
        "jansen_leg": ("Jansen's leg", "compare the paths of the foot of all cranks"),
        "parallelogram": ("Parallelogram with a redundant link", "make the third link longer: the linkage cannot move"),
        "five_bar": ("With and without projection", "wait until the right linkage stops in mid-air"),
    },
    "Machines": {
        "toggle_press": ("Toggle press", "follow the ram near the bottom, where it almost stands still"),
        "quick_return": ("Quick return", "move the pivot of the lever, and compare the times of the two strokes"),
        "excavator": ("Excavator", "make the dampers of the cylinders weaker"),
        "scissor_lift": ("Scissor lift", "give the platform another load"),
        "scissor_lift_spring": ("Scissor lift on a spring", "make the spring softer until the lift does not rise any more"),
        "door_closer": ("Door closer", "take the damping away: the door slams"),
        "planetary_gear": ("Planetary gear", "count the turns of the sun for one turn of the carrier"),
    },
    "Cams": {
        "cam_follower": ("Cam and follower", "drag the cam, and watch the spring press the follower"),
        "dwell_cam": ("Cam with two dwells", "look for the jumps of the acceleration at the ends of a dwell"),
    },
    "Friction and impacts": {
        "hammer": ("Hammer", "change the restitution of the anvil"),
        "toggle_clamp": ("Toggle clamp", "compare the dry clamp with the greased one"),
        "woodpecker": ("Woodpecker", "make the spring stiffer, and count the pecks"),
        "rod_on_floor": ("Rod on the floor", "compare the two coefficients when the tip digs in"),
    },
    "Identification": {
        "identification": ("Two masses from a motion", "compare the first guess with the result"),
        "neural_friction": ("Friction learned by a network", "compare the learned law with the true one"),
    },
    "Design": {
        "workshop_four_bar": ("Four-bar for the workshop", "press Least gap: crank and rocker of the nearest four-bar turn red"),
        "designed_paths": ("Paths by design", "follow the foot, which stays level on the ground"),
        "drawn_curves": ("Letters and a star", "count the teeth of the star while its second crank turns"),
        "six_bar_dwell": ("Six-bar with a dwell", "watch the output rest for a third of a turn"),
    },
    "Chaos": {"double_pendulum_map": ("A map of chaos", "compare pendulums that start next to each other")},
}
DRAWINGS = {"toggle_press": 1.0, "quick_return": 2.0, "cam_follower": 0.5, "door_closer": 6.0, "scissor_lift_spring": 2.0}  # s
NAMES = tuple(name for group in GROUPS.values() for name in group if name not in DRAWINGS)
PLAYER = "player.js"  # the script of all pages
FRAMES = 121  # of their players
WIDTH = 720  # px, of pictures
DPI = 96  # of plots
THUMBNAIL = {"width": 260, "fps": 10.0}  # a film beside the short title
LOOP = 2.4  # s, its length
MOMENT = 0.3  # fraction of the motion at which its picture is taken
PLACE = '<div id="player"></div>'  # of a player in its page
ALONE = '<script>if (self !== top) document.getElementById("bar").remove();</script>\n'  # not in the frame of another page
BAR = """<style>
body { display: flex; flex-direction: column; height: 100vh; height: 100dvh; }
#player { flex: 1; min-height: 0; --player-height: 100%; }
#bar { margin: 0; padding: 0.5em 1em; background: Canvas; color: CanvasText; font: 0.95rem/1.4 system-ui, sans-serif; }
#bar a { color: LinkText; }
</style>
"""


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
            share_player(thing.save(out / f"{name}.html"), name)
            span = thing.data["end"] - thing.data["start"]
            moment = getattr(module, "MOMENT", MOMENT)
            picture = thing.save(out / f"{name}.png", thing.data["start"] + moment * span, width=WIDTH)
            thing.save(out / f"{name}.moving.gif", speed=span / LOOP, **THUMBNAIL)
        elif what == "home":
            share_player(thing.save(out / "home.html", autoplay=True))
            continue
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
        "source": source(name),
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
        "largest violation of a constraint (m or rad)": float(np.abs(udk.violation(mech, sol)).max()),
    }
    return "\n".join(words), (facts, {"motion": udk.animate(mech, sol, live=True)})


def source(name: str) -> str:
    """Return the file of an example."""
    return f"examples/drawings/{name}.toml" if name in DRAWINGS else f"examples/gallery/{name}.py"


def with_bar(text: str, name: str) -> str:
    """Return a page with a line above its player: the way back, what to try, and the file of the example."""
    short, tried = next(members[name] for members in GROUPS.values() if name in members)
    section = re.sub(r"[^\w\- ]", "", short.lower()).replace(" ", "-")
    back = f'<a href="index.html#{section}">Gallery</a>'
    bar = f'<p id="bar">{back} &middot; <b>Try:</b> {html.escape(tried)} &middot; <code>{source(name)}</code></p>\n{ALONE}'
    return text.replace(PLACE, f"{BAR}{bar}{PLACE}", 1)


def share_player(player: Path, name: str = "") -> None:
    """Take the script out of a page, and put that of live pages, which serves all pages, into `player.js` in the same folder.

    The page of an example gets a line above its player.
    It is a script, since browsers read no modules from a disk, and the page loses its policy, which allows no other scripts.
    """
    from udkjax.show.player.page import module

    text = player.read_text(encoding="utf-8")
    start, _, rest = text.partition('<script type="module">\n')
    _, mount, end = rest.rpartition("\nmount(")
    start = re.sub(r'<meta http-equiv="Content-Security-Policy"[^\n]*\n', "", start)
    start = with_bar(start, name) if name else start
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
    from docs.mathml import typeset

    lines = [
        "# Gallery",
        "",
        "Each picture opens a player. Players of single runs are live: sliders change numbers, bodies can be dragged, and the",
        "page computes the motion again. `python -m examples.gallery` makes them all; the scripts are in `examples/gallery`,",
        "the drawings in `examples/drawings`.",
        "",
    ]
    found = {example["name"]: example for example in examples}
    for group, members in GROUPS.items():
        shown = [name for name in members if name in found]
        lines += [f"## {group}", "", *cards(shown, members), ""] if shown else []
        for name in shown:
            short, tried = members[name]
            example = found[name]
            facts = [f"- {typeset(html.escape(words, quote=False))}: {value:.4g}" for words, value in example["facts"].items()]
            motion, *others = example["files"]
            lines += [f"### {short}", "", typeset(example["title"]), typeset(example["words"]), ""]
            lines += [f"[![{short}: a pose of its motion]({motion})]({name}.html)", ""]
            lines += [f"![{short}: {Path(file).stem.removeprefix(name + '_')}]({file})" for file in others]
            kind = "Drawing" if name in DRAWINGS else "Script"
            lines += ["", *facts, "", f"**Try:** {tried}. {kind}: `{example['source']}`", ""]
    return "\n".join(lines)


def cards(names: list[str], members: dict[str, tuple[str, str]]) -> Iterator[str]:
    """Iterate over the lines of a grid of moving thumbnails; where no motion is wanted, pictures stand still."""
    yield '<div class="cards moving">'
    for name in names:
        moving = f'<img class="moving" loading="lazy" src="{name}.moving.gif" alt="" width="260">'
        still = f'<img class="still" loading="lazy" src="{name}.png" alt="" width="260">'
        yield f'<a class="card" href="{name}.html">{moving}{still}<b>{html.escape(members[name][0])}</b></a>'
    yield "</div>"


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
