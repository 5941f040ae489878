"""Identification: parameters of mechanisms, found from measured motion."""
