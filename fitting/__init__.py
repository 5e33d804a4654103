"""Identification of harmonic drives from measured logs.

    print(fitting.inspect("run1.csv").summary())
    data = fitting.load(["run1.csv", "run2.csv"], drive="drive.toml")
    fit = fitting.fit(data)
    loop = fitting.close_loop(data)
    prediction = fitting.predict("report/model.json", other)

The first use of a name imports JAX, which takes a second or two.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.api.data import Data as Data
    from fitting.api.data import load as load
    from fitting.api.inspection import InspectionResult as InspectionResult
    from fitting.api.inspection import inspect as inspect
    from fitting.api.prediction import Comparison as Comparison
    from fitting.api.prediction import Prediction as Prediction
    from fitting.api.prediction import compare as compare
    from fitting.api.prediction import predict as predict
    from fitting.api.results import FitResult as FitResult
    from fitting.api.results import LoopResult as LoopResult
    from fitting.api.verbs import close_loop as close_loop
    from fitting.api.verbs import fit as fit
    from fitting.errors import DataError as DataError
    from fitting.errors import InputError as InputError
    from fitting.search_options import SearchOptions as SearchOptions
    from fitting.stored_model import StoredModel as StoredModel

_HOMES = {
    "api.data": ("Data", "load"),
    "api.inspection": ("InspectionResult", "inspect"),
    "api.prediction": ("Comparison", "Prediction", "compare", "predict"),
    "api.results": ("FitResult", "LoopResult"),
    "api.verbs": ("close_loop", "fit"),
    "errors": ("DataError", "InputError"),
    "search_options": ("SearchOptions",),
    "stored_model": ("StoredModel",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Comparison",
    "Data",
    "DataError",
    "FitResult",
    "InputError",
    "InspectionResult",
    "LoopResult",
    "Prediction",
    "SearchOptions",
    "StoredModel",
    "close_loop",
    "compare",
    "fit",
    "inspect",
    "load",
    "predict",
]


def __getattr__(name: str) -> Any:
    # The command line shows `--help` without JAX.
    if name == "__version__":
        return import_module("importlib.metadata").version("hdjax")
    if name not in _HOME:
        raise AttributeError(f"module 'fitting' has no attribute '{name}'")
    return getattr(import_module(f"fitting.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
