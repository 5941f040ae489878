"""Calls from compiled JAX programs: of machine code, by XLA's foreign function interface, and of functions of the host.

Only this folder knows the data that XLA passes to code of the host and expects from it; calls from graphics cards are in `gpu`.
"""
