"""Quantities of a state: the public functions of `udkjax.equations`, and the textbook form that tests compare with.

A new quantity is a function of mechanism, t, q and v here; nothing in the other folders depends on this one.
"""
