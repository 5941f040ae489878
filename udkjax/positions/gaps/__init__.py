"""Gaps between the outlines of links over a motion, proven between samples, and layers in which links pass each other."""
