"""Questions asked of trajectories."""
