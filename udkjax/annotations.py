"""Types of arguments under a name of their own: signatures and `help` show the name, not the types that it stands for."""

from collections.abc import Sequence

from jaxtyping import Array, ArrayLike
from typing_extensions import TypeAliasType

Number = TypeAliasType("Number", Array | float)  # one number, which may be traced
Scalar = TypeAliasType("Scalar", ArrayLike)  # one number of Python, NumPy or JAX
Numbers = TypeAliasType("Numbers", ArrayLike | Sequence[object])  # a number, an array, or nested lists of numbers
