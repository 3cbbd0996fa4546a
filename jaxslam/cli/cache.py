"""Compiled programs are kept from one command to the next."""

from __future__ import annotations

import os
from pathlib import Path

import jax

from jaxslam._runtime.programs import keep_in


def keep_programs() -> None:
    """Keep programs in the user's cache folder, or where JAX is set to keep them.

    That is `$XDG_CACHE_HOME/jaxslam`, `~/.cache/jaxslam` by default. JAX's own variables
    JAX_COMPILATION_CACHE_DIR (another folder) and JAX_ENABLE_COMPILATION_CACHE (false: none) come
    first, and so do its configuration's. A folder that cannot be made is done without.
    """
    if not jax.config.values["jax_enable_compilation_cache"]:
        return
    told = jax.config.values["jax_compilation_cache_dir"]
    if told:
        keep_in(None if "://" in told else Path(told))
        return
    try:
        home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
        folder = (Path(home) if home else Path.home() / ".cache") / "jaxslam"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: nobody's home
        return
    if os.access(folder, os.W_OK):
        keep_in(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
            # In seconds of compiling; by default JAX keeps programs from one second on.
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
