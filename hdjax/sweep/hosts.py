"""A sweep's chunks on the workers of a Dask cluster."""

import contextlib
import pickle
from collections.abc import Iterator
from typing import Any

import jax

from hdjax.sweep.outputs import Plan
from hdjax.sweep.request import Case, Request
from hdjax.sweep.store import Store, required, work

_RETRIES = 3
_EVERYWHERE = ("jax_enable_x64",)
# What makes sense on this machine alone.
_HERE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def spread_chunks(
    kept: Store, case: Case, request: Request, chosen: Plan, chunks: list[int], workers: int, scheduler: str | None
) -> Iterator[int]:
    """Have chunks worked out by a cluster; gives each that is done.

    Args:
        kept: the store, which all workers see under the same path.
        case: the model and its forcing.
        request: what is wanted.
        chosen: how.
        chunks: those that are not done.
        workers: processes of a cluster on this machine, where there is no scheduler.
        scheduler: address of a cluster's scheduler.
    """
    distributed = required("distributed")
    names = _EVERYWHERE if scheduler else (*_EVERYWHERE, *_HERE)
    settings = {name: getattr(jax.config, name) for name in names}
    with contextlib.ExitStack() as stack:
        address = scheduler
        if address is None:
            # Each worker has the machine's cores to itself in turn: one thread, one chunk.
            cluster = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
            )
            address = stack.enter_context(cluster)
        try:
            client = stack.enter_context(distributed.Client(address))
        except OSError as error:
            raise ValueError(f"no Dask scheduler answers at {address}") from error
        # Bytes: a worker must know the precision before it makes arrays of them.
        shared = client.scatter((pickle.dumps((kept, case, request, chosen)), settings), broadcast=True)
        # The store remembers what is done, not the scheduler: a later run must ask anew.
        futures = client.map(_on_worker, chunks, given=shared, pure=False, retries=_RETRIES)
        for future in distributed.as_completed(futures):
            yield future.result()


def _on_worker(chunk: int, given: tuple[bytes, dict[str, Any]]) -> int:
    """A worker's process is the sweep's own: JAX's settings are those of whoever asked."""
    task, settings = given
    for name, value in settings.items():
        jax.config.update(name, value)
    kept, case, request, chosen = pickle.loads(task)
    return work(kept, case, request, chosen, chunk)
