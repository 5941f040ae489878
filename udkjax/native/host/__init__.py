"""Calls from compiled JAX programs: of machine code, by XLA's foreign function interface, and of functions of the host.

What XLA passes to code of the host, and expects of it, is known here alone; calls from graphics cards are in `gpu`.
"""
