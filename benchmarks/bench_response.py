"""A frequency response of 1,000 points through its folds, its stability, and many drives in one call."""

import time

import jax
import numpy as np

from hdjax import ReducedDrive, ReducedModel
from hdjax.fourier import harmonic_series
from hdjax.response.continuation import folds, frequency_response

MU, ALPHA, LEVEL, START, END, HARMONICS, POINTS = 0.1, 1.0, 0.3, 0.1, 2.5, 9, 1000


def best(run, repeats: int = 5) -> float:
    """Shortest of several runs [s], after one that compiles."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    model, forcing = ReducedModel(ReducedDrive(mu=MU, omega_0=1.0, alpha=ALPHA)), harmonic_series(1.0, LEVEL)
    branch = frequency_response(model, forcing, START, END, harmonics=HARMONICS, points=POINTS)
    ours = best(lambda: frequency_response(model, forcing, START, END, harmonics=HARMONICS, points=POINTS))
    print(f"{int(branch.valid.sum())} points through {int(folds(branch).exists.sum())} folds: {ours * 1e3:.1f} ms")
    print(f"  and its folds to rounding: {best(lambda: folds(branch)) * 1e3:.1f} ms")
    print(f"  and the stability of every point: {best(lambda: branch.multipliers) * 1e3:.1f} ms")
    drives = np.linspace(0.5, 1.5, 512)

    @jax.jit
    def many(alphas: jax.Array) -> jax.Array:
        def one(alpha: jax.Array) -> jax.Array:
            drive = model.replace({"alpha": alpha})
            return frequency_response(drive, forcing, START, END, points=200, steps=100).amplitude

        return jax.lax.map(one, alphas, batch_size=128)

    each = best(lambda: many(drives), repeats=2) / drives.size
    print(f"{drives.size} drives x 200 points in one call: {each * 1e3:.2f} ms a drive")


if __name__ == "__main__":
    main()
