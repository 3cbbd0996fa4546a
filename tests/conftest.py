"""What every test shares: float64, and the folder of real data where it is at hand."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import checking  # noqa: F401 - before the package, whose functions it decorates
import jax
import jaxtyping
import numpy as np
import pytest

from jaxslam._runtime import programs


def _flags_that_are_known(*flags: str) -> str:
    """XLA's flags and these, where it knows them: by others it would end the process."""
    wanted = " ".join(filter(None, (os.environ.get("XLA_FLAGS"), *flags)))
    start = [sys.executable, "-c", "import jax; jax.devices()"]
    tried = subprocess.run(start, env={**os.environ, "XLA_FLAGS": wanted}, capture_output=True)
    return wanted if tried.returncode == 0 else os.environ.get("XLA_FLAGS", "")


jax.config.update("jax_enable_x64", True)
if not jax.config.values["jax_compilation_cache_dir"]:  # commands would keep programs at home
    jax.config.update("jax_enable_compilation_cache", False)
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
gc.disable()  # else a tenth of the time: tracing makes many objects. Collected after every file.
# Tests compile much and compute little, and so do the processes that they start.
jax.config.update("jax_disable_most_optimizations", True)
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
os.environ["XLA_FLAGS"] = _flags_that_are_known(
    "--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"
)

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real image sequences; the test is skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the shared data folder {SHARED_DATA} is not on this machine")
    return SHARED_DATA


@pytest.fixture
def unchecked():
    """No check of types, where the package itself is to refuse what is none of its pieces."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


MOST_MAPS = 25_000
"""Of the 65 530 memory maps that a process has by default: a file of tests adds a few thousand."""


def _memory_maps() -> float:
    """How many this process holds; where the system does not tell, as if too many."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return np.inf


@pytest.fixture(scope="module", autouse=True)
def _compiled_programs_are_freed():
    """A process may hold only so many memory maps, and every compiled program takes some; until
    then files share what they have compiled."""
    yield
    if _memory_maps() > MOST_MAPS:
        programs.forget()
        jax.clear_caches()
        gc.unfreeze()
    gc.collect()
    gc.freeze()  # what is kept is not looked through after every file


def pytest_unconfigure(config):
    """The last line says what was left out."""
    left_out = config.getoption("markexpr", "")
    if left_out == "not slow and not laboratory" and not hasattr(config, "workerinput"):
        print("Tests marked slow or laboratory were left out: `python -m pytest -m ''` runs all.")
