"""Subject of a report: a closed loop, or a fit alone."""

from fitting.outcome import FitOnly, Loop

Outcome = Loop | FitOnly
