"""Outlines of links from files: closed contours of lines, arcs and splines, with exact areas and moments."""
