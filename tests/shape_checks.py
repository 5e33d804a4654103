"""Checks of shapes and types at a function's first calls in each test file, in the place of `jaxtyping.jaxtyped`.

That one binds the arguments by name, checks them, and checks them again beside the result. Here each is checked once.
"""

import collections
import dataclasses
import functools
import inspect
import os
from collections.abc import Callable
from typing import Any

from jaxtyping import jaxtyped

# Within it, the name of a size stands for one number.
_CALL = jaxtyped("context")

# Later calls nearly always repeat the shapes of the first ones, and their checks would take a third of a loop's time.
MOST = float(os.environ.get("HDJAX_CHECKS", "20"))
# By module and name, since a function within another is made anew at every call of that one.
CALLS: collections.Counter[tuple[str, str]] = collections.Counter()


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
    name = (target.__module__, target.__qualname__)
    if "<locals>" in target.__qualname__ and CALLS[name] >= MOST:
        return target
    strict = typechecker(target)
    if strict is target:
        return target

    @functools.wraps(target)
    def within(*args: Any, **kwargs: Any) -> Any:
        if CALLS[name] >= MOST:
            return target(*args, **kwargs)
        CALLS[name] += 1
        with _CALL:
            return strict(*args, **kwargs)

    return within
