"""The player as a widget of notebooks (Jupyter, Marimo, VS Code, Colab)."""

from udkjax.extras import OptionalImport
from udkjax.show.player.page import module

with OptionalImport():
    import anywidget
    import traitlets


class PlayerWidget(anywidget.AnyWidget):
    """A widget that shows `data` (player_data.py).

    `time` (s) and `playing` follow the player when it stops or is moved, and move it when set.
    """

    _esm = module()
    data = traitlets.Dict().tag(sync=True)
    time = traitlets.Float(0.0).tag(sync=True)
    playing = traitlets.Bool(False).tag(sync=True)
    theme = traitlets.Unicode("").tag(sync=True)
