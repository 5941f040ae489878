"""Commands that check: a scene, its constraints along a run, the installation."""
