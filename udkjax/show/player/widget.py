"""The player as a widget of notebooks (Jupyter, Marimo, VS Code, Colab)."""

from typing import Any

from udkjax.extras import OptionalImport
from udkjax.show.player.page import module

with OptionalImport():
    import anywidget
    import traitlets


class PlayerWidget(anywidget.AnyWidget):
    """Shows `data` (records.py). `time` (s) and `playing` follow the player when it stops or is moved, and move it when set."""

    _esm: Any = module()
    data = traitlets.Dict().tag(sync=True)
    time = traitlets.Float(0.0).tag(sync=True)
    playing = traitlets.Bool(False).tag(sync=True)
    theme = traitlets.Unicode("").tag(sync=True)
