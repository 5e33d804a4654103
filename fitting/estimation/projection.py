"""Projection of forces' responses and parameter sensitivities orthogonal to the initial states."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.free_parameters import FreeParameters
from fitting.estimation.linear_response import Followed, Forces, respond
from fitting.estimation.residual import Blocks
from fitting.estimation.segments import Segments
from fitting.record import Record

# Sums of squares below this count as zero.
_NOTHING = 1e-200


class FirstStates(Record):
    """Sensitivity of a residual to the initial state of each simulation (a chain of joined segments).

    Attributes:
        joined: whether a segment starts where the one before it ends.
        by_state: the residual's derivative by each segment's initial state.
        before_by_state: derivative of the preceding segment's final state by its initial state.
        by_first: the residual's derivative by the initial state of the simulation that a segment belongs to.
    """

    joined: Bool[np.ndarray, " segments"]
    by_state: Float[np.ndarray, "segments rows states"]
    before_by_state: Float[np.ndarray, "segments states states"]
    by_first: Float[np.ndarray, "segments rows states"]

    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def of(cls, found: Blocks, joined: Bool[Array | np.ndarray, " segments"]) -> "FirstStates":
        """From a residual's derivatives."""
        joined, by_state, before = np.asarray(joined), np.asarray(found.by_state), np.asarray(found.before_by_state)
        first = np.where(joined[:, None, None], 0.0, np.eye(before.shape[-1]))
        return cls(joined, by_state, before, by_state @ through_segments(joined, before, first))

    def without(
        self,
        columns: Float[Array | np.ndarray, "segments rows columns"],
        before: Float[Array | np.ndarray, "segments states columns"],
    ) -> Float[np.ndarray, "segments rows columns"]:
        """Columns projected orthogonal to the effect of the initial states.

        Args:
            columns: by segment.
            before: corresponding change of the preceding segment's final state, where segments are joined.
        """
        with np.errstate(all="ignore"):
            moved = np.asarray(columns)
            if self.joined.any():
                through = through_segments(self.joined, self.before_by_state, np.asarray(before))
                moved = moved + self.by_state @ through
            starts = np.flatnonzero(~self.joined)
            transposed = np.swapaxes(self.by_first, 1, 2)
            own, coupling = (np.add.reduceat(transposed @ part, starts, axis=0) for part in (self.by_first, moved))
            return moved - self.by_first @ _solved_each(own, coupling)[np.cumsum(~self.joined) - 1]

    def parameters_without(self, found: Blocks) -> Float[np.ndarray, "segments rows parameters"]:
        """The parameters' columns, projected likewise."""
        return self.without(found.by_parameter, found.before_by_parameter)


class Answers(Record):
    """Response of whitened outputs to forces along a motion, projected orthogonal to the initial states.

    Attributes:
        followed: the motion.
        weight: of the samples.
        whitening: of the outputs.
        readout: derivative of the weighted and whitened outputs by the state.
        states: sensitivity to the initial states.
        parameters: sensitivity to each free parameter.
    """

    followed: Followed
    weight: Float[np.ndarray, "segments samples"]
    whitening: Float[np.ndarray, "outputs outputs"]
    readout: Float[np.ndarray, "segments samples outputs states"]
    states: FirstStates
    parameters: Float[np.ndarray, "segments samples outputs parameters"]

    @classmethod
    def of(
        cls, found: Blocks, followed: Followed, segments: Segments, whitening: Float[np.ndarray, "outputs outputs"]
    ) -> "Answers":
        """The responses along a motion.

        Args:
            found: the residual's derivatives by the free parameters.
            followed: the motion.
            segments: the data.
            whitening: of the outputs.
        """
        weight, states = np.asarray(segments.weight), FirstStates.of(found, segments.joined)
        # Residuals are measured minus simulated.
        known = -states.parameters_without(found)[:, : weight.shape[1] * len(whitening)]
        readout = whitening @ followed.readout * weight[:, :, None, None]
        return cls(followed, weight, whitening, readout, states, known.reshape(*weight.shape, len(whitening), -1))

    def to(
        self,
        forces: Forces | None,
        reading: Float[np.ndarray, "segments samples outputs columns"] | None = None,
    ) -> Float[np.ndarray, "segments samples outputs columns"]:
        """The responses to forces.

        Args:
            forces: along the motion; None without any.
            reading: change of the encoders' readings that accompanies each force; None without any.
        """
        if forces is not None:
            outputs, end = respond(self.followed, forces, readout=self.readout)
        else:
            assert reading is not None
            outputs = np.zeros(reading.shape)
            end = np.zeros((*self.states.before_by_state.shape[:2], reading.shape[-1]))
        if reading is not None:
            outputs = outputs + self.whitening @ reading * self.weight[:, :, None, None]
        columns = outputs.reshape(len(end), -1, end.shape[-1])
        rows, further = columns.shape[1], self.states.by_state.shape[1] - columns.shape[1]
        if further:
            # After a segment's rows of outputs come those of its states' prior.
            columns = np.pad(columns, ((0, 0), (0, further), (0, 0)))
        before = np.where(self.states.joined[:, None, None], np.roll(end, 1, axis=0), 0.0)
        return self.states.without(columns, -before)[:, :rows].reshape(outputs.shape)


# A simulation that diverges overflows; its step is rejected.
@np.errstate(over="ignore", invalid="ignore")
def through_segments(joined: np.ndarray, before_by_state: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Accumulate changes of each segment's initial state along joined segments."""
    found = np.empty_like(own)
    for i, goes_on in enumerate(joined):
        found[i] = own[i] + before_by_state[i] @ found[i - 1] if goes_on else own[i]
    return found


def _solved_each(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve symmetric systems after scaling their diagonals to one; components without information are zero."""
    size = np.diagonal(matrix, axis1=1, axis2=2)
    scale = np.where(size > 0, 1.0 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)[..., None]
    scaled = matrix * scale * np.swapaxes(scale, 1, 2)
    scaled = scaled + np.eye(size.shape[1]) * (np.where(size > 0, 0.0, 1.0)[..., None] + 1e-13)
    return scale * np.linalg.solve(scaled, scale * right)


def without_undetermined(found: Blocks, free: FreeParameters) -> Blocks:
    """The same without the columns of positive parameters that the data do not determine to within a factor e. For
    these, the linearisation does not reach as far as their uncertainty."""
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
    """Least-squares solution; components without information are zero.

    Columns that vanish, as of a parameter at infinity, get zero as well: otherwise their rounding errors on other data
    would dominate.
    """
    size = np.diagonal(gram, axis1=-2, axis2=-1)
    scale = np.where(size > _NOTHING, 1.0 / np.sqrt(np.maximum(size, _NOTHING)), 0.0)[..., None]
    inverse = np.linalg.pinv(gram * scale * np.swapaxes(scale, -1, -2), rcond=1e-10, hermitian=True)
    return scale * (inverse @ (scale * gradient))
