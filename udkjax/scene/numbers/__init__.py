"""Numbers of a mechanism by name: their units, the leaves of its tree, and the numbers that follow from a drawing.

`with_parameters`, sweeps, designs and fits find every number through these names.
"""
