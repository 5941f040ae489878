"""Positions: closing a mechanism, with derivatives; following a driven mechanism; and positions of batches.

A *member* is one mechanism of a batch; W members run in *lanes*, except in closing, which has one lane. A *correction* is a
Newton step of q or v towards the constraint manifold; it is *limited* if it is shortened to a maximum length. Reverse mode needs
a *record* of all corrections. A *march* follows positions from one value of a driver to the next; the *side* of a position is the
sign of det Psi_q.

Functions with an argument `f` add instructions to this function of the module; its argument `s` gives access to the numbers of
all lanes, which module/layout.py describes. Sets of lanes are masks.
"""
