"""Calls from compiled JAX programs: of machine code, by XLA's foreign function interface, and of functions of the host.

What XLA passes and expects is known here alone; a change of JAX's interfaces is a change of this folder.
"""
