"""Friction that depends on the loads of joints, at a single state: loads, modes of sliding and sticking, and redundant rows.

Machine code has its own text of these laws (`elimination`); runs that change modes are decided in `integrate/events`.
"""
