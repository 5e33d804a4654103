"""A frequency response of 1,000 points through its folds against the same in numpy, and many drives in one call."""

import argparse
import time

import jax
import numpy as np

from hdjax import ReducedDrive, ReducedModel
from hdjax.fourier import harmonic_series
from hdjax.response.continuation import Branch, frequency_response
from hdjax.response.fold import folds

MU, ALPHA, LEVEL, START, END, HARMONICS, POINTS = 0.1, 1.0, 0.3, 0.1, 2.5, 9, 1000
SAMPLES = 64
AGREEMENT = 1e-8


def best(run, repeats: int) -> float:
    """Shortest of several runs [s], after one that compiles."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return min(times)


# --- the peer: pseudo-arclength continuation of the same harmonic balance, in numpy ----------------------------------


class Peer:
    """`x'' + mu x' + x + alpha x^3 = level cos(omega t)`, unknowns in units of `length`, with its exact Jacobian."""

    def __init__(self, length: float):
        angles = np.arange(SAMPLES) * (2 * np.pi / SAMPLES)
        k = np.arange(1, HARMONICS + 1)
        waves = k[:, None] * angles
        self.length = length
        self.basis = np.concatenate([np.ones((1, SAMPLES)), np.cos(waves), np.sin(waves)])
        self.projection = self.basis.T * np.where(np.arange(2 * HARMONICS + 1) == 0, 1.0, 2.0) / SAMPLES
        self.orders = np.concatenate([[0], k, k])
        # d/dt in units of omega: cosine k goes to -k sine k, sine k to k cosine k.
        self.slope = np.zeros((2 * HARMONICS + 1,) * 2)
        self.slope[k + HARMONICS, k], self.slope[k, k + HARMONICS] = -k, k
        self.push = np.zeros(2 * HARMONICS + 1)
        self.push[1] = LEVEL / length

    def residual(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the equation leaves over, and its derivative by the unknowns and omega."""
        u, omega = point[:-1], point[-1]
        x = self.length * (u @ self.basis)
        cubic = (ALPHA / self.length * x**3) @ self.projection
        left = -(omega**2) * self.orders**2 * u + MU * omega * (self.slope @ u) + u + cubic - self.push
        by_u = self.projection.T @ ((3.0 * ALPHA * x**2)[:, None] * self.basis.T)
        by_u += np.diag(1.0 - omega**2 * self.orders**2) + MU * omega * self.slope
        by_omega = -2.0 * omega * self.orders**2 * u + MU * (self.slope @ u)
        return left, np.column_stack([by_u, by_omega])

    def branch(self, step: float) -> np.ndarray:
        """Points of the branch, a step of its length apart, by tangent predictor and Newton corrector."""
        point = np.append(np.zeros(2 * HARMONICS + 1), START)
        for _ in range(20):
            left, jacobian = self.residual(point)
            point[:-1] -= np.linalg.solve(jacobian[:, :-1], left)
        tangent = np.zeros_like(point)
        tangent[-1] = 1.0
        points = []
        while point[-1] < END:
            points.append(point)
            _, jacobian = self.residual(point)
            tangent = np.linalg.solve(np.vstack([jacobian, tangent]), np.append(np.zeros(point.size - 1), 1.0))
            tangent /= np.linalg.norm(tangent)
            point = point + step * tangent
            for _ in range(10):
                left, jacobian = self.residual(point)
                change = np.linalg.solve(np.vstack([jacobian, tangent]), np.append(left, 0.0))
                point = point - change
                if np.linalg.norm(change) < 1e-10:
                    break
        return np.array(points)


def against_numpy(branch: Branch, ours: float, repeats: int) -> None:
    """Time the peer on the same branch, and hold each one's points against the other's equations."""
    u, omega = np.asarray(branch.unknowns), np.asarray(branch.value)
    points = np.column_stack([u, omega])
    peer = Peer(float(branch.system.length))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / (POINTS - 1)
    found = peer.branch(step)
    theirs = best(lambda: peer.branch(step), repeats)
    residual = jax.jit(jax.vmap(branch.system.residual))
    in_ours = float(np.max(np.abs(residual(found[:, :-1], found[:, -1]))))
    in_theirs = max(float(np.max(np.abs(peer.residual(p)[0]))) for p in points)
    turns = [sum(np.diff(np.sign(np.diff(w))) != 0) for w in (omega, found[:, -1])]
    print(f"numpy, {len(found)} points through {turns[1]} folds: {theirs * 1e3:.1f} ms, ratio {theirs / ours:.1f}")
    print(f"  each one's points leave over in the other's equations: {in_ours:.1e} and {in_theirs:.1e}")
    assert turns[0] == turns[1] and abs(len(found) - POINTS) < 0.01 * POINTS
    assert max(in_ours, in_theirs) < AGREEMENT


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--drives", type=int, default=512)
    # `make bench` gives every script the same options.
    options, _ = arguments.parse_known_args()
    jax.config.update("jax_enable_x64", True)
    model, forcing = ReducedModel(ReducedDrive(mu=MU, omega_0=1.0, alpha=ALPHA)), harmonic_series(1.0, LEVEL)

    def run() -> Branch:
        return frequency_response(model, forcing, START, END, harmonics=HARMONICS, samples=SAMPLES, points=POINTS)

    branch, ours = run(), best(run, options.repeats)
    print(f"{int(branch.valid.sum())} points through {int(folds(branch).exists.sum())} folds: {ours * 1e3:.1f} ms")
    against_numpy(branch, ours, options.repeats)
    print(f"  and its folds to rounding: {best(lambda: folds(branch), options.repeats) * 1e3:.1f} ms")
    print(f"  and the stability of every point: {best(lambda: branch.multipliers, options.repeats) * 1e3:.1f} ms")
    drives = np.linspace(0.5, 1.5, options.drives)

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
