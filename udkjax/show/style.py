"""Style of all plots: colours and markers that everyone can distinguish, also in print, and the look of axes."""

from udkjax.extras import OptionalImport

with OptionalImport():
    from matplotlib.axes import Axes

# The Okabe-Ito colours, which colour-blind readers can distinguish; without yellow, which is invisible in thin lines on white.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
MARKERS = "os^Dvph"  # markers and dashes distinguish curves in addition to colours
DASHES = ("-", "--", "-.", ":")


def plain(axes: Axes) -> Axes:
    """Draw a fine grid in the background, and return the axes."""
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    return axes


def legend(axes: Axes) -> None:
    """Draw a legend above the axes, where it does not cover curves."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2, ncols=4, fontsize="small", frameon=False, handlelength=1.2
    )
