"""Execution of a sweep: chunk by chunk, on this machine's devices or on the workers of a cluster."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hdjax.cluster import on_cluster
from hdjax.dynamics import Model, reading_both_angles
from hdjax.extra import required
from hdjax.sweep.outputs import Plan, answers, extra_dims, plan, variables
from hdjax.sweep.points import SAMPLE
from hdjax.sweep.request import Case, Request, digest
from hdjax.sweep.store import Store, work

_MEMORY = 1 << 29
_LARGEST_CHUNK = 1 << 16
_MEANINGS = {
    "motion": "steady motion, by rising amplitude: 1 on the low branch, 2 between the folds, 3 on the high branch",
    "harmonic": "multiple of the forcing frequency",
    "window": "part of the duration at whose end the value stands",
}
_COPIES = 4  # copies of a chunk's values in memory at a time


def sweep(
    model: Model,
    forcing: Callable[[jax.Array], jax.Array],
    request: Request,
    *,
    store: Path | str | None = None,
    workers: int = 0,
    scheduler: str | None = None,
    memory: int = _MEMORY,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Any:
    """Compute the response of many drives, forcings or both.

    Args:
        model: the equations; the parameters that the request does not vary.
        forcing: motor torque [N m] or a reduced drive's forcing, as a function of time; a module whose fields are
            scalars, such as [`hdjax.Harmonic`][].
        request: the points and outputs.
        store: folder of finished chunks, from which an interrupted run is resumed. Needed for workers.
        workers: processes of a cluster on this machine (Dask); none where 0.
        scheduler: address of a cluster's scheduler, in place of `workers`.
        memory: for the chunks being computed [byte], without the result.
        progress: receives the counts of done and total points.

    Returns:
        An xarray.Dataset with a dimension for each axis (and `sample`). Its attributes state the method, the check on a
        random sample, and the cost.

    Raises:
        ValueError: the request does not suit the model.
        ImportError: the extra `sweep` is not installed.
    """
    required("xarray")
    # The response is that of the dynamic error.
    case = Case(reading_both_angles(model), forcing)
    case.require(request)
    begin = time.perf_counter()
    if store is None:
        if workers or scheduler:
            raise ValueError("`store` must be given for workers to write to")
        chosen = plan(case, request)
        found = _in_memory(case, request, chosen, _chunk_points(request, chosen, memory), progress)
    else:
        kept, chosen = opened(Path(store), case, request, memory=memory)
        _fill(kept, case, request, chosen, workers, scheduler, progress)
        found = kept.read()
    return dataset(case, request, chosen, found, seconds=time.perf_counter() - begin)


def opened(folder: Path, case: Case, request: Request, *, memory: int = _MEMORY) -> tuple[Store, Plan]:
    """A request's store, created if necessary, and its plan."""
    required("zarr")
    kept = Store(folder, case, request, chunk=1)
    chosen = kept.plan
    if chosen is None:
        chosen = plan(case, request)
        kept = Store(folder, case, request, chunk=_chunk_points(request, chosen, memory))
        # Another process may have begun the same request meanwhile.
        begun = kept.plan
        if begun is not None:
            return kept, begun
        kept.begin(chosen)
    return kept, chosen


def _fill(
    kept: Store,
    case: Case,
    request: Request,
    chosen: Plan,
    workers: int,
    scheduler: str | None,
    progress: Callable[[int, int], None],
) -> None:
    waiting = [int(c) for c in np.flatnonzero(~kept.finished())]
    done = request.points.size - sum(kept.points(c).size for c in waiting)
    progress(done, request.points.size)
    if not waiting:
        return
    if workers or scheduler:
        given = (kept, case, request, chosen)
        chunks = (chunk for chunk, _ in on_cluster(work, waiting, given, workers=workers, scheduler=scheduler))
    else:
        chunks = (work(kept, case, request, chosen, chunk) for chunk in waiting)
    for chunk in chunks:
        done += kept.points(chunk).size
        progress(done, request.points.size)


def _in_memory(
    case: Case, request: Request, chosen: Plan, chunk: int, progress: Callable[[int, int], None]
) -> dict[str, np.ndarray]:
    size, parts = request.points.size, []
    for begin in range(0, size, chunk):
        points = np.arange(begin, min(begin + chunk, size))
        parts.append(answers(case, request, chosen, request.points.values(points)))
        progress(min(begin + chunk, size), size)
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def _chunk_points(request: Request, chosen: Plan, memory: int) -> int:
    """Number of points of a chunk within the memory limit; a power of two."""
    lengths = {name: len(c) for name, c in extra_dims(request, chosen).items()}
    widest = max(math.prod(lengths[d] for d in v.dims) for v in variables(request))
    # A transient holds twist, rate and peak of every window; a steady motion all its harmonics and their matrix's rows.
    held = 3 * request.windows if request.response == "transient" else 6 * len(lengths) + 6 * lengths["harmonic"]
    most = memory // (8 * _COPIES * (widest + held + len(request.points.paths)))
    return 1 << max(6, min(int(most), _LARGEST_CHUNK).bit_length() - 1)


def dataset(case: Case, request: Request, chosen: Plan, found: dict[str, np.ndarray], *, seconds: float) -> Any:
    """The result with named coordinates and units."""
    xarray = required("xarray")
    shape, points = request.points.shape, request.points
    extra = extra_dims(request, chosen)
    coordinates: dict[str, Any] = {
        name: ((name,), values, {"units": case.unit(name)}) for name, values in points.axes.items()
    }
    coordinates |= {name: ((SAMPLE,), column, {"units": case.unit(name)}) for name, column in points.sample.items()}
    data = {}
    for v in variables(request):
        values = found[v.name].reshape(*shape.values(), *found[v.name].shape[1:])
        data[v.name] = ((*shape, *v.dims), values, {"units": v.unit, "long_name": v.doc})
        coordinates |= {d: ((d,), extra[d], {"long_name": _MEANINGS[d]}) for d in v.dims}
    if "motions" in data and "forcing.omega" in points.axes:
        data["fold"] = _folds(data["motions"])
    if request.duration is not None and "window" in coordinates:
        coordinates["time"] = (("window",), extra["window"] * request.duration, {"units": "s"})
    check = chosen.check
    attributes = {
        "request": digest(case, request),
        "route": chosen.route.description,
        "checked_points": check.points,
        "checked_error": check.error,
        "checked_median_error": check.median,
        "checked_against": check.reference,
        "unfinished_by_reference": check.unfinished,
        "tolerance": request.tolerance,
        "tolerance_kept": int(check.error <= request.tolerance),
        "points": points.size,
        "seconds": seconds,
    }
    return xarray.Dataset(data, coordinates, attributes)


def _folds(motions: tuple) -> tuple:
    """Whether the number of motions changes before the next frequency."""
    dims, values, _ = motions
    axis = dims.index("forcing.omega")
    change = np.diff(values, axis=axis) != 0
    padding = [(0, 0)] * values.ndim
    padding[axis] = (0, 1)
    text = "a fold lies between this frequency and the next: the number of motions changes"
    return dims, np.pad(change, padding), {"units": "1", "long_name": text}
