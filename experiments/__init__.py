"""Studies: one script for each claim, with its data and figure. `python -m experiments NAME`. See README.md."""
