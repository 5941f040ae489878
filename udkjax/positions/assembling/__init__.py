"""Closed positions: names of coordinates and channels, and the loops that close a mechanism or a system, with derivatives.

`assembly` has the public function; which of machine code, NumPy and JAX closes a position is decided in `closure`.
"""
