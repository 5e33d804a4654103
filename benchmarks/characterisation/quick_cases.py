"""The commands of the group `quick`: every verb, every format, every kind of log, and bad input."""

from characterisation.case import Case, words

_VERBS = "fit close-loop predict simulate sweep design demo amplitudes seed-tables speeds".split()


def _quick(name: str, line: str, **options) -> Case:
    return Case(name, "quick", words(line), **options)


def quick_cases() -> list[Case]:
    """All of them; a case comes behind those whose results it takes."""
    return [*_about(), *_fits(), *_loops(), *_predictions(), *_simulations(), *_without_logs(), *_probes(), *_bad()]


def _about() -> list[Case]:
    cases = [_quick("version", "--version", printed=True), _quick("help", "--help")]
    return cases + [_quick(f"help-{verb}", f"{verb} --help") for verb in _VERBS]


def _fit(name: str, logs: str, drive: str = "drive", more: str = "", **options) -> Case:
    paths = " ".join("{inputs}/" + log for log in logs.split())
    return _quick(name, f"fit {paths} --drive {{inputs}}/{drive}.toml --out {{out}} {more}", **options)


def _fits() -> list[Case]:
    return [
        _fit("fit-csv", "base.csv"),
        _fit("fit-csv-gz", "base.csv.gz"),
        _fit("fit-tsv", "base.tsv"),
        _fit("fit-mat-5", "base_5.mat"),
        _fit("fit-mat-73", "base_73.mat"),
        _fit("fit-hdf5", "base.h5"),
        _fit("fit-parquet", "base.parquet"),
        _fit("fit-mdf", "base.mf4", modules=("asammdf",)),
        _fit("fit-units", "units.csv", "drive_units"),
        _fit("fit-two-logs", "base.csv other.csv"),
        _fit("fit-load-torque", "brake.csv"),
        _fit("fit-gap", "gap.csv"),
        _fit("fit-ugly", "ugly.csv"),
        _fit("fit-hold-linear", "hold_linear.csv", "drive_linear"),
        _fit("fit-hold-cubic", "hold_cubic.csv", "drive_cubic"),
        _fit("fit-hold-band-limited", "hold_band-limited.csv", "drive_band"),
        _fit("fit-reduced", "reduced_plain.csv", "reduced"),
        _fit("fit-quasi-static", "cycles.csv", "static"),
        _fit("fit-quasi-static-line", "line.csv", "static"),
        _fit("fit-fleet", "fleet"),
        _fit("fit-fleet-workers", "fleet", more="--workers 1", modules=("distributed",)),
        _fit("fit-next-experiment", "small.csv", more="--next-experiment --largest-twist 2e-3 --duration 0.5"),
        _fit("fit-posterior", "base.csv", more="--posterior --seed 1", modules=("blackjax",)),
    ]


def _loop(name: str, logs: str, drive: str = "drive", more: str = "") -> Case:
    paths = " ".join("{inputs}/" + log for log in logs.split())
    return _quick(f"loop-{name}", f"close-loop {paths} --drive {{inputs}}/{drive}.toml --out {{out}} {more}")


def _loops() -> list[Case]:
    return [
        _loop("sufficient", "base.csv other.csv"),
        _loop("kinematic-error", "kinematic_1.csv kinematic_2.csv"),
        _loop("disturbance-phases", "disturbed_1.csv disturbed_2.csv"),
        _loop("load-torque", "brake.csv"),
        _loop("temperature", "warm.csv", "drive_celsius"),
        _loop("unnamed", "wavy.csv"),
        _loop("hold-not-stated", "hold_linear.csv", "drive_no_hold"),
        _loop("no-effects", "kinematic_1.csv", more="--max-effects 0"),
        _loop("reduced", "reduced_bent.csv", "reduced"),
        _loop("quasi-static", "cycles.csv", "static", "--max-effects 2"),
        _loop("next-experiment", "reduced_bent.csv", "reduced", "--next-experiment --duration 0.5"),
        _quick("demo", "demo --out {out}"),
    ]


def _predict(name: str, model: str, log: str, drive: str = "drive", **options) -> Case:
    line = f"predict {model} {{inputs}}/{log} --drive {{inputs}}/{drive}.toml --out {{out}}/prediction.csv"
    return _quick(f"predict-{name}", line, **options)


