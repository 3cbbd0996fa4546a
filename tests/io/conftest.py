"""What the tests of videos share."""

import pytest
from pictures import HEIGHT, WIDTH

from jaxslam.io.calibration import Calibration, write_calibration


@pytest.fixture
def calibration(tmp_path):
    path = tmp_path / "camera.json"
    write_calibration(path, Calibration(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5))
    return path
