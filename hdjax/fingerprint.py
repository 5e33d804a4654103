"""What an argument is apart from the numbers in its arrays, as text that is the same in every process."""

import enum
import importlib
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

OWN_PACKAGES = ("hdjax", "fitting")
"""Packages of this project."""
PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "lineax", "optimistix", "jaxcont", "numpy", "scipy")
"""Packages of others that a compiled program may come from. Where their versions are known, and the source of our
own, a name stands for the code behind it."""
_KNOWN = {*OWN_PACKAGES, *PACKAGES, "builtins"}

_PLAIN = (bool, int, str, bytes, type(None), type(Ellipsis))
_CONTAINERS = (tuple, list)


class UnknownCode(Exception):
    """Something whose text would not tell what it does: a closure, a lambda, an object of unknown make."""


def fingerprint(value: Any) -> str:
    """Text that differs wherever two arguments could compile to different programs.

    Of an array that is shape, dtype, weak type and place; of a function or class of these packages its name; of a
    module each field; of a number its bits.

    Args:
        value: an argument, or several in containers.

    Raises:
        UnknownCode: where no text would tell.
    """
    return "".join(_parts(value))


def _parts(value: Any) -> Iterator[str]:
    if isinstance(value, jax.Array):
        yield _of_array(value)
    elif isinstance(value, np.ndarray | np.generic):
        yield f"<{type(value).__name__} {value.dtype.str}{value.shape}>"
    elif type(value) in _PLAIN:
        yield f"<{type(value).__name__} {value!r}>"
    elif type(value) is float:
        yield f"<float {value.hex()}>"
    elif type(value) is complex:
        yield f"<complex {value.real.hex()} {value.imag.hex()}>"
    elif type(value) in _CONTAINERS:
        yield f"<{type(value).__name__}"
        for item in value:
            yield from _parts(item)
        yield ">"
    elif type(value) is dict:
        yield from _items("dict", value)
    elif isinstance(value, np.dtype | enum.Enum):
        yield f"<{_name(type(value))} {value}>"
    elif isinstance(value, type | types.FunctionType | types.BuiltinFunctionType | np.ufunc):
        yield f"<{_name(value)}>"
    elif is_dataclass(value) and isinstance(value, eqx.Module):
        yield from _items(_name(type(value)), {f.name: _field(value, f.name) for f in fields(value)})
    else:
        raise UnknownCode(f"{type(value)} has no fingerprint")


def _items(name: str, items: Mapping[Any, Any]) -> Iterator[str]:
    yield f"<{name}"
    for key, item in items.items():
        yield from _parts(key)
        yield "="
        yield from _parts(item)
    yield ">"


def _field(module: eqx.Module, name: str) -> Any:
    """A module's own value of a field; a field that `__init__` left out has its class' one, or none."""
    return vars(module).get(name, getattr(type(module), name, None))


def _of_array(array: jax.Array) -> str:
    weak = "weak" if array.weak_type else "strong"
    held = "held" if array.committed else "free"
    return f"<array {array.dtype}{array.shape} {weak} {held} {_of_sharding(array.sharding)}>"


def _of_sharding(sharding: jax.sharding.Sharding) -> str:
    kind = f"{type(sharding).__name__} {sharding.memory_kind}"
    if isinstance(sharding, jax.sharding.SingleDeviceSharding):
        (device,) = sharding.device_set
        return f"{kind} {device.id}"
    if isinstance(sharding, jax.sharding.NamedSharding) and isinstance(sharding.mesh, jax.sharding.Mesh):
        mesh = sharding.mesh
        places = np.vectorize(lambda device: device.id)(mesh.devices).tolist()
        return f"{kind} {mesh.axis_names} {mesh.axis_types} {places} {sharding.spec}"
    raise UnknownCode(f"{type(sharding)} has no fingerprint")


def _name(thing: type | Callable) -> str:
    """The name under which a known package offers a class or function."""
    module, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module.split(".")[0] not in _KNOWN:
        raise UnknownCode(f"{thing!r} is of an unknown package")
    found: Any = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not thing:
        raise UnknownCode(f"{thing!r} is not what {module} calls {name}")
    return f"{module}.{name}"
