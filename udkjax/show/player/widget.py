"""The player as a notebook widget (Jupyter, Marimo, VS Code, Colab)."""

from udkjax.extras import OptionalImport
from udkjax.show.player.page import module

with OptionalImport():
    import anywidget
    import traitlets


class PlayerWidget(anywidget.AnyWidget):
    """A widget that shows `data` (player_data.py).

    `time` (s) and `playing` are updated when the player stops or is moved, and move the player when set.
    """

    _esm = module()
    data = traitlets.Dict().tag(sync=True)
    time = traitlets.Float(0.0).tag(sync=True)
    playing = traitlets.Bool(False).tag(sync=True)
    theme = traitlets.Unicode("").tag(sync=True)
