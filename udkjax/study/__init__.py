"""Questions asked of trajectories."""

from udkjax.study.exact import exact_coordinates as exact_coordinates
