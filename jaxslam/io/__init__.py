"""Trajectories as text, videos, and cameras: where they come from, how one is calibrated.

What looks at pictures needs the extra `vision`, and is imported when it is asked for.
"""

from jaxslam._runtime import exported
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
__all__ = ["read_tum", "write_tum", *_MODULES]
__getattr__ = exported(__name__, _MODULES)
