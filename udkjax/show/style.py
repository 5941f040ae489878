"""Style of all plots: colours and marks that everyone tells apart, in print too, and the look of axes."""

from udkjax.extras import OptionalImport

with OptionalImport():
    from matplotlib.axes import Axes

# Okabe and Ito's colours, which everyone can distinguish; the yellow is left out, since thin lines of it vanish on white.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
MARKERS = "os^Dvph"  # a curve's second sign, where there are several
DASHES = ("-", "--", "-.", ":")  # likewise


def plain(axes: Axes) -> Axes:
    """Draw a fine grid behind everything."""
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    return axes


def legend(axes: Axes) -> None:
    """Name the curves above their axes, where they cover nothing."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2, ncols=4, fontsize="small", frameon=False, handlelength=1.2
    )
