"""Threads: of the linear algebra, and of work on independent items."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import TypeVar

from threadpoolctl import threadpool_limits

from hdjax.engine import threads

Item, Result = TypeVar("Item"), TypeVar("Result")

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator of functions whose matrices are small: threads of BLAS would wait for each other longer than they work."""


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of a function for independent items, computed side by side on the available processors.

    Most of the work is numpy's and the machine code's, which leave the interpreter to others. The results do not depend
    on the number of threads.

    Args:
        function: of one item.
        items: all of them.
    """
    items = list(items)
    if min(len(items), threads()) < 2:
        return [function(item) for item in items]
    pool = ThreadPoolExecutor(min(len(items), threads()))
    try:
        # What a context holds (of warnings, of threads) holds for each item.
        waiting = [pool.submit(copy_context().run, function, item) for item in items]
        return [future.result() for future in waiting]
    finally:
        # After an error or Ctrl-C, nobody waits for the others.
        pool.shutdown(wait=False, cancel_futures=True)
