"""Derivatives of runs: tangents in forward mode, backpropagation along a record in reverse mode.

A *member* is one run of a batch, in one of the *lanes*. A *direction* is a change of the numbers and the initial state; a
*tangent* is the memory of the changes along one direction, with the same arrays as the run. A *cotangent*, an array named
`bar`, is the derivative of the result with respect to the array's numbers. A *point* is an accepted state, the *record* lists
all points of a member. Derivatives with respect to *active* numbers are needed; *moving* constants depend on active numbers.

Functions with an argument `f` add instructions to this function of the module; its argument `s` gives access to the numbers of
all lanes, which module/layout.py describes. Sets of lanes, such as `accept`, are masks.
"""
