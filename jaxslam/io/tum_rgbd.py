"""TUM's RGB-D benchmark: `rgb.txt`, `groundtruth.txt`, and the published lens of each Kinect.

Sturm, Engelhard, Endres, Burgard, Cremers, IROS 2012; the intrinsics are those of the colour
cameras on the benchmark's page, for the pictures as they are distributed.
"""

import re
from pathlib import Path

from jaxslam.io.calibration import Calibration
from jaxslam.io.recording import Calibrator, Layout, Recording, fixed, of_listing

INTRINSICS = {
    "1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": (535.4, 539.2, 320.1, 247.6, ()),
}
"""fx, fy, cx, cy (pixels) and the distortion of `freiburg1`, 2 and 3, 640x480."""


def _open(path: Path, _rate: float) -> Recording:
    return of_listing(path, path / "rgb.txt", path, _published(path))


def _published(path: Path) -> Calibrator | None:
    """The lens that the folder's name tells."""
    found = re.search(r"(?:freiburg|fr)([123])", path.resolve().name)
    return fixed(Calibration(640, 480, *INTRINSICS[found[1]])) if found else None


TUM_RGBD = Layout("TUM RGB-D (rgb.txt)", lambda path: (path / "rgb.txt").is_file(), _open)
