"""Finding out whether a coordinate can be driven, or what holds it."""

from collections.abc import Mapping

import numpy as np

from udkjax.equations.dense_rows import NEGLIGIBLE_SHARE
from udkjax.equations.redundancy import kinematic_rows, ordinary_position
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
    rows, q = kinematic_rows(driven), ordinary_position(bare)
    if q is None:
        return
    D = rows.at(0.0, q)[2]
    D = np.asarray(D if isinstance(D, np.ndarray) else D.toarray())  # its rows have length one
    owners = np.array([owner for owner, _ in rows.names])
    own, others = D[owners == name][0], D[owners != name]
    shares = np.linalg.lstsq(others.T, own, rcond=NEGLIGIBLE_SHARE)[0]
    if np.linalg.norm(own - others.T @ shares) > NEGLIGIBLE_SHARE:
        return
    involved = set(owners[owners != name][np.abs(shares) > NEGLIGIBLE_SHARE])
    holding = [names.get(other, f"driver {quote(other)}") for other in driven.driver_names if other in involved]
    if not holding:
        raise SceneError([f"{driver} cannot be driven: the joints leave it no motion"], driven.name)
    cure = "drive that, or take it out of the scene" if len(holding) == 1 else "drive one of them, or take one out of the scene"
    raise SceneError([f"{driver} is held by {join_names(holding)}: {cure}"], driven.name)
