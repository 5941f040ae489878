"""Pictures that the code of a page draws: `python docs/pictures.py docs/how-to/statics.md` draws those of a page anew.

A comment of a page, `<!-- picture`, has code that draws on `axes`, with the names that the page's blocks have defined. A picture
contains its numbers; the test that runs the blocks compares them with those that it draws, so that no picture is out of date.
The code of a picture also has `figure`, `np`, `udk` and `root`, the folder of the repository.
"""

import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)
PICTURE = re.compile(r"^<!-- picture\n(.*?)^-->\n\n!\[([^\]]+)\]\(([^)]+\.svg)\)", re.S | re.M)
SAMPLES = 9  # of each curve, which are compared
TOLERANCE = 0.01  # fraction of the range of an axis by which a picture may differ: less than the eye sees
ROOT = Path(__file__).parents[1]
INK, GRID = "#101112", "#c0c1c2"  # stand for colours of the page, which are light or dark
SIZE = 6.4, 3.2  # inches
STYLE = {
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 11,
    "grid.color": GRID,
    "legend.frameon": False,
    "lines.linewidth": 2,
    "svg.fonttype": "none",
}


def draw(code: str, names: dict) -> "Figure":
    """Return the figure that the code of a picture draws."""
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure

    import udkjax
    from udkjax.show.style import COLOURS

    given = {"np": np, "udk": udkjax, "root": ROOT}

    with matplotlib.rc_context(STYLE | {"axes.prop_cycle": cycler(color=COLOURS)}):
        figure = Figure(figsize=SIZE, layout="constrained")
        exec(compile(code, "picture", "exec"), given | names | {"axes": figure.subplots(), "figure": figure})
    return figure


def numbers(figure: "Figure") -> list[dict[str, Any]]:
    """Return the labels of each axes, and samples of its curves."""
    return [
        {
            "labels": [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()],
            "curves": [sampled(np.asarray(line.get_xydata(), float)) for line in axes.get_lines()],
        }
        for axes in figure.axes
    ]


def sampled(points: np.ndarray) -> list[list[float]]:
    """Return some of the finite points of a curve."""
    points = points[np.isfinite(points).all(1)]
    chosen = points[np.linspace(0, len(points) - 1, min(SAMPLES, len(points))).round().astype(int)] if len(points) else points
    return [[float(f"{value:.6g}") for value in point] for point in chosen]


def differ(new: list[dict], old: list[dict]) -> list[str]:
    """Return what is different in a picture that is drawn anew."""
    found = [f"axes: {len(new)}, not {len(old)}"] if len(new) != len(old) else []
    for one, other in zip(new, old, strict=False):
        if one["labels"] != other["labels"] or [len(c) for c in one["curves"]] != [len(c) for c in other["curves"]]:
            found.append(f"labels or numbers of curves: {one['labels']}, not {other['labels']}")
        elif one["curves"]:
            a, b = (np.concatenate([np.reshape(c, (-1, 2)) for c in which["curves"]]) for which in (one, other))
            if (np.abs(a - b) > TOLERANCE * np.ptp(b, axis=0) + 1e-300).any():
                found.append(f"curves of {one['labels']}")
    return found


def save(figure: "Figure", path: Path) -> None:
    """Write a picture with its numbers, and with colours that the page sets."""
    import matplotlib

    with matplotlib.rc_context(STYLE | {"svg.hashsalt": path.stem}):
        facts = {"Description": json.dumps(numbers(figure)), "Date": None}
        figure.savefig(path, format="svg", transparent=True, metadata=facts)
    text = path.read_text(encoding="utf-8").replace(INK, "currentColor").replace(GRID, "var(--color-background-border, #c0c1c2)")
    text = text.replace("#000000", "currentColor")
    text = re.sub(r"#(0072b2|d55e00|009e73|cc79a7|56b4e9|e69f00)\b", r"var(--curve-\1, #\1)", text)
    path.write_text("\n".join(line.rstrip() for line in text.splitlines()) + "\n", encoding="utf-8")


def stored(path: Path) -> list[dict]:
    """Return the numbers of a picture."""
    import html

    found = re.search(r"<dc:description>(.*?)</dc:description>", path.read_text(encoding="utf-8"), re.S)
    return json.loads(html.unescape(found[1])) if found else []


def main() -> None:
    """Draw the pictures of the given pages."""
    for page in (Path(name).resolve() for name in sys.argv[1:]):
        text, names = page.read_text(encoding="utf-8"), {"__name__": "__page__"}
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            Path("examples").symlink_to(ROOT / "examples")
            for found in BLOCK.finditer(text):
                exec(compile(found[1], page.name, "exec"), names)
            os.chdir(ROOT)
        for code, _, target in PICTURE.findall(text):
            (page.parent / target).parent.mkdir(exist_ok=True)
            save(draw(code, names), page.parent / target)
            print(page.parent / target)


if __name__ == "__main__":
    main()
