"""Settings of JAX for a command."""

import contextlib
import os
from pathlib import Path

# A log of usual length has too few segments for more.
_MOST_DEVICES = 8


def start_jax() -> None:
    """Enable double precision, use one device per core, and cache compiled programs on disk.

    Called before modules that need JAX are imported.
    """
    # XLA reads this once, at the import of jax. With a warm cache it would warn that the processor lacks
    # "+prefer-no-gather", a tuning flag that it set itself.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    jax.config.update("jax_enable_x64", True)
    with contextlib.suppress(RuntimeError):  # JAX has started already: this is not the first command of the process
        jax.config.update("jax_num_cpu_devices", min(os.cpu_count() or 1, _MOST_DEVICES))
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hdjax"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
