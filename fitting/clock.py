"""Where the time went."""

import time


class Clock:
    """Seconds by stage."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Note that a stage is over."""
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
