"""The door of `studio`: the names that floors above import, each from its own module."""

from udkjax.studio.addresses import is_address as is_address
from udkjax.studio.addresses import text_of as text_of
from udkjax.studio.limits import RefusedError as RefusedError
from udkjax.studio.serving import serve as serve

__all__: list[str]
