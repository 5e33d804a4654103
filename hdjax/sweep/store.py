"""The store of a sweep: finished chunks on disk, so that an interrupted run can be resumed.

A folder holds one zarr group for each request, named by the request's digest. A chunk of points is one zarr chunk of
each variable; a mark, written last, states that it is complete. Workers on other hosts write to the same folder, which
must have the same path for them.
"""

import json
import os
import platform
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from hdjax.extra import required
from hdjax.sweep.outputs import Plan, answers, extra_dims, variables
from hdjax.sweep.request import Case, Request, digest

_PLAN = "plan.json"
_MARKS = "finished"


class Store:
    """A request's group in a store.

    Attributes:
        path: of the group.
        chunk: points in a chunk.
    """

    def __init__(self, folder: Path, case: Case, request: Request, *, chunk: int):
        self.path = Path(folder) / digest(case, request)
        self._request = request
        # An existing store keeps its chunks.
        self.chunk = int(self._read().get("chunk", chunk))

    def _read(self) -> dict[str, Any]:
        try:
            return json.loads((self.path / _PLAN).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}

    @property
    def plan(self) -> Plan | None:
        """The plan of an existing store."""
        content = self._read()
        return Plan.from_dict(content, self._request) if content else None

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self._request.points.size // self.chunk)

    def begin(self, plan: Plan) -> None:
        """Create the arrays; the plan is written last, as a mark that they exist."""
        zarr = required("zarr")
        # Marks that outlived their plan say nothing of the new arrays.
        shutil.rmtree(self.path / _MARKS, ignore_errors=True)
        group = zarr.open_group(self.path / "data", mode="w")
        points = self._request.points.size
        lengths = {name: len(coordinate) for name, coordinate in extra_dims(self._request, plan).items()}
        for variable in variables(self._request):
            behind = tuple(lengths[d] for d in variable.dims)
            group.create_array(
                variable.name,
                shape=(points, *behind),
                chunks=(self.chunk, *behind),
                dtype=variable.kind,
                fill_value=np.nan if variable.kind == "float64" else 0,
                attributes={"units": variable.unit, "long_name": variable.doc},
                dimension_names=("point", *variable.dims),
            )
        for name, column in self._request.points.values(np.arange(points)).items():
            group.create_array(name, data=column, chunks=(min(points, 1 << 20),), dimension_names=("point",))
        (self.path / _MARKS).mkdir(exist_ok=True)
        _write(self.path / _PLAN, json.dumps(plan.as_dict() | {"chunk": self.chunk}))

    def finished(self) -> Bool[np.ndarray, " chunks"]:
        """Which chunks are complete."""
        marks = np.zeros(self.chunks, dtype=bool)
        if (self.path / _MARKS).is_dir():
            for mark in (self.path / _MARKS).iterdir():
                if mark.name.isdigit():
                    marks[int(mark.name)] = True
        return marks

    def has(self, chunk: int) -> bool:
        """Whether a chunk is complete."""
        return (self.path / _MARKS / str(chunk)).exists()

    def points(self, chunk: int) -> np.ndarray:
        """The points of a chunk."""
        return np.arange(chunk * self.chunk, min((chunk + 1) * self.chunk, self._request.points.size))

    def write(self, chunk: int, found: dict[str, np.ndarray]) -> None:
        """Write a chunk, and mark it with its host and process."""
        group = required("zarr").open_group(self.path / "data", mode="r+")
        points = self.points(chunk)
        for name, values in found.items():
            group[name][points[0] : points[-1] + 1] = values
        _write(self.path / _MARKS / str(chunk), f"{platform.node()} {os.getpid()}")

    def read(self) -> dict[str, np.ndarray]:
        """All variables, one point per row."""
        group = required("zarr").open_group(self.path / "data", mode="r")
        return {v.name: group[v.name][:] for v in variables(self._request)}


def work(kept: Store, case: Case, request: Request, chosen: Plan, chunk: int) -> int:
    """Compute and write a chunk, unless it exists: its worker may have failed before reporting it."""
    if not kept.has(chunk):
        kept.write(chunk, answers(case, request, chosen, request.points.values(kept.points(chunk))))
    return chunk


def _write(path: Path, text: str) -> None:
    """Write a small file atomically."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(name, path)
