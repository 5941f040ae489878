"""What is raised where an identification cannot be what it says."""

from udkjax.scene.checks import Mistakes


class IdentificationError(Mistakes):
    """Data, parameters or settings do not fit the mechanism, or each other. `problems` lists every mistake, with its place."""

    of = "identification"
