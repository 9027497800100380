"""The first seconds of a command: compiled kernels are kept between runs, packages load while others compile."""

import importlib
import threading
from collections.abc import Sequence
from contextlib import suppress

import jax
import platformdirs


def keep_kernels() -> None:
    """Compiled kernels stay in the user's cache folder, the latest 1 GB; JAX_COMPILATION_CACHE_DIR names another."""
    if jax.config.jax_compilation_cache_dir:
        return
    folder = platformdirs.user_cache_path("probcal") / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written: compile anew
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", 10**9)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def load_ahead(names: Sequence[str]) -> None:
    """Import modules that are needed later while kernels compile; what fails to load fails where it is needed."""

    def load() -> None:
        for name in names:
            with suppress(ImportError):
                importlib.import_module(name)

    threading.Thread(target=load, daemon=True).start()
