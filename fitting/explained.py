"""What forces along a motion explain of the residual, beside the parameters that are free already."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.experiment import Segments
from fitting.followed import Followed, respond
from fitting.free import FreeParameters
from fitting.residual import Blocks

# Numbers whose square leaves what a computer can hold.
_NOTHING = 1e-200


class Answers(eqx.Module):
    """How whitened outputs answer what acts along a motion, without what the first state of each simulation could do as
    well.

    Attributes:
        followed: the motion.
        weight: of the samples.
        whitening: of the outputs.
        joined: whether a segment starts where the one before it ends.
        by_state: the residual's derivative by each segment's own first state.
        before_by_state: derivative of the end of the segment before by its first state.
        by_first: the residual's derivative by the first state of the simulation that a segment belongs to.
        parameters: the answer to a unit of each parameter that is free already.
    """

    followed: Followed
    weight: Float[np.ndarray, "segments samples"]
    whitening: Float[np.ndarray, "outputs outputs"]
    joined: np.ndarray
    by_state: Float[np.ndarray, "segments rows states"]
    before_by_state: Float[np.ndarray, "segments states states"]
    by_first: Float[np.ndarray, "segments rows states"]
    parameters: Float[np.ndarray, "segments samples outputs parameters"]

    @classmethod
    def of(
        cls,
        found: Blocks,
        followed: Followed,
        segments: Segments,
        whitening: Float[Array | np.ndarray, "outputs outputs"],
    ) -> "Answers":
        """The answers of a motion.

        Args:
            found: the residual's derivatives by what is free already.
            followed: the motion.
            segments: the data.
            whitening: of the outputs.
        """
        weight, joined = np.asarray(segments.weight), np.asarray(segments.joined)
        by_state, before = np.asarray(found.by_state), np.asarray(found.before_by_state)
        first = np.where(joined[:, None, None], 0.0, np.eye(before.shape[-1]))
        by_first = by_state @ through_segments(joined, before, first)
        parts = followed, weight, np.asarray(whitening), joined, by_state, before, by_first
        outputs = by_state.shape[1] // weight.shape[1]
        answers = cls(*parts, parameters=np.zeros((*weight.shape, outputs, 0)))
        known = answers._projected(np.asarray(found.by_parameter), np.asarray(found.before_by_parameter))
        return replace(answers, parameters=known)

    def to(
        self,
        pushed: Float[np.ndarray, "segments samples states columns"],
        reading: Float[np.ndarray, "#segments #samples #outputs columns"] | float = 0.0,
    ) -> Float[np.ndarray, "segments samples outputs columns"]:
        """The answers to forces.

        Args:
            pushed: what each adds to the state by the end of each sample interval.
            reading: what goes with each and is no motion, a change of what the encoders read.
        """
        outputs, end = respond(self.followed, pushed)
        outputs = (outputs + reading) * self.weight[:, :, None, None]
        columns = -(self.whitening @ outputs).reshape(len(end), -1, end.shape[-1])
        # Residuals are measured minus simulated. What follows a segment's rows of outputs is its states' prior.
        columns = np.pad(columns, ((0, 0), (0, self.by_state.shape[1] - columns.shape[1]), (0, 0)))
        return self._projected(columns, np.where(self.joined[:, None, None], np.roll(end, 1, axis=0), 0.0))

    def _projected(self, columns: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Columns of the residual without what each simulation's first state could do as well, once each segment starts
        where the one before it ends, whose end they move."""
        moved = columns + self.by_state @ through_segments(self.joined, self.before_by_state, before)
        starts = np.flatnonzero(~self.joined)
        chain = np.cumsum(~self.joined) - 1
        transposed = np.swapaxes(self.by_first, 1, 2)
        own, coupling = (np.add.reduceat(transposed @ part, starts, axis=0) for part in (self.by_first, moved))
        left = moved - self.by_first @ _solved_each(own, coupling)[chain]
        segments, samples = self.weight.shape
        outputs = len(self.whitening)
        return -left[:, : samples * outputs].reshape(segments, samples, outputs, -1)


def through_segments(joined: np.ndarray, before_by_state: np.ndarray, own: np.ndarray) -> np.ndarray:
    """What moves the state in which each segment starts: its own, and where it is joined what moves the one before."""
    found = np.empty_like(own)
    for i, goes_on in enumerate(joined):
        found[i] = own[i] + before_by_state[i] @ found[i - 1] if goes_on else own[i]
    return found


def _solved_each(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve symmetric systems after scaling their diagonals to one; a direction without information does not move."""
    size = np.diagonal(matrix, axis1=1, axis2=2)
    scale = np.where(size > 0, 1.0 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)[..., None]
    scaled = matrix * scale * np.swapaxes(scale, 1, 2)
    scaled = scaled + np.eye(size.shape[1]) * (np.where(size > 0, 0.0, 1.0)[..., None] + 1e-13)
    return scale * np.linalg.solve(scaled, scale * right)


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
