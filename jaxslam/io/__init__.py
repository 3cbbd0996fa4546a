"""Trajectories as text, videos, and cameras: where they come from, how one is calibrated.

What looks at pictures needs the extra `vision`, and is imported when it is asked for.
"""

from itertools import chain

from jaxslam._runtime import exported
from jaxslam.io.tum import read_tum, write_tum

_NAMES = {
    "source": ("Frame", "Source", "Trajectory"),
    "opening": ("open_source", "open_recording"),
    "calibration": ("Calibration", "write_calibration"),
    "lens_files": ("read_calibration",),
    "imu": ("InertialLog", "read_inertial"),
    "imu_calibration": ("InertialCalibration", "read_inertial_calibration"),
}
"""Where each name is that is imported only when it is asked for."""
__all__ = ["read_tum", "write_tum", *chain(*_NAMES.values())]
__getattr__ = exported(__name__, _NAMES)
