"""Questions asked of trajectories."""

from udkjax.study.accuracy import exact_coordinates as exact_coordinates
