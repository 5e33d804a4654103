"""What a report is about: a closed loop, or a fit alone."""

from fitting.close_loop import Loop
from fitting.fit_only import FitOnly

Outcome = Loop | FitOnly
