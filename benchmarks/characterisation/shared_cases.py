"""The groups `practice` and `convergence`: logs of the shared folder, and fits without starting values."""

from characterisation.case import Case, words

_LOGS = (
    "backlash-7 boucwen-7 clean_multisine-7 clean_slow-7 coulomb_motor-7 delay-7 gravity-7 kinematic_2-7 "
    "pair_ke_friction-7 quadratic-7 third_inertia-7 three_slope-7"
)
# Made by another simulator: no loop on them has ended yet.
_ENDLESS = "mj_load_friction-207 mj_motor_friction-207"
_LONG, _SHORT = 1800.0, 300.0


def practice_cases() -> list[Case]:
    """The loop on each practice log and a prediction of its held-out log, then measured data."""
    found = [case for name in _LOGS.split() for case in _practice(name, _LONG)]
    lara = (("ML1_validate", 2), ("ML1_validate", 3), ("ML1_validate", 5), ("ML2_jogging_joint_mass", 2))
    for log, joint in lara:
        path = f"{{shared}}/data/lara8/{log}.csv"
        found += _both(f"lara8-{log.split('_')[0].lower()}-joint-{joint}", path, f"lara_{joint}")
    found += _both("bouc-wen", "{shared}/data/bouc_wen/estimation.h5", "bouc_wen")
    found += _both("silverbox", "{shared}/data/silverbox/silverbox_estimation.mat", "silverbox")
    return found + [case for name in _ENDLESS.split() for case in _practice(name, _SHORT)]


def _practice(name: str, timeout: float) -> list[Case]:
    folder = f"{{shared}}/logs/{name}"
    loop, held_out = f"practice-{name}", f"{folder}/heldout.csv"
    drive = f"--drive {folder}/drive.toml"
    line = f"close-loop {folder}/train_1.csv {folder}/train_2.csv {drive} --out {{out}}"
    model = f"{{outs}}/{loop}/model.json"
    predict = f"predict {model} {held_out} {drive} --out {{out}}/prediction.csv"
    return [
        Case(loop, "practice", words(line), timeout=timeout),
        Case(f"{loop}-heldout", "practice", words(predict), after=(loop,), measured=held_out),
    ]


def _both(name: str, log: str, drive: str) -> list[Case]:
    options = f"{log} --drive {{inputs}}/{drive}.toml --out {{out}}"
    return [
        Case(f"{verb}-{name}", "practice", words(f"{verb} {options}"), timeout=_LONG) for verb in ("fit", "close-loop")
    ]


_SETTINGS = {
    "white": "--seed 0 --draws 12 --short",
    "coloured": "--seed 1 --draws 8 --short --colour 0.3",
    "outliers": "--seed 2 --draws 8 --short --outliers 0.01",
    "whole-log": "--seed 3 --draws 6",
}


def convergence_cases() -> list[Case]:
    """Drives and logs drawn at random, by the checkout's own benchmark."""
    script = "{repo}/benchmarks/convergence.py"
    return [
        Case(
            f"convergence-{name}",
            "convergence",
            words(f"{script} {options} --out {{out}}/draws.jsonl"),
            runs="script",
            modules=("numba",),
            timeout=3600.0,
        )
        for name, options in _SETTINGS.items()
    ]
