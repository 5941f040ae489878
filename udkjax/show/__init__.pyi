"""The door of `show`: the names that floors above import, each from its own module."""

from udkjax.show.doctor import facts as facts
from udkjax.show.doctor import summary as summary
from udkjax.show.figures import channels_figure as channels_figure
from udkjax.show.figures import driven_figure as driven_figure
from udkjax.show.figures import reactions_figure as reactions_figure
from udkjax.show.figures import tolerances_figure as tolerances_figure
from udkjax.show.identify_figures import save_fit_pictures as save_fit_pictures
from udkjax.show.player import Animation as Animation
from udkjax.show.player import animate as animate
from udkjax.show.player import animate_modes as animate_modes
from udkjax.show.player.animation import FailedRunWarning as FailedRunWarning
from udkjax.show.player.gap_records import outlines as outlines
from udkjax.show.player.marks.measure_curves import ShownMotion as ShownMotion
from udkjax.show.player.marks.measure_curves import measures_of as measures_of
from udkjax.show.player.run_files import read_run as read_run
from udkjax.show.plots import trajectory as trajectory
from udkjax.show.posterior_figures import plot_posterior as plot_posterior
from udkjax.show.posterior_figures import save_posterior_pictures as save_posterior_pictures
from udkjax.show.summary import check_summary as check_summary
from udkjax.show.summary import run_summary as run_summary
from udkjax.show.summary import table as table
from udkjax.show.sweep_figures import save_sweep_pictures as save_sweep_pictures
from udkjax.show.sweep_summary import estimate_summary as estimate_summary
from udkjax.show.sweep_summary import sweep_results as sweep_results
from udkjax.show.sweep_summary import sweep_summary as sweep_summary

__all__: list[str]
