"""User-defined systems, with any mass matrix and constraints: they are traced once, and their programs are like those of a scene.

These have the names and results of the programs in `programs`, so that machine code and studies need not distinguish the two.
"""
