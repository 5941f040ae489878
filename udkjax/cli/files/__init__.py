"""Commands that draw, convert and export mechanisms."""
