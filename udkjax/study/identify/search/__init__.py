"""Minimization: least squares, robust and user-defined losses, growing records, and multiple shooting.

Each strategy takes a problem and a guess, and returns a better guess with its history.
"""
