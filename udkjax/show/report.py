"""Parts of self-contained HTML reports: their style, and pictures of matplotlib with captions."""

import base64
import io
from collections.abc import Callable
from pathlib import Path

from udkjax.extras import OptionalImport

with OptionalImport():
    from matplotlib import rc_context
    from matplotlib.figure import Figure


def report_style() -> str:
    """Return the style sheet of reports."""
    return Path(__file__).with_suffix(".css").read_text(encoding="utf-8")


def embedded(draw: Callable[[], "Figure"], alt: str, caption: str, kind: str = "") -> str:
    """Return a picture with its caption as HTML that needs no other file.

    Args:
        draw: function that returns the figure.
        alt: a description of the picture, for readers who cannot see it.
        caption: the caption, as HTML.
        kind: a class of the style sheet report.css; "" for none.
    """
    with rc_context({"svg.hashsalt": "udkjax", "path.simplify_threshold": 1.0}):
        buffer = io.BytesIO()
        draw().savefig(buffer, format="svg", metadata={"Date": None})
    source = base64.b64encode(buffer.getvalue()).decode()
    image = f'<img src="data:image/svg+xml;base64,{source}" alt="{alt}">'
    return f'<figure class="{kind}">{image}<figcaption>{caption}</figcaption></figure>'
