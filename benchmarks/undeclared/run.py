"""The study: draw cases, run the loop on each, print what came of it. See benchmarks/README.md.

    python benchmarks/undeclared/run.py --cases 200 --clean 100 --pairs 40 --seed 0 --out study

A case that has its JSON in the folder is not run again.
"""

# ruff: noqa: E402

import os

# XLA reads this once, when jax loads; it would warn at length of tuning flags in compiled programs that were kept.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import argparse
import json
import sys
import tempfile
from pathlib import Path

import jax

sys.path.insert(0, str(Path(__file__).parents[1]))

from fitting.files import write_whole
from undeclared.drawing import (
    Case,
    NoExperimentError,
    clean_cases,
    draw,
    pair_cases,
    single_cases,
    with_noisy_torque,
    with_remembering_noise,
)
from undeclared.hidden import FAMILIES
from undeclared.recording import record
from undeclared.sindy import sindy_is_there
from undeclared.tally import in_proportion, tables, verdict
from undeclared.trial import run_case


def main() -> None:
    """Run the cases that have no result yet, and print the tables."""
    args = _arguments()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", min(os.cpu_count() or 1, 8))
    if args.cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(args.cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    if args.baselines and not args.markdown and not sindy_is_there():
        print("PySINDy is not installed, so that it is left out; pip install -e '.[sindy]' brings it")
    cases = _cases(args)
    results, pairs = [], []
    for number, case in enumerate(cases, start=1):
        path = _result_path(args.out, case, args, thorough=args.thorough)
        if not path.exists() and not args.markdown:
            try:
                result = _run(case, args)
            except NoExperimentError as error:
                print(f"{number:4d} of {len(cases)}  not drawn: {error}", flush=True)
                continue
            # A process may map only so much memory, and each program takes some; what is kept on disk stays.
            jax.clear_caches()
            write_whole({path: json.dumps(result, indent=1, allow_nan=False) + "\n"})
            print(f"{number:4d} of {len(cases)}  {_line(result)}", flush=True)
        done, plain = _read(path), _read(_result_path(args.out, case, args, thorough=False))
        if done is not None:
            results.append(done)
            if args.thorough and plain is not None:
                pairs.append((plain, done))
    for table in (*tables(results), *([in_proportion(pairs)] if pairs else [])):
        print("\n" + table.text(markdown=args.markdown))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=0, help="with one hidden effect each, the families in turn")
    parser.add_argument("--clean", type=int, default=0, help="with nothing hidden, white and coloured noise in turn")
    parser.add_argument("--pairs", type=int, default=0, help="with two hidden effects of different families")
    parser.add_argument("--kinds", nargs="+", choices=FAMILIES, default=[f for f in FAMILIES if f != "unknown"])
    parser.add_argument("--leave-out", action="store_true", help="take the hidden families out of the catalogue")
    parser.add_argument("--remembering", action="store_true", help="noise that has a memory altogether in every case")
    parser.add_argument("--noisy-torque", action="store_true", help="torque that was logged with noise in every case")
    parser.add_argument("--thorough", action="store_true", help="refit every form, and compare with results without it")
    parser.add_argument("--only", nargs="+", help="cases of these names alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results, one JSON a case")
    parser.add_argument("--baselines", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--keep-logs", action="store_true", help="keep each case's log folder under --out")
    parser.add_argument("--cache", type=Path, help="folder for compiled programs, kept between runs")
    parser.add_argument(
        "--markdown", action="store_true", help="run nothing; print the tables of what is there as Markdown"
    )
    return parser.parse_args()


def _cases(args: argparse.Namespace) -> list[Case]:
    cases = [
        *single_cases(args.cases, args.seed, args.kinds),
        *clean_cases(args.clean, args.seed),
        *pair_cases(args.pairs, args.seed),
    ]
    if args.noisy_torque:
        cases = [with_noisy_torque(case) for case in cases]
    if args.remembering:
        cases = [with_remembering_noise(case) for case in cases]
    return [case for case in cases if not args.only or case.name in args.only]


def _folder(case: Case, args: argparse.Namespace) -> str:
    return f"{'left_out-' if args.leave_out and case.forms else ''}{case.name}-seed{case.seed}"


def _result_path(out: Path, case: Case, args: argparse.Namespace, *, thorough: bool) -> Path:
    return out / "results" / f"{'thorough-' if thorough else ''}{_folder(case, args)}.json"


def _read(path: Path) -> dict | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _run(case: Case, args: argparse.Namespace) -> dict:
    with tempfile.TemporaryDirectory() as room:
        folder = args.out / "logs" / _folder(case, args) if args.keep_logs else Path(room)
        answer = record(draw(case), folder)
        leave_out = args.leave_out and bool(case.forms)
        how = {"seed": args.seed, "baselines": args.baselines, "thorough": args.thorough}
        return run_case(folder, answer, leave_out=leave_out, **how)


def _line(result: dict) -> str:
    case = result["case"]
    hidden = ", ".join(
        f"{family} ({form}, {limits:.3g} limits)"
        for family, form, limits in zip(case["families"], case["forms"], case["detection_limits"], strict=True)
    )
    told = f"{case['name']:<30} {hidden or 'nothing hidden'}: {verdict(result)}"
    if result["error"]:
        return f"{told}: {result['error'].strip().splitlines()[-1]}"
    after = result["held_out"]["after"]
    ratio = "left the numbers" if after is None else f"{after / case['noise']:.3g}"
    ties = f" ~ {', '.join(result['ties'])}" if result["ties"] else ""
    return (
        f"{told}; said {', '.join(result['names']) or result['decision']}{ties}; held-out error over noise {ratio}; "
        f"{result['seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
