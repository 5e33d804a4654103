"""The first calls in each test file are checked: shapes, types, and that equal names of sizes are equal numbers."""

from dataclasses import dataclass

import numpy as np
import pytest
import shape_checks
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float
from shape_checks import checked

from fitting.estimation.residual import Unknowns
from fitting.estimation.weighing import whitening


@checked(typechecker=beartype)
def stacked(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], kept: int = 2) -> Float[np.ndarray, "n 2"]:
    return np.stack([a, b], axis=1)[:, :kept]


@checked(typechecker=beartype)
@dataclass
class Curve:
    time: Float[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]

    @property
    @checked(typechecker=beartype)
    def slopes(self) -> Float[np.ndarray, " n"]:
        return np.gradient(self.value, self.time).astype(self.value.dtype if len(self.time) < 9 else int)

    @checked(typechecker=beartype)
    @classmethod
    def constant(cls, value: float) -> "Curve":
        return cls(np.arange(3.0), np.full(3, value))


def test_valid_calls_pass():
    assert stacked(np.ones(3), np.ones(3)).shape == (3, 2)
    # Names of sizes hold within a call: another one, also inside, has its own.
    assert stacked(np.ones(4), Curve.constant(2.0).slopes[[0, 1, 2, 0]]).shape == (4, 2)


@pytest.mark.parametrize(
    "call",
    [
        lambda: stacked(np.ones(3), np.ones(4)),
        lambda: stacked(np.ones(3), b=np.ones(3, int)),
        lambda: stacked(np.ones((3, 1)), np.ones(3)),
        lambda: stacked(np.ones(3), np.ones(3), 1),
        lambda: stacked(np.ones(3), np.ones(3), kept=2.0),
        lambda: Curve(np.ones(3), np.ones(4)),
        lambda: Curve(np.arange(9.0), np.ones(9)).slopes,
        lambda: Curve.constant("high"),
        lambda: whitening(np.ones((2, 3))),
        lambda: Unknowns(np.ones(2), np.ones(2)),
    ],
    ids=["sizes", "dtype", "rank", "result", "type", "fields", "property", "classmethod", "function", "module"],
)
def test_invalid_call_is_refused(call):
    with pytest.raises(BeartypeCallHintViolation):
        call()


def test_only_the_first_calls_are_checked(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shape_checks, "MOST", 2)

    @checked(typechecker=beartype)
    def same(a: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return a

    for _ in range(2):
        with pytest.raises(BeartypeCallHintViolation):
            same([1.0])
    assert same([1.0]) == [1.0]
