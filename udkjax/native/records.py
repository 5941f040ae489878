"""Records between the two passes of reverse mode: a batch stores them, or it integrates again in the second pass.

All stored records have the length of the longest one, so the records of a large batch would take far more memory than their steps
need. The second pass of such a batch therefore makes the record of each member again, in the memory of the thread that runs it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.native.operations import Operation
from udkjax.native.runs import RunCotangents, goes_back

# The largest records of a batch (bytes). To write and read more memory takes longer than to integrate again: for 1,000 runs
# of the paper's linkage 1.9 times as long over 1 s, with 20 steps, and 0.9 times as long over 20 s, with a hundred.
LARGEST_RECORDS = 2**25
LARGEST_ON_CARD = 64  # members: the same for records that are copied to a graphics card and back
GIVEN_RECORD, GIVEN_STEPS = 5, 6  # places of the record and of the number of steps among the inputs, from the last


def are_stored(inputs: Sequence[Any], operation: Operation, members: int, on_card: bool = False) -> bool:
    """Return True if a pass of reverse mode over this number of members stores or reads records; True for other operations."""
    if not isinstance(operation, RunCotangents):
        return True
    if goes_back(inputs) and math.prod(inputs[-GIVEN_RECORD].shape[:-1]) == 1:  # all members share it
        return True
    if on_card:
        return members < LARGEST_ON_CARD
    return 8 * members * operation.record_length <= LARGEST_RECORDS


def without_records(inputs: Sequence[Any], operation: Any) -> tuple[list[Any], Any]:
    """Return the inputs and the operation for a pass that neither stores nor reads records, so that its last output is empty."""
    if goes_back(inputs):
        inputs = [x[..., :0] if k == len(inputs) - GIVEN_RECORD else x for k, x in enumerate(inputs)]
    return list(inputs), replace(operation, points=0)


def absent_records(operation: Any, members: int) -> Array:
    """Return zeros in place of records, (members, record length), from which the second pass knows to integrate again."""
    return jnp.zeros((members, operation.record_length))


def with_longest(inputs: Sequence[Any], operation: Operation) -> list[Any]:
    """Return the inputs of a kernel; in the second pass all members share one number of steps, that of the longest run."""
    if not isinstance(operation, RunCotangents) or not goes_back(inputs):
        return list(inputs)
    return [jnp.max(x, axis=0, keepdims=True) if k == len(inputs) - GIVEN_STEPS else x for k, x in enumerate(inputs)]


def are_given(inputs: Sequence[Any]) -> bool:
    """Return True if the inputs of the second pass contain a record of every member."""
    given = inputs[-GIVEN_RECORD]
    return given.shape[1] > 0 and bool((given[:, 0] > 0.0).all())
