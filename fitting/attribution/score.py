"""The score of a candidate: log predictive densities of blocks of the selection data."""

import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import Trial

# Most blocks: each is long enough for residuals of neighbouring blocks to be nearly uncorrelated.
_MOST_BLOCKS = 40


def block_scores(trial: Trial, whitening: Float[np.ndarray, "outputs outputs"]) -> Float[np.ndarray, " blocks"]:
    """Log predictive density of each block, up to a constant.

    The density is a multivariate t with as many degrees of freedom as the block has values. So the noise variance of a
    block may differ by a few times, and no block decides alone.

    Args:
        trial: the candidate.
        whitening: of the noise, the same for all compared candidates.
    """
    white = np.asarray(trial.held_out.error) @ np.asarray(whitening).T
    weight = np.asarray(trial.held_out.problem.segments.weight).sum(axis=1)
    # A delay of the readings may leave a segment without samples, which still counts: blocks are the same for all.
    pieces = int(trial.held_out.pieces.sum())
    squares, numbers = (white**2).sum(axis=(1, 2))[:pieces], weight[:pieces] * white.shape[2]
    count = min(_MOST_BLOCKS, pieces)
    block = np.arange(pieces) * count // pieces
    squares, numbers = (np.bincount(block, values, minlength=count) for values in (squares, numbers))
    return -numbers * np.log1p(squares / np.maximum(numbers, 1.0))
