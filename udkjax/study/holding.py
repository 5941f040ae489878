"""Finding out whether a coordinate can be driven, or what holds it."""

from collections.abc import Mapping

from udkjax.equations.redundancy import kinematic_rows, ordinary_position, owners_of_row
from udkjax.scene.checks import SceneError, quote
from udkjax.scene.mechanism import Mechanism
from udkjax.study.report import join_names


def require_free(driven: Mechanism, bare: Mechanism, name: str, driver: str, names: Mapping[str, str]) -> None:
    """Refuse a driver whose coordinate the joints and the other drivers hold; numbers are known.

    It is held where its row of Psi_q depends on theirs in an ordinary position.

    Args:
        driven: the mechanism with the driver.
        bare: the same without any driver.
        name: of the driver in the mechanism.
        driver: what it is called in the message.
        names: what other drivers are called in the message, where not by their names.

    Raises:
        SceneError: it names the drivers that hold the coordinate.
    """
    q = ordinary_position(bare)
    involved = None if q is None else owners_of_row(kinematic_rows(driven), 0.0, q, name)
    if involved is None:
        return
    holding = [names.get(other, f"driver {quote(other)}") for other in driven.driver_names if other in involved]
    if not holding:
        raise SceneError([f"{driver} cannot be driven: the joints leave it no motion"], driven.name)
    cure = "drive that, or take it out of the scene" if len(holding) == 1 else "drive one of them, or take one out of the scene"
    raise SceneError([f"{driver} is held by {join_names(holding)}: {cure}"], driven.name)
