"""What forces along a motion explain of the residual, beside the parameters that are free already."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.arrow import project
from fitting.experiment import Segments
from fitting.followed import Followed, respond
from fitting.free import FreeParameters
from fitting.residual import Blocks
from hdjax.where import where

# Numbers whose square leaves what a computer can hold.
_NOTHING = 1e-200


def explained(
    found: Blocks,
    followed: Followed,
    segments: Segments,
    whitening: Float[Array, "outputs outputs"],
    at_start: Float[Array, "segments samples states columns"],
    at_end: Float[Array, "segments samples states columns"],
    reading: Float[Array, "#segments #samples #outputs columns"] | Float[Array, ""],
) -> Float[Array, "segments samples outputs parameters_and_columns"]:
    """Whitened outputs that a unit of each free parameter, and then of each force, adds; without what the first state
    of each simulation could add as well.

    Args:
        found: the residual's derivatives by what is free already.
        followed: the motion.
        segments: the data.
        whitening: of the outputs.
        at_start: each force at the start of each sample interval.
        at_end: and at its end.
        reading: what goes with each force and is no motion, a change of what the encoders read; or zero.
    """
    outputs, end = respond(followed, at_start, at_end)
    outputs = (outputs + reading) * segments.weight[:, :, None, None]
    white = jnp.einsum("ij,snjc->snic", whitening, outputs)
    rows = white.shape[1] * white.shape[2]
    # Residuals are measured minus simulated. What follows a segment's rows of outputs is its states' prior.
    columns = -white.reshape(white.shape[0], rows, -1)
    columns = jnp.pad(columns, ((0, 0), (0, found.residual.shape[1] - rows), (0, 0)))
    before = where(segments.joined[:, None, None], jnp.roll(end, 1, axis=0), 0.0)
    extended = replace(
        found,
        by_parameter=jnp.concatenate([found.by_parameter, columns], axis=2),
        before_by_parameter=jnp.concatenate([found.before_by_parameter, before], axis=2),
    )
    projected = -project(extended, segments.joined)[:, :rows]
    return projected.reshape(*white.shape[:3], -1)


def without_untold(found: Blocks, free: FreeParameters) -> Blocks:
    """The same without the columns of positive parameters that the data do not tell to within a factor e (a corner too
    sharp to be seen): what they would explain to first order lies far beyond where that reaches."""
    by_parameter, before = np.asarray(found.by_parameter), np.asarray(found.before_by_parameter)
    told = (np.sum(by_parameter**2, axis=(0, 1)) > 1.0) | ~np.asarray(free.logarithmic, dtype=bool)
    return replace(
        found,
        by_parameter=jnp.asarray(np.where(told, by_parameter, 0.0)),
        before_by_parameter=jnp.asarray(np.where(told, before, 0.0)),
    )


def solved(
    gram: Float[np.ndarray, "*many columns columns"], gradient: Float[np.ndarray, "*many columns sides"]
) -> Float[np.ndarray, "*many columns sides"]:
    """Least squares; directions without information do not move.

    Nor do columns without any, as of a parameter that has gone to infinity: they would not explain, and what rounding
    leaves of them on other data would be all that counts.
    """
    size = np.diagonal(gram, axis1=-2, axis2=-1)
    scale = np.where(size > _NOTHING, 1.0 / np.sqrt(np.maximum(size, _NOTHING)), 0.0)[..., None]
    inverse = np.linalg.pinv(gram * scale * np.swapaxes(scale, -1, -2), rcond=1e-10, hermitian=True)
    return scale * (inverse @ (scale * gradient))
