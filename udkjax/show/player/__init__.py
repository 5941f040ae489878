"""The player: motions of mechanisms in a page or a notebook, or written as a picture or a film.

`animate` and `animate_modes` make an `Animation`. The player's plain data (player_data.py) consist of marks (marks.py), symbols
(symbols.py) and packed tables (packing.py). mount.js and the modules that it imports show them; pictures.py and films.py draw
them.
"""

from udkjax.show.player.animation import Animation, animate, animate_modes

__all__ = ["Animation", "animate", "animate_modes"]
