"""Sentences, units and rounded numbers in reports."""

import math
import sys
from typing import Any, Literal

import numpy as np
import pytest

from fitting import formatting
from fitting.attribution.decisions import tie
from fitting.report import separating_experiment
from fitting.report.fit_text import rounded
from fitting.report.intervals import is_withheld, say_what_intervals_hold
from fitting.report.rules import rules_dict
from fitting.report.summary import _change, _remembering, gain
from fitting.report.tables import parameter_rows
from hdjax.effects import FAMILIES


def test_sentences_use_the_units_of_a_reduced_log():
    sentence = "alpha is at most 2 1/[x]^2, and gain 3 [x]/s^2/[u]"
    assert formatting.in_log_words(sentence, response="V", forcing="N m") == (
        "alpha is at most 2 1/V^2, and gain 3 V/s^2/(N m)"
    )
    assert formatting.superscripts("K^-2 and omega_0^-2.1") == "K⁻² and omega_0^-2.1"


def test_separating_experiment_exists_and_is_symmetric_for_every_pair():
    """Without an experiment for the pair there is a hint for each family, in the order of the two."""

    def hints(one: str, other: str) -> list[str]:
        return sorted(separating_experiment(one, other).lower().rstrip(".").split("; "))

    for one in FAMILIES:
        for other in FAMILIES:
            assert hints(one, other) == hints(other, one)
            assert len(separating_experiment(one, other)) > 20


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (1.05e-6, "rad", "1.05 µrad"),
        (-0.0123, "N m", "−12.3 mN m"),
        (2.0, "rad", "2.00 rad"),
        (1.2e5, "rad^-2", "120 000 rad⁻²"),
        (3.4e-7, "N m s/rad", "3.40 × 10⁻⁷ N m s/rad"),
        (0.0, "1", "0"),
        (None, "rad", "—"),
        (math.nan, "rad", "—"),
    ],
)
def test_quantity_is_formatted_with_its_unit(value: float | None, unit: str, shown: str):
    assert formatting.quantity(value, unit).replace("\N{NARROW NO-BREAK SPACE}", " ") == shown


def test_value_is_rounded_to_its_standard_error():
    def shown(*args) -> str:
        return formatting.measured(*args).replace("\N{NARROW NO-BREAK SPACE}", " ")

    assert shown(17432.123, 12.3, "N m/rad") == "17 432 ± 12 N m/rad"
    assert shown(1.2345e7, 3.4e4, "rad^-2") == "(1.2345 ± 0.0034) × 10⁷ rad⁻²"
    assert shown(4.05e-5, 1.2e-8, "rad") == "40.500 ± 0.012 µrad"
    assert shown(0.3, None, "rad") == "300.0 mrad"


@pytest.mark.parametrize(
    ("unit", "place", "shown"),
    [
        ("N m", "mesh", "V/s^2"),
        ("N m", "actuator", "A"),
        ("N m s^2/rad^2", "mesh", "1/V"),
        ("rad^-4", "mesh", "1/V^4"),
        ("rad/s", "mesh", "V/s"),
        ("rad/s", "drive", "rad/s"),
        ("[x]/s^2/[u]", "drive", "V/(s^2 A)"),
        ("1/[x]^2", "drive", "1/V^2"),
        ("1", "mesh", "1"),
    ],
)
def test_units_are_converted_to_those_of_a_reduced_log(
    unit: str, place: Literal["drive", "mesh", "actuator"], shown: str
):
    """In a reduced log, mesh torque is an acceleration of the response, and actuator torque is the forcing."""
    assert formatting.in_log_units(unit, response="V", forcing="A", place=place) == shown


@pytest.mark.parametrize(("share", "shown"), [(0.98, "98 %"), (0.9996, "99.96 %"), (-0.013, "−1.3 %"), (1.0, "100 %")])
def test_share_below_one_is_not_rounded_to_100_percent(share: float, shown: str):
    assert formatting.percent(share) == shown


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (2e-6, "It removes 80 % of the error on test data, which falls from 10"),
        (3e-5, "It explains short segments alone; over whole stretches of test data the error rises from 10"),
        (None, "to a simulation that diverged."),
    ],
)
def test_summary_states_no_gain_where_the_error_rises(after: float | None, said: str):
    assert said in _change("It", _report_with_errors(1e-5, after, motor=(None, None)))


@pytest.mark.parametrize(
    ("after", "motor", "said"),
    [
        (
            8.7e-7,
            (0.2, 1e-4),
            "It affects the motor's angle, whose error on test data falls by 99.95 %, from 200 mrad to 0.1",
        ),
        (8.8e-7, (0.2, 1e-4), "It affects the motor's angle"),
        (8.7e-7, (None, 1e-4), "from a simulation that diverged to 100 µrad"),
        (8.7e-7, (0.2, 0.2), "It removes 0 % of the error on test data"),
        (1e-7, (0.2, 1e-4), "It removes 89 % of the error on test data"),
    ],
)
def test_summary_states_the_motor_angle_error_where_the_dynamic_error_is_unchanged(
    after: float, motor: tuple[float | None, float], said: str
):
    assert said in _change("It", _report_with_errors(8.7e-7, after, motor=motor))


def test_summary_claims_no_change_where_free_runs_diverge_before_and_after():
    said = _change("It", _report_with_errors(None, None, motor=(None, None)))
    assert said == "It explains short segments alone: free runs along test data diverge before and after."


