"""The player: motions of mechanisms, to look at in a page or a notebook, or to write as a picture or a film.

`animate` and `animate_modes` make an `Animation`. The player shows plain data (player_data.py) made of marks (marks.py), symbols
(symbols.py) and packed tables (packing.py); mount.js and the modules that it imports show it, pictures.py and films.py draw it.
"""

from udkjax.show.player.animation import Animation, animate, animate_modes

__all__ = ["Animation", "animate", "animate_modes"]
