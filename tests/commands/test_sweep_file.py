"""Sweep files: model, forcing and points that they define, and one sentence for each mistake."""

import numpy as np
import pytest

from fitting.commands.sweep_file import read_sweep_file
from fitting.errors import InputError
from hdjax.sweep.points import Points, drawn

GOOD = """
[drive]
alpha = 50.0
[forcing]
amplitude = 2.0
[axes]
K = { from = 6e3, to = 9e3, points = 4, spacing = "log" }
"forcing.omega" = [300.0, 350.0]
[sample]
points = 5
rule = "sobol"
[sample.ranges]
B_sp = { from = 0.01, to = 1.0, spacing = "log" }
"quadratic_stiffness.k2" = { from = -1.0, to = 1.0 }
[effects.quadratic_stiffness]
k2 = 0.5
[sweep]
response = "steady"
outputs = ["amplitude"]
tolerance = 1e-5
"""


def write_sweep_file(tmp_path, text):
    path = tmp_path / "sweep.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_sweep_file_defines_model_forcing_and_points(tmp_path):
    found = read_sweep_file(write_sweep_file(tmp_path, GOOD))
    assert float(found.model.drive.alpha) == 50.0 and float(found.model.get("quadratic_stiffness.k2")) == 0.5
    assert float(found.forcing.amplitude) == 2.0 and found.request.tolerance == 1e-5
    assert found.request.points.shape == {"K": 4, "forcing.omega": 2, "sample": 5}
    np.testing.assert_allclose(found.request.points.axes["K"], 6e3 * 1.5 ** (np.arange(4) / 3))
    assert np.all(np.abs(found.request.points.sample["quadratic_stiffness.k2"]) <= 1.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[drive]", "[drives]", r"\[drives\] is not known"),
        ("alpha = 50.0", 'preset = "X"', "preset must be one of HDC-40-050, but is 'X'"),
        ("alpha = 50.0", "alpha = true", r"\[drive\] alpha must be a number, but is True"),
        ("alpha = 50.0", "mass = 1.0", r"\[drive\] mass is not known"),
        ("amplitude = 2.0", "torque = 2.0", r"\[forcing\] torque is not known"),
        ("points = 4", "points = 4.5", r"\[axes.K\] points must be a whole number from 1 on, but is 4.5"),
        ("from = 6e3, ", "", r"\[axes.K\] must have `from`"),
        ("from = 6e3", "from = -1.0", "must run from above zero for spacing log"),
        ("[300.0, 350.0]", "[]", "`forcing.omega` must be a list of finite numbers"),
        ('"sobol"', '"dice"', r"\[sample\] rule must be one of"),
        ("[effects.quadratic_stiffness]\nk2 = 0.5", "[effects.dahl]", r"\[effects.dahl\] must have `yield_twist`"),
        ("[effects.quadratic_stiffness]", "[effects.rust]", r"\[effects.rust\] is not an effect"),
        ('"steady"', '"later"', r"\[sweep\] response must be one of"),
        ('["amplitude"]', '["trace"]', "`outputs` of a steady response must be among"),
        ("tolerance = 1e-5", "tolerance = 2.0", "`tolerance` must lie between"),
        ("K = {", '"B_sp" = {', "`B_sp` must be an axis or a column of the sample, but is both"),
        ("[drive]", "[drive", "not a TOML file"),
        ("alpha = 50.0", f"alpha = {'[' * 2000}", "not a TOML file"),
        ("alpha = 50.0", f"alpha = 1{'0' * 400}", r"\[drive\] alpha must be a number"),
        ('"steady"', '["steady"]', r"\[sweep\] response must be one of"),
        (
            "k2 = 0.5",
            "k2 = 0.5\n[effects.backlash]\nb = -1e-4",
            "b must lie within 0",
        ),
    ],
)
def test_invalid_sweep_file_is_refused_in_one_sentence(tmp_path, old, new, words):
    path = write_sweep_file(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as refusal:
        read_sweep_file(path)
    assert str(refusal.value).startswith(str(path)) and "\n" not in str(refusal.value)


def test_byte_order_mark_of_a_sweep_file_is_skipped(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(GOOD, encoding="utf-8-sig")
    assert float(read_sweep_file(path).model.drive.alpha) == 50.0


def test_missing_sweep_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="can't be read"):
        read_sweep_file(tmp_path / "none.toml")


@pytest.mark.parametrize("rule", ["latin-hypercube", "sobol", "random"])
def test_drawn_sample_covers_its_ranges(rule):
    found = drawn({"K": (1.0, 100.0, "log"), "alpha": (-1.0, 3.0, "linear")}, 256, rule=rule)
    assert found["K"].shape == (256,) and found["K"].min() >= 1.0 and found["K"].max() <= 100.0
    # Half of the values are below the geometric and the arithmetic mean, within three standard deviations.
    for below in (found["K"] < 10.0, found["alpha"] < 1.0):
        assert abs(below.mean() - 0.5) < (0.1 if rule == "random" else 0.01)


def test_points_are_numbered_with_the_last_dimension_fastest():
    points = Points({"K": np.array([1.0, 2.0]), "J_l": np.array([3.0, 4.0, 5.0])}, {"alpha": np.array([6.0, 7.0])})
    found = points.values(np.arange(points.size))
    grid = np.meshgrid([1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0], indexing="ij")
    for name, values in zip(("K", "J_l", "alpha"), grid, strict=True):
        np.testing.assert_array_equal(found[name], values.reshape(-1))
