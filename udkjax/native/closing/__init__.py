"""Positions: closing a mechanism with its derivatives, following a driven one, and positions of whole batches."""
