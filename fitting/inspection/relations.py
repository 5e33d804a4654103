"""Relations between channels of a log, by the equations of a drive, in log odds.

A relation leaves a share u of a channel's variance unexplained. Without a relation, u is uniform up to the value for
shifted channels. With one, its logarithm is uniform down to a noise floor. The log odds of the two distributions are
the evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fitting.inspection.windows import Scale

FLOOR = 1e-4
"""Share of a channel's variance that is below sensor noise; assumed."""

_SPAN = float(np.log(1.0 / FLOOR))
# Channels that even a shifted one explains (ramps, single sines) are no evidence.
_UNTESTABLE = 0.05
_FITS = 0.01  # unexplained share below which a relation fits
_SHIFTS = (0.382, 0.236)  # shares of a log; by the golden section, to avoid multiples of one period
_FEWEST_ROWS_A_REGRESSOR = 3


@dataclass(frozen=True)
class RelationEvidence:
    """Evidence of a relation.

    Attributes:
        odds: log odds that it holds; 0 if it can't be tested.
        slope: of the relation, in the channels' units.
        unexplained: unexplained share of the variance, at the best scale.
    """

    odds: float
    slope: float
    unexplained: float


NOTHING = RelationEvidence(0.0, 1.0, 1.0)


class Relations:
    """Relations between channels; all arguments are channel numbers.

    Attributes:
        scales: windows of several lengths, longest first.
        moves: which channels are not constant, (channels,).
    """

    def __init__(self, scales: Sequence[Scale], moves: np.ndarray):
        self.scales, self.moves = tuple(scales), moves

    @cached_property
    def _pairs(self) -> tuple[np.ndarray, ...]:
        """Odds, slopes and unexplained shares: of rate against value, and of rate against rate."""
        return (
            *_pairwise([(s.rate, s.value) for s in self.scales], self.moves),
            *_pairwise([(s.rate, s.rate) for s in self.scales], self.moves),
        )

    def is_rate_of(self, velocity: int, angle: int) -> RelationEvidence:
        """Whether one channel is the derivative of another; slope: derivative of the angle over the velocity."""
        odds, slope, share = self._pairs[:3]
        return RelationEvidence(*(float(of[angle, velocity]) for of in (odds, slope, share)))

    def proportional(self, one: int, other: int) -> RelationEvidence:
        """Whether one channel is proportional to another; slope: the first over the second, from the slowest motion."""
        odds, slope, share = self._pairs[3:]
        return RelationEvidence(*(float(of[one, other]) for of in (odds, slope, share)))

    def accelerates(self, angles: Sequence[int]) -> tuple[RelationEvidence, ...]:
        """Whether each channel is a torque that accelerates the first angle: T = J theta'' and what depends on angles
        and rates. Slope: J."""
        # The other angle is nearly equal, and the twist is correlated with the acceleration.
        return self._partial(
            angles,
            lambda s: s.acceleration[:, angles[:1]],
            lambda s: self._motion(s, angles),
            apart=len(angles) == 1,
        )

    def drives(self, twist: int) -> tuple[RelationEvidence, ...]:
        """Whether each channel accelerates a twist with a nonlinear spring. Slope: the inertia."""
        return self._partial(
            (twist,),
            lambda s: s.acceleration[:, [twist]],
            lambda s: np.column_stack([s.value[:, [twist]], s.rate[:, [twist]], s.cube[:, [twist]]]),
        )

    def springs(self, motor: int, load: int) -> tuple[RelationEvidence, ...]:
        """Whether each channel depends on the difference of two angles, like a torque through the gear. Slope: torque
        over the motor's angle."""
        return self._partial(
            (motor, load),
            lambda s: s.value[:, [load, motor]],
            lambda s: np.column_stack([s.rate[:, [motor, load]], s.direction[:, [motor, load]]]),
            # A filtered velocity lags, by a term proportional to the acceleration.
            apart=True,
        )

    def holds(self, twist: int) -> tuple[RelationEvidence, ...]:
        """Whether each channel is proportional to a twist, apart from terms in its rate and direction. Slope:
        stiffness."""
        return self._partial(
            (twist,),
            lambda s: s.value[:, [twist]],
            lambda s: np.column_stack([s.rate[:, [twist]], s.direction[:, [twist]]]),
        )

    def pulled_back(self, angle: int) -> tuple[RelationEvidence, ...]:
        """Whether each channel accelerates an angle against a spring: only a twist has one."""
        return self._partial(
            (angle,),
            lambda s: s.value[:, [angle]],
            lambda s: np.column_stack([s.rate[:, [angle]], s.acceleration[:, [angle]], s.cube[:, [angle]]]),
        )

    def difference(self, motor: int, load: int) -> tuple[RelationEvidence, ...]:
        """Whether each channel is a combination of both angles only. Slope: channel over the motor's angle."""
        return self._partial(
            (motor, load),
            lambda s: s.rate[:, [load, motor]],
            lambda s: np.zeros((len(s.rate), 0)),
            target=lambda s: s.rate,
            over_scales=_over_scales,
        )

    def _motion(self, scale: Scale, angles: Sequence[int]) -> np.ndarray:
        chosen = list(angles)
        return np.column_stack([scale.value[:, chosen], scale.rate[:, chosen], scale.direction[:, chosen[:1]]])

    def _partial(
        self, own, wanted, given, *, target=lambda s: s.value, over_scales=None, apart=False
    ) -> tuple[RelationEvidence, ...]:
        """For each channel: partial regression on the wanted regressors, beside the given ones.

        Args:
            own: channels that are not targets. wanted, given: regressors at a scale, (windows, count). Two wanted ones
                must explain more than either alone.
            target: all channels at a scale, (windows, channels).
            over_scales: combines odds, slopes and shares of all scales; the best scale where None.
            apart: whether a channel that the given regressors explain is weak evidence.
        """
        channels = len(self.moves)
        if not self.moves[list(own)].all() or not self.scales:
            return (NOTHING,) * channels
        odds, slopes, shares = [], [], []
        for scale in self.scales:
            aside, asked = given(scale), wanted(scale)
            least = _FEWEST_ROWS_A_REGRESSOR * (aside.shape[1] + asked.shape[1] + 1)
            if len(asked) < least:
                continue
            y = target(scale)
            full, coefficients = _left(np.column_stack([aside, asked]), y)
            if asked.shape[1] == 1:
                bare, _ = _left(aside, y)
                shifted = [_left(np.column_stack([aside, moved]), y)[0] for moved in _shifted(asked)]
                null = _share(np.max(shifted, axis=0), bare)
            else:
                alone = [_left(np.column_stack([aside, one]), y)[0] for one in asked.T]
                bare, null = np.min(alone, axis=0), np.ones(channels)
            if apart:
                null = np.minimum(null, _share(bare, np.mean(y**2, axis=0)))
            share = _share(full, bare)
            odds.append(_odds(share, null))
            shares.append(share)
            slopes.append(coefficients[-1])
        if not odds:
            return (NOTHING,) * channels
        told = (over_scales or _best_scale)(np.array(odds), np.array(slopes), np.array(shares))
        return tuple(
            RelationEvidence(*(float(of[k]) for of in told)) if self.moves[k] and k not in own else NOTHING
            for k in range(channels)
        )


