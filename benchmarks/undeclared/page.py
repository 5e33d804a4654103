"""Keep a registered run of the study, and write the page of all of them. See benchmarks/README.md.

    python benchmarks/undeclared/page.py --add study/results --called "seed 97, at 1a2b3c4"
    python benchmarks/undeclared/page.py > docs/evaluation.md

A run is registered when its seed was drawn after the last change of a rule; it stays on the page whatever came out.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from undeclared.tally import Table, tables

KEPT = Path(__file__).parent / "registered"

OPENING = """# Evaluation

The loop is closed on simulated logs of drives with a hidden effect, in the catalogue or not, and of drives without one.
The simulator (`benchmarks/undeclared`) shares no code with the package; `benchmarks/README.md` has the protocol. A run
is registered before it begins: no rule was changed between the draw of its seed and its end. Every registered run is on
this page, which `benchmarks/undeclared/page.py` generates.

Up to seed 8215 the strengths of quick creep are far too large: what a larger K absorbs of it was computed to first
order only. Some of it can't be told from a larger K.

Up to seed 3307 coloured noise enters the detection limits by its rms: beside it an effect of slow motion has up to five
times fewer limits than the tables say. And where a family was left out, one with the same equations remained in the
catalogue, and counted as wrong: wrong inertias for a gain of the torque, late encoders for a late torque.
"""


def main() -> None:
    """Keep a run, or print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", type=Path, help="folder of a run's results")
    parser.add_argument("--called", help="seed and revision of that run")
    args = parser.parse_args()
    if args.add is not None:
        results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(args.add.glob("*.json"))]
        found = [vars(table) for table in tables(results)]
        KEPT.mkdir(exist_ok=True)
        path = KEPT / f"{len(list(KEPT.glob('*.json'))) + 1:02d}.json"
        path.write_text(json.dumps({"run": args.called, "tables": found}, indent=1) + "\n", encoding="utf-8")
        return
    print(OPENING)
    for path in sorted(KEPT.glob("*.json"), reverse=True):
        stored = json.loads(path.read_text(encoding="utf-8"))
        print(f"## {stored['run']}\n")
        for table in stored["tables"]:
            print(Table(table["title"], tuple(table["columns"]), table["rows"]).text(markdown=True) + "\n")


if __name__ == "__main__":
    main()
