"""A sweep whose worker is killed, then the sweep itself, both by SIGKILL; then it is asked for again.

Says how many chunks were worked out by whom, and whether the result is that of an undisturbed run bit for bit.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr

SPEC = """
[drive]
preset = "HDC-40-050"
B_sp = 0.3
[forcing]
amplitude = 3.0
[sample]
points = {points}
rule = "sobol"
[sample.ranges]
K = {{ from = 6e3, to = 9e3 }}
alpha = {{ from = 1.0, to = 5e3, spacing = "log" }}
"forcing.omega" = {{ from = 250.0, to = 500.0 }}
[sweep]
response = "transient"
outputs = ["peak", "final"]
duration = {duration}
windows = 10
"""


def begun(spec: Path, store: Path, workers: int) -> subprocess.Popen:
    """The command in a process of its own."""
    command = [sys.executable, "-c", "from fitting.commands.main import main; main()", "sweep", str(spec)]
    options = ["--out", str(store), "--workers", str(workers), "--memory", "32", "--no-plot"]
    return subprocess.Popen(command + options, stdout=subprocess.DEVNULL)


def marks(store: Path) -> dict[int, int]:
    """Which process has worked out which chunk."""
    return {int(p.name): int(p.read_text().split()[-1]) for p in store.glob("*/finished/[0-9]*")}


def wait_for(store: Path, chunks: int, process: subprocess.Popen) -> None:
    """Until so many chunks are finished."""
    while len(marks(store)) < chunks:
        if process.poll() is not None:
            raise SystemExit("the sweep ended before it could be disturbed: ask for more points")
        time.sleep(0.02)


def told(text: str, store: Path, start: float) -> None:
    found = marks(store)
    print(f"{time.monotonic() - start:6.1f} s: {text}; {len(found)} chunks are finished", flush=True)


def disturbed(spec: Path, store: Path) -> float:
    """Kill a worker, then the sweep, and ask again; gives the seconds that it took."""
    start = time.monotonic()
    process = begun(spec, store, workers=2)
    wait_for(store, 4, process)
    worker = next(iter(marks(store).values()))
    os.kill(worker, signal.SIGKILL)
    told(f"worker {worker} killed", store, start)
    wait_for(store, len(marks(store)) + 4, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(3.0)  # for its workers, which end by themselves
    told("the sweep killed", store, start)
    before = marks(store)
    if begun(spec, store, workers=2).wait() != 0:
        raise SystemExit("the sweep did not go on")
    told("asked again and done", store, start)
    again = [chunk for chunk, process in marks(store).items() if before.get(chunk, process) != process]
    print(f"chunks worked out twice: {len(again)}")
    return time.monotonic() - start


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--points", type=int, default=1 << 19)
    arguments.add_argument("--duration", type=float, default=1.0)
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        spec = Path(folder) / "sweep.toml"
        spec.write_text(SPEC.format(points=options.points, duration=options.duration), encoding="utf-8")
        stores = [Path(folder) / name for name in ("disturbed", "undisturbed")]
        print(f"{options.points} transients of {options.duration:g} s")
        seconds = disturbed(spec, stores[0])
        start = time.monotonic()
        if begun(spec, stores[1], workers=0).wait() != 0:
            raise SystemExit("the undisturbed sweep failed")
        print(f"disturbed: {seconds:.1f} s; undisturbed, one process: {time.monotonic() - start:.1f} s")
        one, other = (zarr.open_group(next(store.glob("*/data")), mode="r") for store in stores)
        same = all(np.asarray(one[n][:]).tobytes() == np.asarray(other[n][:]).tobytes() for n in one.array_keys())
        print(f"{len(list(one.array_keys()))} arrays: {'the same bits' if same else 'DIFFERENT'}")


if __name__ == "__main__":
    main()
