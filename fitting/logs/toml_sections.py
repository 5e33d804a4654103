"""Sections of a TOML file and their keys, with one-sentence errors."""

import sys
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from fitting.errors import InputError


class Sections:
    """A TOML file's tables by name; errors name file, section and key."""

    def __init__(self, path: Path, names: Collection[str]):
        self.path = path
        try:
            self._content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise InputError(f"{path}: the file can't be read ({error.strerror}); check the path") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: not a TOML file, correct it: {' '.join(str(error).split())}") from error
        self.known("", self._content, names)

    def section(self, name: str) -> dict[str, Any]:
        """A table of the file; empty where it is absent."""
        return self.table(name, self._content.get(name, {}))

    def refuse(self, message: str) -> InputError:
        """An error about this file."""
        return InputError(f"{self.path}: {message}")

    def table(self, name: str, value: object) -> dict[str, Any]:
        """A value that must be a table."""
        if not isinstance(value, dict):
            raise self.refuse(f"[{name}] must be a table, but is {value!r}")
        return value

    def known(self, section: str, table: Mapping[str, Any], names: Collection[str]) -> None:
        """Refuse unknown keys."""
        for key in table:
            if key not in names:
                where = f"[{section}] {key}" if section else f"[{key}]"
                raise self.refuse(f"{where} is not known; known are {', '.join(names)}")

    def needs(self, section: str, table: Mapping[str, Any], names: Collection[str]) -> None:
        """Refuse a table that lacks a key."""
        for key in names:
            if key not in table:
                raise self.refuse(f"[{section}] must have `{key}`")

    def number(self, section: str, key: str, value: object) -> float:
        """A finite number."""
        # Integers of TOML may be larger than any float.
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
            raise self.refuse(f"[{section}] {key} must be a number, but is {value!r}")
        return float(value)

    def numbers(self, section: str, table: Mapping[str, Any], names: Collection[str]) -> dict[str, float]:
        """Finite numbers under known keys."""
        self.known(section, table, names)
        return {key: self.number(section, key, value) for key, value in table.items()}

    def count(self, section: str, key: str, value: object, least: int = 1) -> int:
        """A whole number, at least `least`."""
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.refuse(f"[{section}] {key} must be a whole number from {least} on, but is {value!r}")
        return value

    def one_of(self, section: str, key: str, value: object, names: Collection[str]) -> Any:
        """One of several words."""
        if not isinstance(value, str) or value not in names:
            raise self.refuse(f"[{section}] {key} must be one of {', '.join(names)}, but is {value!r}")
        return value
