"""The elements of a mechanism: bodies, joints, drivers, force elements, friction and the values that they take.

One class for each type, found by name in scene files; CONTRIBUTING.md says how to add one.
"""
