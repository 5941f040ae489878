"""Marks: the elements of a mechanism's picture and their symbols, which the page, pictures and films share.

A new symbol is added in `symbols`; page and writers of pictures need no change.
"""
