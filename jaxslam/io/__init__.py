"""Trajectories as text, videos, and cameras: where they come from, how one is calibrated.

What looks at pictures needs the extra `vision`, and is imported when it is asked for.
"""

from importlib import import_module
from typing import Any

from jaxslam.io.tum import read_tum, write_tum

_MODULES = {
    "Frame": "source",
    "Source": "source",
    "Trajectory": "source",
    "open_source": "opening",
    "open_recording": "opening",
    "Calibration": "calibration",
    "read_calibration": "calibration",
    "write_calibration": "calibration",
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [
    "Calibration",
    "Frame",
    "Source",
    "Trajectory",
    "open_recording",
    "open_source",
    "read_calibration",
    "read_tum",
    "write_calibration",
    "write_tum",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
