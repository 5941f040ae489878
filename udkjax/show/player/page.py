"""The player as a self-contained page."""

import html
import json
import re
from functools import cache
from importlib.resources import files
from string import Template

from udkjax.annotations import JsonObject

# Modules of the player; each follows those that it imports.
PLAYER_MODULES = ("motion", "labels", "painter", "symbols", "strip", "style", "elements", "event_marks", "pointers")
GAP_MODULES = ("gap_marks",)  # of pages that show gaps between links
# Modules of live pages only.
LIVE_MODULES = (
    "events",
    "engine",
    "symbol_updates",
    "hand",
    "sliders",
    "address",
    "part_run",
    "pin_measures",
    "live_run",
    "live",
)
LAST_MODULES = ("player", "mount")
# Characters that could end a <script>, begin markup, or break a line of JavaScript.
ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def page(data: JsonObject, options: JsonObject | None = None) -> str:
    """Return the player of `data` (player_data.py) as one HTML page; `options` are passed to `mount` in mount.js."""
    template = Template(files("udkjax.show.player").joinpath("page.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=html.escape(data["title"]),
        data=as_json(data),
        module=module(is_live="live" in data, has_gaps=any("gaps" in run for run in data["runs"])),
        options=as_json({"fill": True, **(options or {})}),
    )


def frame(data: JsonObject, height: int) -> str:
    """Return the page inside an <iframe> with a height in pixels, for notebooks and other pages."""
    text, title = (html.escape(words, quote=True) for words in (page(data), data["title"]))
    style = f"width:100%;height:{height}px;border:0;border-radius:8px"
    return f'<iframe title="{title}" style="{style}" sandbox="allow-scripts" srcdoc="{text}"></iframe>'


def as_json(data: object) -> str:
    """Return data as JSON for use inside <script>; raise `ValueError` for numbers that are not finite."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).translate(ESCAPES)


@cache
def module(is_live: bool = True, has_gaps: bool = True) -> str:
    """Return the source of the player: its modules joined into one, without comment lines.

    Half of the source are modules that only a live page needs; they are left out of other pages. So are modules that show gaps,
    if a page has none.
    """
    names = (*PLAYER_MODULES, *(GAP_MODULES if has_gaps else ()), *(LIVE_MODULES if is_live else ()), *LAST_MODULES)
    *sources, last = (files("udkjax.show.player").joinpath(f"{name}.js").read_text(encoding="utf-8") for name in names)
    joined = "\n".join([*(re.sub(r"^export ", "", source, flags=re.M) for source in sources), last])
    return re.sub(r"^(import .*| *//.*)?\n", "", joined, flags=re.M)
