"""Answers about a linkage: degrees of freedom, type, dead points, transmission angles, strokes and motions of pins.

Each is computed from followed positions; a new answer is a module of its own and a row of `characteristics`.
"""
