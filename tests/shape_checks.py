"""Checks of shapes and types at every call, in the place of `jaxtyping.jaxtyped`.

That one binds the arguments by name, checks them, and checks them again beside the result. Here each is checked once.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

from jaxtyping import jaxtyped

# Within it, the name of a size stands for one number.
_CALL = jaxtyped("context")


def checked(target: Any = None, *, typechecker: Callable[[Any], Any]) -> Any:
    """A function, method or property, or a dataclass with its `__init__`, with checks.

    Args:
        target: what is to be checked; without it, a decorator is returned.
        typechecker: decorator that checks a function's arguments and result.
    """
    own = functools.partial(checked, typechecker=typechecker)
    if target is None:
        return own
    if isinstance(target, (classmethod, staticmethod)):
        return type(target)(own(target.__func__))
    if isinstance(target, property):
        return property(*(f and own(f) for f in (target.fget, target.fset, target.fdel)))
    if inspect.isclass(target):
        # An `__init__` that was written or inherited is checked already.
        if dataclasses.is_dataclass(target) and getattr(target.__init__, "__globals__", None) is not globals():
            target.__init__ = own(target.__init__)
        return target
    strict = typechecker(target)
    if strict is target:
        return target

    @functools.wraps(target)
    def within(*args: Any, **kwargs: Any) -> Any:
        with _CALL:
            return strict(*args, **kwargs)

    return within
