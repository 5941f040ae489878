"""User-defined systems, with any mass matrix and constraints: traced once, and written as the programs of a scene.

Their programs have the names and results of those in `programs`, so that machine code and studies need not distinguish them.
"""
