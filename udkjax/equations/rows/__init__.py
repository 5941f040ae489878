"""Rows of Psi: how many are independent, which are redundant, and the loop that closes a mechanism.

Every question about rank is answered here, with the thresholds of this folder and no others.
"""
