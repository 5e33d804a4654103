"""Subject of a report: a closed loop, or a fit alone."""

from fitting.fit_drive import FitOnly
from fitting.outcome import Loop

Outcome = Loop | FitOnly
