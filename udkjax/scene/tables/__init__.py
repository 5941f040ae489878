"""Elements as tables of scene files: the schema derived from their classes, and the checks that find all mistakes.

A new class needs no change here, unless its mistakes need a check of their own.
"""
