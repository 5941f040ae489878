"""All four-bars through nine points of a path, or five poses of a link, each proven and classified.

`complete_design` has the public function, `complete_designs` its results. `nine_points` tracks solutions of the equations of
`dyads` from stored ones; `five_poses` finds dyads as eigenvectors; `certificate` proves real ones, with `balls`. `four_bars`
classifies, `drawn_four_bar` reads the drawing, `motion_check` verifies the motions.
"""

from udkjax.synthesis.complete.complete_design import design_all as design_all
from udkjax.synthesis.complete.complete_designs import CompleteDesign as CompleteDesign
from udkjax.synthesis.complete.complete_designs import CompleteDesigns as CompleteDesigns
