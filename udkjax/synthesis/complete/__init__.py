"""All four-bars through nine places of a point, or five poses of a link, each proven and classified.

`complete_design` is the door, `complete_designs` what comes out. `nine_points` follows solutions of the equations of `dyads` from
stored ones; `five_poses` finds dyads as eigenvectors; `certificate` proves real ones, in `balls`. `four_bars` classifies,
`drawn_four_bar` reads the drawing, `motion_check` moves what was found.
"""

from udkjax.synthesis.complete.complete_design import design_all as design_all
from udkjax.synthesis.complete.complete_designs import CompleteDesign as CompleteDesign
from udkjax.synthesis.complete.complete_designs import CompleteDesigns as CompleteDesigns
