"""The door of `studio`: the names that floors above import, each from its own module."""

from udkjax.studio.serving import serve as serve

__all__: list[str]
