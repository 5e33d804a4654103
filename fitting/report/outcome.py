"""What a report is about: a closed loop, or a fit alone."""

from fitting.fit_only import FitOnly
from fitting.outcome import Loop

Outcome = Loop | FitOnly
