"""Rows of Psi: how many are independent, which are redundant, and the loop that closes a mechanism.

Questions about the rank of positions belong here; the units of rows come from `balance`, and the default tolerance from `terms`.
"""
