"""What the channels of a log are to one another, as the equations of a drive say it, in log odds.

A relation leaves a share u of a channel's variance unexplained. Where there is none, u lies anywhere below what shifted
channels leave; where there is one, its logarithm does, down to a floor set by noise. The log odds of the two laws are
the evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fitting.inspection.windows import Scale

FLOOR = 1e-4
"""Share of a channel's variance below which sensors leave nothing to tell; assumed."""

_SPAN = float(np.log(1.0 / FLOOR))
# Channels that even a shifted one explains (ramps, single sines) tell nothing.
_UNTESTABLE = 0.05
_FITS = 0.01  # unexplained share below which a relation fits
_SHIFTS = (0.382, 0.236)  # of a log; by the golden section, no multiples of one period
_FEWEST_ROWS_A_REGRESSOR = 3


@dataclass(frozen=True)
class Told:
    """What a relation says.

    Attributes:
        odds: log odds that it holds; 0 where it can't be tested.
        slope: of the relation, in the channels' own units.
        unexplained: share of the variance that it leaves, where it fits best.
    """

    odds: float
    slope: float
    unexplained: float


NOTHING = Told(0.0, 1.0, 1.0)


class Relations:
    """The relations among channels; all arguments are numbers of channels.

    Attributes:
        scales: windows of several lengths, longest first.
        moves: which channels change at all, (channels,).
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

    def is_rate_of(self, velocity: int, angle: int) -> Told:
        """Whether one channel is the derivative of another; slope: derivative of the angle over the velocity."""
        odds, slope, share = self._pairs[:3]
        return Told(*(float(of[angle, velocity]) for of in (odds, slope, share)))

    def proportional(self, one: int, other: int) -> Told:
        """Whether one channel moves as another does; slope: the first over the second, from the slowest motion."""
        odds, slope, share = self._pairs[3:]
        return Told(*(float(of[one, other]) for of in (odds, slope, share)))

    def accelerates(self, angles: Sequence[int]) -> tuple[Told, ...]:
        """Whether each channel is a torque that accelerates the first angle: T = J theta'' and what depends on angles
        and rates. Slope: J."""
        # The other angle is nearly this one, and its twist goes with the acceleration.
        return self._partial(
            angles,
            lambda s: s.acceleration[:, angles[:1]],
            lambda s: self._motion(s, angles),
            apart=len(angles) == 1,
        )

    def drives(self, twist: int) -> tuple[Told, ...]:
        """Whether each channel accelerates a twist that a bent spring holds. Slope: the inertia."""
        return self._partial(
            (twist,),
            lambda s: s.acceleration[:, [twist]],
            lambda s: np.column_stack([s.value[:, [twist]], s.rate[:, [twist]], s.cube[:, [twist]]]),
        )

    def springs(self, motor: int, load: int) -> tuple[Told, ...]:
        """Whether each channel needs the difference of two angles, as a torque through the gear does. Slope: torque
        over the motor's angle."""
        return self._partial(
            (motor, load),
            lambda s: s.value[:, [load, motor]],
            lambda s: np.column_stack([s.rate[:, [motor, load]], s.direction[:, [motor, load]]]),
            # A velocity that was filtered lags, and its lag goes with the acceleration.
            apart=True,
        )

    def holds(self, twist: int) -> tuple[Told, ...]:
        """Whether each channel is proportional to a twist, but for its rate and direction. Slope: stiffness."""
        return self._partial(
            (twist,),
            lambda s: s.value[:, [twist]],
            lambda s: np.column_stack([s.rate[:, [twist]], s.direction[:, [twist]]]),
        )

    def pulled_back(self, angle: int) -> tuple[Told, ...]:
        """Whether each channel, beside accelerating an angle, is held by a spring there: only a twist has one."""
        return self._partial(
            (angle,),
            lambda s: s.value[:, [angle]],
            lambda s: np.column_stack([s.rate[:, [angle]], s.acceleration[:, [angle]], s.cube[:, [angle]]]),
        )

    def difference(self, motor: int, load: int) -> tuple[Told, ...]:
        """Whether each channel is made of both angles and of nothing else. Slope: channel over the motor's angle."""
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
    ) -> tuple[Told, ...]:
        """For each channel: what the wanted regressors explain of what the given ones leave.

        Args:
            own: channels that are no targets.
            wanted, given: regressors at a scale, (windows, count). Two wanted ones must explain more than either alone.
            target: all channels at a scale, (windows, channels).
            over_scales: what makes one of the odds, slopes and shares of all scales; that of the best where None.
            apart: whether a channel that the given regressors explain proves little.
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
            Told(*(float(of[k]) for of in told)) if self.moves[k] and k not in own else NOTHING for k in range(channels)
        )


def _shifted(windows: np.ndarray) -> list[np.ndarray]:
    """The same windows at other times, where no relation is left; several, since an excitation may be periodic."""
    return [np.roll(windows, round(share * len(windows)), axis=0) for share in _SHIFTS]


def _left(regressors: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean square that a regression leaves of each target, and its coefficients."""
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
    """Log odds of a share left unexplained."""
    tested = null > _UNTESTABLE
    null = np.where(tested, null, 1.0)
    odds = np.log(null / (_SPAN * np.maximum(share, FLOOR * null)))
    return np.where(tested, np.clip(odds, -np.log(_SPAN), None), 0.0)


def _best_scale(odds: np.ndarray, slopes: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, ...]:
    """Odds, slope and share where the odds are best, less what so many tries are worth: inertia shows in quick motion
    only, and noise spoils that which is too quick."""
    best = np.argmax(odds, axis=0)
    pick = (best, *np.indices(best.shape))
    tried = np.log(len(odds))
    found = odds[pick]
    return np.where(found > 0, np.maximum(found - tried, 0.0), found), slopes[pick], shares[pick]


def _over_scales(odds: np.ndarray, slopes: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, ...]:
    """The mean odds of the better half of the scales (noise spoils the short ones, drift the long ones), and the slope
    and share of the slowest motion in which the relation fits: filters change that of quick motion."""
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
    """Share of each y that each x leaves unexplained, and the slope."""
    cross = y.T @ x
    own, other = np.sum(y**2, axis=0), np.sum(x**2, axis=0)
    products = own[:, None] * other[None, :]
    known = products > 0
    share = np.where(known, 1.0 - cross**2 / np.where(known, products, 1.0), 1.0)
    slope = np.where(other[None, :] > 0, cross / np.where(other > 0, other, 1.0)[None, :], 0.0)
    # A slope between two noisy channels of one motion lies between this and its counterpart.
    return np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0), slope
