"""Signals, units and signs detected in logs as common robots, drives and loggers export them."""

import pytest
from joint_logs import SHAPES
from simulated_joint import simulated

import fitting


@pytest.fixture(scope="module")
def motion():
    return simulated()


@pytest.mark.parametrize("name", SHAPES)
def test_signals_of_an_exported_log_are_detected(name: str, motion):
    shape = SHAPES[name]
    found = fitting.inspect(shape.columns(motion), joint=shape.joint).inspection
    guesses = {guess.column: (signal, guess) for signal, guess in found.joint.signals.items()}
    for column, (signal, unit, sign) in shape.signals.items():
        assert column in guesses, (column, found.joint.open, list(guesses))
        told, guess = guesses[column]
        assert (told, guess.sign) == (signal, sign), column
        assert guess.unit == unit, column
    assert not set(shape.open) & set(guesses)
    for column, shares in found.joint.open.items():
        assert 0.0 < sum(shares.values()) < 1.001, (column, shares)
    ratio = found.joint.ratio
    if shape.ratio is None:
        assert ratio is None
    else:
        assert ratio is not None and ratio.value == shape.ratio
    if shape.time is not None:
        assert found.time.column == shape.time
