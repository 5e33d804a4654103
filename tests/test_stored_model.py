"""`model.json` restores the model that was written; any other file is refused in one sentence."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.errors import InputError
from fitting.stored_model import StoredModel, read_model, to_json
from hdjax import HOLDS, Model, TwoInertiaModel
from hdjax.effects import CATALOGUE, Effect, Scales
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.stiffness import QuadraticStiffness

SCALES = Scales(
    x=5e-4,
    x_max=2e-3,
    v=0.1,
    omega_m=40.0,
    omega_l=0.8,
    time_step=5e-4,
    temperature=300.0,
    temperature_change=2.0,
    residual_frequencies=(90.0, 400.0),
)


def stored(model: Model, hold: str = "zero-order") -> StoredModel:
    noise = jnp.asarray([[1.1e-12, 3e-13], [3e-13, 0.9e-12]]) if isinstance(model, TwoInertiaModel) else jnp.eye(1)
    return StoredModel(model, hold, 3, 7, noise, (0.0, 1.0 / 3.0))


def assert_same(found: StoredModel, wanted: StoredModel):
    settings = [(one.hold, one.substeps, one.halo, one.zeros) for one in (found, wanted)]
    assert settings[0] == settings[1]
    np.testing.assert_array_equal(found.noise, wanted.noise)
    assert type(found.model) is type(wanted.model)
    assert [type(e) for e in found.model.effects] == [type(e) for e in wanted.model.effects]
    known = found.model.parameters()
    assert list(known) == list(wanted.model.parameters())
    for path, (value, _) in wanted.model.parameters().items():
        # Bit for bit: JSON keeps every digit.
        assert float(known[path][0]) == float(value), path


def round_trip(wanted: StoredModel, folder: Path) -> StoredModel:
    path = folder / "model.json"
    path.write_text(to_json(wanted), encoding="utf-8")
    return read_model(path)


@pytest.mark.parametrize("form", CATALOGUE, ids=lambda form: form.name)
def test_model_of_every_form_survives_the_round_trip(form: type[Effect], tmp_path: Path):
    bases = [rig.drive_model(K=1e4 / 3)] + ([] if form.needs_motor else [rig.reduced_model(mu=1 / 3)])
    for base in bases:
        whole = base.with_effects(form.proposals(SCALES)[0])
        own = [p for p in whole.parameters() if p.startswith(form.name)]
        # Irrational numbers, all different.
        filled = whole.replace({p: (i + 1) * np.pi * 1e-5 for i, p in enumerate(own)})
        wanted = stored(filled)
        assert_same(round_trip(wanted, tmp_path), wanted)


@pytest.mark.parametrize("hold", HOLDS)
def test_model_without_and_with_effects_survives_the_round_trip(hold: str, tmp_path: Path):
    for effects in ((), (QuadraticStiffness(k2=3.0), BoucWen(k=10.0, memory_twist=1e-4, n=1.5))):
        wanted = stored(rig.drive_model().with_effects(*effects), hold)
        assert_same(round_trip(wanted, tmp_path), wanted)


def changed_content(change) -> str:
    content = json.loads(to_json(stored(rig.drive_model().with_effects(QuadraticStiffness(k2=3.0)))))
    change(content)
    return json.dumps(content)


BROKEN = {
    "empty": "",
    "not JSON": "{",
    "a list": "[]",
    "null": "null",
    "other schema": changed_content(lambda c: c.update(schema="hdjax-report/1")),
    "no drive": changed_content(lambda c: c.pop("drive")),
    "drive without K": changed_content(lambda c: c["drive"].pop("K")),
    "drive with more": changed_content(lambda c: c["drive"].update(colour=3.0)),
    "K is text": changed_content(lambda c: c["drive"].update(K="stiff")),
    "unknown effect": changed_content(lambda c: c["effects"][0].update(name="magic")),
    "effect without its name": changed_content(lambda c: c["effects"][0].pop("name")),
    "effects are text": changed_content(lambda c: c.update(effects="none")),
    "unknown hold": changed_content(lambda c: c.update(torque_hold="first-order")),
    "noise too small": changed_content(lambda c: c.update(noise_covariance=[[1.0]])),
    "noise not finite": changed_content(lambda c: c.update(noise_covariance=[[1.0, 0.0], [0.0, float("nan")]])),
    "noise ragged": changed_content(lambda c: c.update(noise_covariance=[[1.0, 0.0], [0.0]])),
    "no substeps": changed_content(lambda c: c.pop("substeps")),
    "kind of another drive": changed_content(lambda c: c.update(kind="reduced")),
    "unknown kind": changed_content(lambda c: c.update(kind="three-inertia")),
}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN.keys())
def test_invalid_model_file_is_refused_in_one_sentence(text: str, tmp_path: Path):
    path = tmp_path / "model.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_model(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "give the model.json of a report" in message
    assert "\n" not in message


OUT_OF_RANGE = {
    "K not finite": lambda c: c["drive"].update(K=float("nan")),
    "K negative": lambda c: c["drive"].update(K=-1.0),
    "no substeps": lambda c: c.update(substeps=0),
    "negative halo": lambda c: c.update(halo=-1),
    "noise indefinite": lambda c: c.update(noise_covariance=[[-1.0, 0.0], [0.0, 1.0]]),
}


@pytest.mark.parametrize("change", OUT_OF_RANGE.values(), ids=OUT_OF_RANGE.keys())
def test_model_with_values_out_of_range_is_refused(change, tmp_path: Path):
    path = tmp_path / "model.json"
    path.write_text(changed_content(change), encoding="utf-8")
    with pytest.raises(InputError):
        read_model(path)


def test_missing_model_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="the model can't be read"):
        read_model(tmp_path / "absent.json")


def test_model_with_invalid_numbers_is_not_written():
    with pytest.raises(ValueError):
        to_json(stored(rig.drive_model(K=float("nan"))))
