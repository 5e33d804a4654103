"""Request of a sweep."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdjax.dynamics import Model
from hdjax.effects import ActuatorEffect
from hdjax.sweep.points import Points

Response = Literal["steady", "transient"]
OUTPUTS: dict[Response, tuple[str, ...]] = {
    "steady": ("amplitude", "peak", "harmonics"),
    "transient": ("peak", "settling_time", "trace", "final"),
}
FORCING = "forcing."
_FORCING_UNITS = {"amplitude": "N m", "offset": "N m", "phase": "rad", "duration": "s"}
_ALGORITHMS = 1  # increased when results of the same request change


@dataclasses.dataclass(frozen=True)
class Request:
    """Points and outputs of a sweep.

    Attributes:
        points: by their parameters' dotted paths: those of the model (`K`, `backlash.b`), and those of the forcing with
            the prefix `forcing.` (`forcing.omega`).
        response: `"steady"` for the periodic motions under a harmonic forcing, all that are related to the one-harmonic
            ones; `"transient"` for the motion from rest.
        outputs: some of `OUTPUTS` of that response.
        duration: of a transient [s].
        periods: of the forcing that a transient lasts, in place of a duration.
        windows: equal parts of a transient. A trace has as many samples; a settling time is resolved to one part, which
            should contain a period of the forcing.
        band: for settling: largest relative difference of a window's largest |x| from the last window's.
        tolerance: largest error of a motion, relative to its largest |x|.
        seed: of the points to choose and check the method.
    """

    points: Points
    response: Response = "steady"
    outputs: tuple[str, ...] = ("amplitude", "peak")
    duration: float | None = None
    periods: float | None = None
    windows: int = 100
    band: float = 0.02
    tolerance: float = 1e-6
    seed: int = 0

    def __post_init__(self):
        if self.response not in get_args(Response):
            raise ValueError(f"`response` must be one of {get_args(Response)}, but is {self.response!r}")
        known = OUTPUTS[self.response]
        strange = [o for o in self.outputs if o not in known]
        if strange or not self.outputs:
            raise ValueError(f"`outputs` of a {self.response} response must be among {known}, but are {self.outputs}")
        if self.response == "transient":
            lengths = [v for v in (self.duration, self.periods) if v is not None]
            if len(lengths) != 1 or not lengths[0] > 0.0:
                raise ValueError(
                    "a transient must have either `duration` or `periods`, above zero, "
                    f"but has {self.duration} and {self.periods}"
                )
            if self.windows < 1:
                raise ValueError(f"`windows` must be 1 or more, but is {self.windows}")
        if not 1e-10 <= self.tolerance <= 0.1:
            raise ValueError(f"`tolerance` must lie between 1e-10 and 0.1, but is {self.tolerance}")

    @property
    def peaks(self) -> bool:
        """Whether the largest |x| of each window is needed."""
        return bool({"peak", "settling_time"} & set(self.outputs))


class Case(eqx.Module):
    """A model and its forcing, with parameters to be set per point.

    Attributes:
        model: the equations.
        forcing: motor torque [N m] or a reduced drive's forcing; a module whose fields are scalars.
    """

    model: Model
    forcing: Callable[[Array], Array]

    def at(self, values: Mapping[str, Array]) -> "Case":
        """The case with a point's values."""
        own = {path: v for path, v in values.items() if not path.startswith(FORCING)}
        outside = {path.removeprefix(FORCING): v for path, v in values.items() if path.startswith(FORCING)}
        forcing = self.forcing
        if outside:
            forcing = eqx.tree_at(lambda f: [getattr(f, name) for name in outside], forcing, list(outside.values()))
        return Case(self.model.replace(own) if own else self.model, forcing)

    def require(self, request: Request) -> None:
        """Refuse a request that does not suit the case.

        Raises:
            ValueError: names the parameter and the reason.
        """
        acting = [effect.name for effect in self.model.effects if isinstance(effect, ActuatorEffect)]
        if acting:
            raise ValueError(f"`{acting[0]}` changes a torque that was logged; give a sweep the forcing that acts")
        points, parameters = request.points, self.model.parameters()
        known = [*parameters, *(FORCING + name for name in vars(self.forcing))]
        for path in points.paths:
            if path not in known:
                raise ValueError(f"`{path}` is no parameter of this sweep; there are {', '.join(known)}")
        limits = {path: info.bounds for path, (_, info) in parameters.items()}
        fixed = {path: value for path, (value, _) in parameters.items()}
        if hasattr(self.forcing, "omega") and (request.response == "steady" or request.periods is not None):
            limits[FORCING + "omega"] = (0.0, math.inf)
            fixed[FORCING + "omega"] = self.forcing.omega  # pyright: ignore[reportFunctionMemberAccess]
        for path, (low, high) in limits.items():
            values = points.column(path)
            if values is None:
                values = np.atleast_1d(fixed[path])
            inside = (values > low) & (values < high)
            if path in parameters and "." in path:
                # An effect may be swept from its absence, the end of its interval.
                inside |= (values == low) | (values == high)
            if not np.all(inside):
                span = f"{np.min(values):g} to {np.max(values):g}"
                raise ValueError(f"`{path}` must lie between {low:g} and {high:g}, but runs from {span}")

    def unit(self, path: str) -> str:
        """Unit of a parameter; a reduced drive's forcing has the unit of its log."""
        if not path.startswith(FORCING):
            return self.model.parameters()[path][1].unit
        name = path.removeprefix(FORCING)
        return "rad/s" if name.startswith("omega") else _FORCING_UNITS.get(name, "")


def digest(case: Case, request: Request) -> str:
    """A hash of the request, as its name."""
    texts: list[Any] = [version("hdjax"), _ALGORITHMS, jax.config.read("jax_enable_x64")]
    for field in dataclasses.fields(request):
        if field.name != "points":
            texts.append([field.name, getattr(request, field.name)])
    for kind in ("axes", "sample"):
        for name, column in getattr(request.points, kind).items():
            texts.append([kind, name, hashlib.sha256(np.ascontiguousarray(column, dtype=float).tobytes()).hexdigest()])
    texts.append([type(case.model).__name__, *(e.name for e in case.model.effects), type(case.forcing).__name__])
    leaves = jax.tree_util.tree_leaves_with_path(case)
    texts += [[jax.tree_util.keystr(path), np.asarray(leaf).tolist()] for path, leaf in leaves if eqx.is_array(leaf)]
    return hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:24]


def duration(case: Case, seconds: float | None, periods: float | None) -> Array:
    """Duration of a point's transient [s]: as stated, or a number of periods of its forcing."""
    if seconds is not None:
        return jnp.asarray(seconds, dtype=case.model.drive.omega_0.dtype)
    if periods is None or not hasattr(case.forcing, "omega"):
        raise ValueError("`periods` needs a forcing with a frequency `omega`; give a `duration`")
    return periods * (2.0 * np.pi) / case.forcing.omega  # pyright: ignore[reportFunctionMemberAccess]
