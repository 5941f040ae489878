"""Worked solutions: the vector loops of a drawing, and their equations line by line, with numbers put in."""
