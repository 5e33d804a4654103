"""What compiled programs depend on besides function, settings and arguments."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import sys
from pathlib import Path

import jax

from hdjax.fingerprint import OWN_PACKAGES, PACKAGES, UnknownCode


def surroundings() -> tuple[str, ...]:
    """Versions, processor and devices.

    Raises:
        UnknownCode: where that can't be told.
    """
    if any(device.platform != "cpu" for device in jax.devices()):
        raise UnknownCode("the programs of other devices depend on drivers and libraries of theirs")
    devices = [f"{d.platform} {d.device_kind} {d.id} {d.process_index}" for d in jax.devices()]
    return (*_versions(), *devices, *_processor(), os.environ.get("XLA_FLAGS", ""))


@functools.cache
def _versions() -> tuple[str, ...]:
    return (sys.version, *(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES))


@functools.cache
def _processor() -> tuple[str, ...]:
    """What the processor can do: code for another one may end the process."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
    except OSError as error:
        raise UnknownCode("only Linux says what its processor can do") from error
    telling = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
    return (platform.machine(), str(os.cpu_count()), *(line for line in lines if line.startswith(telling)))


@functools.cache
def source() -> str:
    """Digest of all source files of this project."""
    digest = hashlib.sha256()
    for package in OWN_PACKAGES:
        found = importlib.util.find_spec(package)
        for folder in [] if found is None else found.submodule_search_locations or []:
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(f"{package}/{path.relative_to(folder)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()
