"""Studies: one script a claim, from the claim to its figure. `python -m experiments NAME`. See README.md."""
