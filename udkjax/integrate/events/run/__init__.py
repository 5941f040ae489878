"""Runs between events: by machine code, by machine code window by window, and in their plain form by JAX.

All three forms find the same crossings by the rules of `law`; a change of one has to be made in the others.
"""
