"""Results that are stored by the structure of trees."""

import gc
import weakref

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.programs.identity_cache import cached_by_size


class Part(eqx.Module):
    """A tree with every kind of field."""

    array: object
    name: str = eqx.field(static=True, default="a")
    other: object = None


def counted():
    calls = []

    @cached_by_size(lambda _: 1, by_structure=True)
    def structure_of(*parts):
        calls.append(None)
        return len(parts)

    return structure_of, calls


def test_a_result_is_stored_for_all_values_of_numbers():
    structure_of, calls = counted()
    assert [structure_of(Part(np.array([x, 1.0])), 3) for x in (0.0, 2.0)] == [2, 2]
    assert len(calls) == 1


def double(x):
    return 2 * x


@pytest.mark.parametrize(
    "other",
    [
        Part(np.zeros(3)),
        Part(np.zeros(2, np.float32)),
        Part(np.zeros(2), "b"),
        Part(np.zeros(2), other=double),
        Part(np.zeros(2), other=-0.0),
        Part(np.zeros(2), other=0),
        Part(np.zeros(2), other=False),
        Part(np.zeros(2), other=np.array([0, 2])),
        Part(np.zeros(2), other=jnp.array([0, 3])),
    ],
)
def test_everything_else_makes_another_structure(other):
    structure_of, calls = counted()
    for part in (Part(np.zeros(2), other=0.0), Part(np.zeros(2), other=lambda x: x), Part(np.zeros(2), other=np.array([0, 1]))):
        structure_of(part)
    known = len(calls)
    for _ in range(2):
        structure_of(other)
    assert known == 3
    assert len(calls) == 4


def test_a_static_field_that_cannot_be_compared_is_no_mistake():
    structure_of, calls = counted()
    for _ in range(2):
        assert structure_of(Part(np.zeros(2), name=np.zeros(2))) == 1  # pyright: ignore[reportArgumentType]
    assert len(calls) == 2


def test_numbers_are_not_kept():
    structure_of, _ = counted()
    part = Part(np.zeros(2))
    structure_of(part)
    known = weakref.ref(part)
    del part
    gc.collect()
    assert known() is None
