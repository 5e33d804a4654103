"""What a report is about: a closed loop, or a fit alone."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from fitting.attribution import Round
from fitting.close_loop import Finding, Loop
from fitting.compare import Account
from fitting.diagnostics import ResidualDiagnostics
from hdjax import Hold


class FitOnly(eqx.Module):
    """A fit without a search for effects; stands in for a [`Loop`][] in reports.

    Attributes:
        account: the fitted model's.
        noise: covariance of the measurement noise of the outputs.
        hold: what the torque does between samples, as used.
        residual: diagnostics of what the model leaves over, or None.
        seconds: where the time went.
    """

    account: Account
    noise: Float[Array, "outputs outputs"]
    hold: Hold | None = eqx.field(static=True, default=None)
    residual: ResidualDiagnostics | None = None
    seconds: dict[str, float] | None = None
    decision: ClassVar[str] = "fit_only"
    findings: ClassVar[tuple[Finding, ...]] = ()
    rounds: ClassVar[tuple[Round, ...]] = ()
    dropped: ClassVar[tuple[str, ...]] = ()

    @property
    def before(self) -> Account:
        """The one account that there is."""
        return self.account

    @property
    def after(self) -> Account:
        """Likewise."""
        return self.account


Outcome = Loop | FitOnly
