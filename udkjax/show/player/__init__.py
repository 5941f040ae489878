"""The player, which shows motions of mechanisms in a page or a notebook, or writes them as a picture or a film.

`animate` and `animate_modes` make an `Animation`. The player's data (player_data.py) consist of marks (marks.py), symbols
(symbols.py) and packed tables (packing.py). The browser shows these by mount.js and its imports; pictures.py and films.py write
them to files.
"""

from udkjax.show.player.animation import Animation, animate, animate_modes

__all__ = ["Animation", "animate", "animate_modes"]