def _predictions() -> list[Case]:
    fitted, warm = "{outs}/fit-csv/model.json", "{outs}/loop-temperature/model.json"
    other = "{inputs}/other.csv"
    return [
        _predict("fitted", fitted, "other.csv", after=("fit-csv",), measured=other),
        _predict("gap", fitted, "gap.csv", after=("fit-csv",)),
        _predict("warm", warm, "warm.csv", "drive_celsius", after=("loop-temperature",), measured="{inputs}/warm.csv"),
        _predict("warm-without-temperature", warm, "base.csv", after=("loop-temperature",)),
        _predict("old-model", "{inputs}/old_model.json", "other.csv", measured=other),
        _predict("old-kinematic", "{inputs}/old_kinematic.json", "other.csv", measured=other),
        _predict("old-learned", "{inputs}/old_learned.json", "other.csv", measured=other),
        _predict("old-reduced", "{inputs}/old_reduced.json", "reduced_bent.csv", "reduced"),
        _predict("other-kind", "{inputs}/old_reduced.json", "base.csv"),
        _predict("quasi-static", "{inputs}/old_model.json", "cycles.csv", "static"),
        _predict("broken-model", "{inputs}/broken_model.json", "base.csv"),
        _predict("missing-model", "{inputs}/absent.json", "base.csv"),
    ]


def _simulations() -> list[Case]:
    model = "--model {inputs}/old_kinematic.json"
    return [
        _quick("simulate-multisine", "simulate --out {out}/log.csv --duration 1 --noise 1e-6 --seed 3"),
        _quick("simulate-chirp", f"simulate --out {{out}}/log.csv --duration 1 --forcing chirp {model}"),
        _quick("simulate-harmonic", "simulate --out {out}/log.csv --duration 0.5 --forcing harmonic --frequency 40"),
        _quick("simulate-reduced", "simulate --out {out}/log.csv --duration 0.5 --model {inputs}/old_reduced.json"),
        _quick("simulate-unknown-preset", "simulate --out {out}/log.csv --preset HDC-0"),
    ]


def _without_logs() -> list[Case]:
    store = {"modules": ("xarray", "zarr"), "printed": True}
    return [
        _quick("amplitudes", "amplitudes --out {out}", timeout=900.0),
        _quick("seed-tables", "seed-tables", printed=True),
        _quick("speeds", "speeds --B_sp 0.5 --alpha 1e5 --out {out}"),
        _quick("speeds-model", "speeds --model {inputs}/old_kinematic.json --fastest 2500 --out {out}"),
        _quick("sweep-steady", "sweep {inputs}/sweep_steady.toml --out {out}", **store),
        _quick("sweep-transient", "sweep {inputs}/sweep_transient.toml --out {out} --no-plot", **store),
        _quick("sweep-sample", "sweep {inputs}/sweep_sample.toml --out {out} --workers 1", **store),
        _quick("sweep-bad", "sweep {inputs}/sweep_unknown_key.toml --out {out}"),
        _quick("design-closed", "design {inputs}/design_closed.toml --out {out}"),
        _quick("design-infeasible", "design {inputs}/design_infeasible.toml --out {out} --no-plot"),
        _quick("design-response", "design {inputs}/design_response.toml --out {out}"),
        _quick("design-old-report", "design {inputs}/design_report.toml --out {out}"),
    ]


def _probes() -> list[Case]:
    return [
        Case(f"probe-{name}", "quick", (name,), runs="probe", printed=True)
        for name in ("compensation", "swept-sine", "floquet")
    ]


_BAD_LOGS = (
    "empty.csv header.csv column.csv nan.csv blank_angle.csv torque_unit.csv degrees.csv sides.csv sign.csv "
    "milliseconds.csv constant.csv short.csv cut.h5 text.csv format.xyz mdf.mf4"
)

_HYPHENS = str.maketrans("._", "--")


def _bad() -> list[Case]:
    logs = [_fit(f"bad-{log.translate(_HYPHENS)}", f"bad_{log}") for log in _BAD_LOGS.split()]
    drives = [
        _fit(f"bad-drive-{name.translate(_HYPHENS)}", "base.csv", f"drive_{name}")
        for name in ("wrong_ratio", "no_inertia", "unknown_key", "not_toml", "absent")
    ]
    return [
        *logs,
        *drives,
        _fit("bad-missing-log", "absent.csv"),
        _fit("bad-option", "base.csv", more="--colour 3"),
        _fit("bad-limits", "base.csv", more="--largest-torque 3"),
        _fit("bad-fleet-option", "fleet", more="--next-experiment"),
        _fit("bad-static-next", "cycles.csv", "static", "--next-experiment"),
        _loop("bad-max-effects", "base.csv", more="--max-effects -1"),
        _quick("bad-out", "speeds --out {inputs}/base.csv"),
        _quick("bad-verb", "explain"),
    ]
