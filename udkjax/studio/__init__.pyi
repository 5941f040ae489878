"""The door of `studio`: the names that floors above import, each from the module that it is in."""

from udkjax.studio.serving import serve as serve

__all__: list[str]
