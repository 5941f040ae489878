"""Commands that compute many mechanisms or runs: sweeps, fits, designs, tolerances, the study of the paper."""
