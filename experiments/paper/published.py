"""The tables of the paper, as they were printed.

D. de Falco, E. Pennestri, L. Vita, "The Udwadia-Kalaba formulation: a report on its numerical efficiency in multibody dynamics
simulations and on its teaching effectiveness", ECCOMAS Multibody Dynamics 2005, Madrid, 21-24 June 2005, tables 2 to 7. Read from
a scanned copy: exponents are as legible there.
"""

from typing import NamedTuple

CITATION = (
    "D. de Falco, E. Pennestrì, L. Vita: The Udwadia-Kalaba formulation: a report on its numerical efficiency in multibody "
    "dynamics simulations and on its teaching effectiveness. ECCOMAS Multibody Dynamics 2005, Madrid."
)


class Row(NamedTuple):
    """One line of a table: the result in words, and None where the paper prints nothing."""

    method: str
    result: str
    psi2: float | None = None  # sum of the squared constraint violations
    nfunc: int | None = None
    nsteps: int | None = None
    cpu: float | None = None  # s
    misprint: str = ""


class Table(NamedTuple):
    """One table: its number, the tolerance TOL and the gains alpha and beta (1/s) of its runs."""

    number: int
    tol: float
    alpha: float
    beta: float
    rows: tuple[Row, ...]


_TWICE = "NSTEPS is that of table 3"
TABLES = (
    Table(
        *(2, 1e-10, 0.0, 0.0),
        (
            Row("SVD", "halt 9.1 s (error test failures)", 3.7e-7),
            Row("Varga", "halt 8.0 s", 9.9e-2),
            Row("Greville", "correct to 17.5 s", 4.5e-4, 2961955, 2633811, 0.93),
            Row("Householder", "correct to 16.5 s", 6.3e-4, 6131159, 4177395, 11.57),
            Row("GramSchmidt", "correct to 17.0 s", 1.1e-4, 3749766, 3015354, 36.85),
        ),
    ),
    Table(
        *(3, 1e-8, 0.0, 0.0),
        (
            Row("SVD", "halt 12.07 s", 3.4e-5),
            Row("Varga", "halt 8.06 s (constraint precision)", 9.9e-2),
            Row("Greville", "correct to 17.5 s", 1.86e-4, 1648055, 1422689, 0.53),
            Row("Householder", "correct to 18.0 s", 7.9e-4, 1641751, 1422297, 1.28),
            Row("GramSchmidt", "correct to 18.0 s", 5.2e-4, 1644341, 1424864, 6.03),
        ),
    ),
    Table(
        *(4, 1e-6, 0.0, 0.0),
        (
            Row("SVD", "correct to 17.5 s", 4.1e-4, 1033381, 847294, 0.28),
            Row("Varga", "halt 7.3 s", 9.9e-2),
            Row("Greville", "correct to 19.0 s", 9.7e-4, 1017558, 1422689, 0.37, _TWICE),
            Row("Householder", "correct", 7.9e-4, 1641751, 1422297, 0.76, "all but CPU is that of table 3"),
            Row("GramSchmidt", "correct", 6.9e-4, 1013795, 839020, 3.4),
        ),
    ),
    Table(
        *(5, 1e-10, 1000.0, 100.0),
        (
            Row("SVD", "halt 1.17 s"),
            Row("Varga", "correct", 4.5e-5, 78491398, 47074599, 11.4),
            Row("Greville", "correct", 2.1e-7, 74043990, 44053874, 18.3),
            Row("Householder", "correct", 3.3e-7, 73707588, 43948609, 51.5),
            Row("GramSchmidt", "correct", 4.1e-7, 73910268, 44515071, 241.0),
        ),
    ),
    Table(
        *(6, 1e-8, 1000.0, 100.0),
        (
            Row("SVD", "halt 0.17 s"),
            Row("Varga", "halt 14.97 s"),
            Row("Greville", "correct", 4.9e-7, 80109155, 55569995, 194.0, "CPU is 19.4 s, by its neighbours"),
            Row("Householder", "correct", 3.5e-7, 80197458, 54468468, 55.0),
            Row("GramSchmidt", "correct", 4.9e-7, 80112706, 54604452, 290.0),
        ),
    ),
    Table(
        *(7, 1e-6, 1000.0, 100.0),
        (
            Row("SVD", "halt 0.46 s"),
            Row("Varga", "halt 9.7 s"),
            Row("Greville", "correct", 1.9e-6, 80483163, 57743095, 19.5),
            Row("Householder", "correct", 1.14e-6, 80689071, 58099798, 55.0),
            Row("GramSchmidt", "correct", 1.06e-6, 80636983, 58010479, 291.0),
        ),
    ),
)
