"""What a pipe shows while a command works: a line every minute."""

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from datetime import timedelta

from fitting.progress import Progress

_MINUTE = 60.0  # s


@contextlib.contextmanager
def line_a_minute(stage: str, *, interval: float = _MINUTE) -> Iterator[Progress]:
    """Tell `stderr` every so often what is being done and for how long, also while one stage lasts.

    Args:
        stage: What is done first.
        interval: From line to line [s].

    Yields:
        What is to be told the next stages.
    """
    latest, begin, ended = deque([stage], maxlen=1), time.monotonic(), threading.Event()

    def tell() -> None:
        # Whoever read along may have left: that must not end the work.
        with contextlib.suppress(OSError):
            while not ended.wait(interval):
                elapsed = timedelta(seconds=round(time.monotonic() - begin))
                # In one piece, since others may write there as well.
                print(f"hdjax: {elapsed} {latest[0]}\n", end="", file=sys.stderr, flush=True)

    teller = threading.Thread(target=tell, name="line a minute", daemon=True)
    teller.start()
    try:
        yield latest.append
    finally:
        ended.set()
        teller.join()
