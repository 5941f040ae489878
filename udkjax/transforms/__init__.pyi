"""The door of `transforms`: the names that floors above import, each from its own module."""

from udkjax.transforms.gradients import stop_gradients as stop_gradients
from udkjax.transforms.linear_map import DifferentiableFunction as DifferentiableFunction
from udkjax.transforms.linear_map import Linear as Linear
from udkjax.transforms.linear_map import change_along as change_along
from udkjax.transforms.newton_steps import repeated_newton as repeated_newton
from udkjax.transforms.split_jvp import split_jvp as split_jvp
from udkjax.transforms.traced_numbers import Mask as Mask
from udkjax.transforms.traced_numbers import TreeOfNumbers as TreeOfNumbers
from udkjax.transforms.traced_numbers import replaced as replaced
from udkjax.transforms.traced_numbers import select as select
from udkjax.transforms.traced_numbers import split_numbers as split_numbers

__all__: list[str]
