"""Graphs of scalars, and programs that evaluate only the nodes that their outputs need."""
