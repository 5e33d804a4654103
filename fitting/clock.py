"""Timing of stages."""

import time


class Clock:
    """Seconds by stage."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Record the time of a finished stage."""
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
