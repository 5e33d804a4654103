"""Independent tasks on processes of this machine or of many, by Dask. A task whose worker fails is repeated."""

import contextlib
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from hdjax.extra import required

_RETRIES = 3
_EVERYWHERE = ("jax_enable_x64",)
# Arguments that apply to this machine only.
_HERE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def on_cluster(
    function: Callable[..., Any], items: Sequence[Any], given: tuple, *, workers: int, scheduler: str | None
) -> Iterator[tuple[Any, Any]]:
    """Call `function(*given, item)` for every item on a cluster; yields each item with its result when finished.

    Args:
        function: a function at module level, whose tasks may run more than once.
        items: one argument per task.
        given: common arguments.
        workers: processes of a cluster on this machine, without a scheduler.
        scheduler: address of a cluster's scheduler. Its workers have this project installed.

    Raises:
        ImportError: Dask is not installed.
        ValueError: no scheduler answers.
    """
    distributed = required("distributed")
    names = _EVERYWHERE if scheduler else (*_EVERYWHERE, *_HERE)
    settings = {name: getattr(jax.config, name) for name in names}
    with contextlib.ExitStack() as stack:
        address = scheduler
        if address is None:
            # Each worker has the machine's cores to itself in turn: one thread, one task.
            address = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                )
            )
        try:
            client = stack.enter_context(distributed.Client(address))
        except OSError as error:
            raise ValueError(f"no Dask scheduler answers at {address}") from error
        # Bytes: a worker must know the precision before it makes arrays of them.
        shared = client.scatter((pickle.dumps((function, given)), settings), broadcast=True)
        # The caller stores results, not the scheduler: a later run must compute again.
        futures = client.map(_on_worker, items, given=shared, pure=False, retries=_RETRIES)
        of = dict(zip((future.key for future in futures), items, strict=True))
        for future in distributed.as_completed(futures):
            yield of[future.key], future.result()


def _on_worker(item: Any, given: tuple[bytes, dict[str, Any]]) -> Any:
    """Run a task in a worker's process, with the caller's JAX settings."""
    task, settings = given
    for name, value in settings.items():
        jax.config.update(name, value)
    function, shared = pickle.loads(task)
    return function(*shared, item)
