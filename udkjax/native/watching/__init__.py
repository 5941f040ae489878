"""Runs that watch conditions, and end where one of them crosses zero."""