def _shifted(windows: np.ndarray) -> list[np.ndarray]:
    """The windows shifted in time, which removes any relation; several shifts, since an excitation may be periodic."""
    return [np.roll(windows, round(share * len(windows)), axis=0) for share in _SHIFTS]


def _left(regressors: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual mean square of each target in a regression, and its coefficients."""
    size = np.sqrt(np.mean(regressors**2, axis=0))
    scaled = regressors / np.where(size > 0, size, 1.0)
    coefficients = np.linalg.lstsq(scaled, y, rcond=1e-10)[0]
    left = np.sum((y - scaled @ coefficients) ** 2, axis=0) / max(1, len(y) - regressors.shape[1] - 1)
    coefficients = coefficients / np.where(size > 0, size, 1.0)[:, None]
    return left, coefficients


def _share(left: np.ndarray, bare: np.ndarray) -> np.ndarray:
    share = np.where(bare > 0, left / np.where(bare > 0, bare, 1.0), 1.0)
    return np.minimum(np.nan_to_num(share, nan=1.0), 1.0)


def _odds(share: np.ndarray, null: np.ndarray) -> np.ndarray:
    """Log odds of an unexplained share."""
    tested = null > _UNTESTABLE
    null = np.where(tested, null, 1.0)
    odds = np.log(null / (_SPAN * np.maximum(share, FLOOR * null)))
    return np.where(tested, np.clip(odds, -np.log(_SPAN), None), 0.0)


def _best_scale(odds: np.ndarray, slopes: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, ...]:
    """Odds, slope and share of the best scale, corrected for the number of scales. Inertia only matters in fast motion,
    and noise dominates at the shortest scales."""
    best = np.argmax(odds, axis=0)
    pick = (best, *np.indices(best.shape))
    tried = np.log(len(odds))
    found = odds[pick]
    return np.where(found > 0, np.maximum(found - tried, 0.0), found), slopes[pick], shares[pick]


def _over_scales(odds: np.ndarray, slopes: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean odds of the better half of the scales (noise affects short ones, drift long ones), and slope and share of
    the slowest motion in which the relation fits, since filters affect fast motion."""
    half = (len(odds) + 1) // 2
    fits = shares <= np.maximum(2.0 * shares.min(axis=0), _FITS)
    slowest = np.argmax(fits, axis=0)
    pick = (slowest, *np.indices(slowest.shape))
    return np.sort(odds, axis=0)[-half:].mean(axis=0), slopes[pick], shares[pick]


def _pairwise(scales: Sequence[tuple[np.ndarray, np.ndarray]], moves: np.ndarray) -> tuple[np.ndarray, ...]:
    """Odds, slopes and unexplained shares of each channel of the first against each of the second."""
    odds, slopes, shares = [], [], []
    both = moves[:, None] & moves[None, :]
    for y, x in scales:
        share, slope = _correlated(y, x)
        null = np.max([_correlated(y, moved)[0] for moved in _shifted(x)], axis=0)
        odds.append(_odds(share, np.maximum(null, share)))
        slopes.append(slope)
        shares.append(share)
    if not scales:
        nothing = np.zeros_like(both, dtype=float)
        return nothing, nothing + 1.0, nothing + 1.0
    told = _over_scales(np.array(odds), np.array(slopes), np.array(shares))
    return np.where(both, told[0], 0.0), np.where(both, told[1], 1.0), np.where(both, told[2], 1.0)


def _correlated(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of each y not explained by each x, and the slope."""
    cross = y.T @ x
    own, other = np.sum(y**2, axis=0), np.sum(x**2, axis=0)
    products = own[:, None] * other[None, :]
    known = products > 0
    share = np.where(known, 1.0 - cross**2 / np.where(known, products, 1.0), 1.0)
    slope = np.where(other[None, :] > 0, cross / np.where(other > 0, other, 1.0)[None, :], 0.0)
    # A slope between two noisy channels of one motion lies between this and its counterpart.
    return np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0), slope
