"""Types that several modules share.

Signatures and `help` show a `TypeAliasType` by its name, and any other alias as the types that it stands for.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Array, ArrayLike, Float
from typing_extensions import TypeAliasType

Number = TypeAliasType("Number", Array | float)  # one number, possibly traced
NumberLike = TypeAliasType("NumberLike", ArrayLike)  # one number of Python, NumPy or JAX
Numbers = TypeAliasType("Numbers", ArrayLike | Sequence[object])  # a number, an array, or nested lists of numbers

NumericArray: TypeAlias = Array | np.ndarray
AnyArray = TypeVar("AnyArray", Array, np.ndarray)  # the same type throughout a signature

Time: TypeAlias = Float[ArrayLike, ""]  # s
Vector: TypeAlias = Float[Array, "n"]  # flat coordinates, velocities or states
TimeSeries: TypeAlias = Float[Array, "T n"]  # one row per time

TreeDef: TypeAlias = Any  # jax.tree_util.PyTreeDef, which type checkers mistake for a variable
JsonObject: TypeAlias = dict[str, Any]
TomlTable: TypeAlias = Mapping[str, Any]