def test_summary_claims_no_share_where_free_runs_diverged_before():
    said = _change("Together they", _report_with_errors(None, 2e-6, motor=(None, None)), several=True)
    assert said.startswith("Together they keep free runs along test data from diverging; the error is 2")
    assert "falls" not in said


def test_values_are_rounded_to_the_second_digit_of_their_error():
    assert rounded([2113436.0, None], 4.5e5) == ["2110000", "n/a"]
    assert rounded([0.07614634681, 0.0761463485], 8.6e-10) == ["0.07614634681", "0.07614634850"]


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (0.5, "with it the error of free runs on selection data is 50 % smaller than without"),
        (1.0, "free runs on selection data diverge without it, but not with it"),
        (None, "free runs on selection data diverge with it"),
    ],
)
def test_gain_is_told_in_words(share: float | None, said: str):
    assert gain({"gain": share}) == said


@pytest.mark.parametrize(
    ("memory", "said"),
    [
        (0.028, "correlation time of about 28 ms"),
        (1400.0, "correlation time of more than the logs' length"),
        (None, ""),
    ],
)
def test_summary_states_the_correlation_time_of_the_noise(memory: float | None, said: str):
    sentence = _remembering({"noise": {"memory": memory}, "logs": [{"seconds": 8.0}, {"seconds": 6.0}]})
    assert said in sentence and bool(sentence) == (memory is not None)


def _report_with_errors(
    before: float | None, after: float | None, *, motor: tuple[float | None, float | None]
) -> dict[str, Any]:
    stages = zip(("before", "after"), (before, after), motor, strict=True)
    found = {s: {"rmse": {"test": x}, "rmse_motor_angle": {"test": m}} for s, x, m in stages}
    told = {"output": "dynamic_error", "units": {"dynamic_error": "rad"}, "noise": {"dynamic_error": 1e-6}}
    return found | told | {"judged_on": "test"}


@pytest.mark.parametrize(
    ("decision", "times_noise", "beyond", "withheld", "flagged"),
    [
        ("effect_found", 1.1, None, False, False),
        ("effect_found", 2.7, 1.0, False, True),
        ("effect_found", 1.1, 4.0, False, True),
        ("effect_found", 1.1, sys.float_info.max, False, True),
        ("unexplained", 44.0, None, True, True),
        ("unexplained", 1.1, None, False, True),
    ],
)
def test_intervals_are_withheld_or_flagged_where_the_residual_or_the_error_of_free_runs_is_large(
    decision: str, times_noise: float, beyond: float | None, withheld: bool, flagged: bool
):
    report = _uncertain_report(decision, None, times_noise, beyond)
    say_what_intervals_hold(report)
    K = report["after"]["parameters"]["K"]
    assert (K["ci95"] == [None, None]) == withheld == is_withheld(report["after"]["derived"]["omega_0"])
    assert (K["flag"] is not None) == (K["note"] is not None) == flagged
    assert not flagged or "K may be off" in K["note"]


def _uncertain_report(
    decision: str, unknown: dict[str, str] | None, times_noise: float, beyond: float | None = None
) -> dict[str, Any]:
    accounts = {"before": _account(), "after": _account()}
    # Infinity, which the evidence keeps as the largest number.
    told = None if beyond == sys.float_info.max else beyond
    evidence = {"final": {"surprise": beyond, "replaced": False}}
    known = {"times_noise": times_noise, "free_runs_times_expected": told, "evidence": evidence}
    return {"decision": decision, "unknown": unknown, "parameters_from": "torque"} | known | accounts


@pytest.mark.parametrize("learned", [None, {"place": "mesh", "quantity": "torque"}])
def test_intervals_of_one_side_are_stated_where_the_residual_is_large(learned: dict[str, str] | None):
    report = _uncertain_report("unexplained", learned, 44.0) | {"parameters_from": "load equation"}
    say_what_intervals_hold(report)
    assert report["after"]["parameters"]["K"] == _account()["parameters"]["K"]
    assert is_withheld(report["before"]["parameters"]["K"])


@pytest.mark.parametrize(
    ("place", "quantity", "withheld"), [("mesh", "torque", True), ("mesh", "error", False), ("load", "torque", False)]
)
def test_intervals_beside_a_learned_torque_in_the_mesh_are_withheld(place: str, quantity: str, withheld: bool):
    learned = {"place": place, "quantity": quantity}
    report = _uncertain_report("unexplained", learned, 1.0)
    say_what_intervals_hold(report)
    assert is_withheld(report["after"]["parameters"]["K"]) == withheld
    assert not is_withheld(report["before"]["parameters"]["K"])


def _account() -> dict[str, Any]:
    parameter = {"ci95": [1.0, 2.0], "interval": "quadratic", "flag": None, "note": None}
    return {"parameters": {"K": dict(parameter)}, "derived": {"omega_0": dict(parameter)}}


def test_tie_is_told_with_the_unit_of_its_statistic():
    (rule,) = rules_dict([tie("rival", np.array([1.0, 1.1, 0.9]))])
    assert rule["unit"] == "standard errors" and "p-value" not in rule["meaning"]
    assert rule["threshold"] > 1.0


@pytest.mark.parametrize(("path", "symbol"), [("K", "K(1 + 3 α x²)"), ("omega_0", "ω₀²(1 + 3 α x²)")])
def test_reduced_log_has_no_stiffness(path: str, symbol: str):
    entry = {"value": 1.0, "std": 0.1, "unit": "1", "flag": None, "description": ""}
    account = {"parameters": {path: entry}, "derived": {"stiffness_at_full_twist": entry}}
    _, row = parameter_rows({"before": account}, account)
    assert row["symbol"] == symbol
