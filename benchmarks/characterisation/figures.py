"""A JSON document as figures, words and keys, by path."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

# What changes from run to run, or tells of the machine.
_UNTOLD = {"seconds", "versions", "version", "made_by", "start", "date"}
_MOST_NUMBERS = 6
_MOST_LETTERS = 40
# Dictionaries whose keys are names of parameters or stages.
_BY_NAME = {"weights", "units", "changes", "seconds", "std_if_free", "values", "error_over_noise", "draws"}
# What tells one element of a list from another.
_LABELS = ("name", "path", "family", "added", "log")


def is_estimate(value: Any) -> bool:
    """Whether something is a value with its uncertainty."""
    return isinstance(value, Mapping) and "value" in value and ("std" in value or "ci95" in value)


def flattened(value: Any, path: str = "") -> tuple[dict[str, dict], dict[str, str | bool]]:
    """Figures and words of a document.

    Long lists of numbers, long texts and timings are left out.

    Args:
        value: what JSON holds.
        path: of it.

    Returns:
        Figures, each with `value` and, of an estimate, `std`, `ci95` and `identifiable`; short texts and flags.
    """
    figures: dict[str, dict] = {}
    words: dict[str, str | bool] = {}
    for at, leaf in _leaves(value, path):
        if is_estimate(leaf):
            figures[at] = {key: leaf.get(key) for key in ("value", "std", "ci95", "identifiable")}
        elif isinstance(leaf, bool) or (isinstance(leaf, str) and len(leaf) <= _MOST_LETTERS):
            words[at] = leaf
        elif isinstance(leaf, int | float):
            figures[at] = {"value": leaf}
    return figures, words


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        if is_estimate(value):
            yield path, value
            return
        for key, inner in value.items():
            if key not in _UNTOLD:
                yield from _leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        if len(value) > _MOST_NUMBERS and not any(isinstance(v, Mapping | str) for v in value):
            yield f"{path}.length", len(value)
            return
        seen: dict[str, int] = {}
        for index, inner in enumerate(value):
            label = _label(inner, index)
            seen[label] = seen.get(label, 0) + 1
            yield from _leaves(inner, f"{path}[{label}{'' if seen[label] == 1 else f'#{seen[label]}'}]")
    else:
        yield path, value


def _label(element: Any, index: int) -> str:
    if isinstance(element, Mapping):
        for key in _LABELS:
            if isinstance(element.get(key), str):
                return element[key]
    return str(index)


def keys(value: Any, path: str = "") -> set[str]:
    """Paths of all keys; elements of lists count as one, and so do parameters by their names."""
    if isinstance(value, list):
        return set().union(*(keys(inner, f"{path}[]") for inner in value))
    if not isinstance(value, Mapping):
        return set()
    named = path.rpartition(".")[2] in _BY_NAME or (bool(value) and all(map(is_estimate, value.values())))
    found = set()
    for key, inner in value.items():
        at = f"{path}.{'{}' if named else key}" if path else key
        found |= {at} | keys(inner, at)
    return found


def numbers(text: str) -> tuple[dict[str, dict], str]:
    """Numbers of a text in their order, and the text with a mark in the place of each."""
    pattern = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?!\w|\.\d)")
    found = {f"{i}": {"value": float(match.group())} for i, match in enumerate(pattern.finditer(text))}
    return found, " ".join(pattern.sub("#", text).split())
