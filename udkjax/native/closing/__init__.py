"""Positions: closing a mechanism with its derivatives, following a driven one, and positions of whole batches.

A *member* is one mechanism of a batch; W members run in *lanes*, except in closing, which has one. A *correction* is a Newton
step of q or v towards the constraint manifold; it is *limited* if its length is bounded, and reverse mode keeps a *record* of
corrections. A *march* follows positions from one value of a driver to the next; the *side* of a position is the sign of det
Psi_q.
"""
