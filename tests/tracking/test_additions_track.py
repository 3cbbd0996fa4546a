"""What is defined outside the package tracks a camera: a sensor, a motion, a landmark, a treatment
of the calibration and a remedy."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from additions import BiasedVelocity, DriftingFocal, Huber, Pixels, PlainHomogeneous

import jaxslam
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import synthetic_source
from jaxslam.tracking.tracker import Tracker

FRAMES = 8


def pieces_of(kind, calibration):
    linear, angular = [1.0] * 3, [2.0] * 3
    motion = BiasedVelocity(linear + angular, [0.0] * 6, [0.5] * 6, [0.1] * 6)
    if kind == "sensor and motion":
        sensor = Pixels((calibration.fx, calibration.cx, calibration.cy), 0.3)
        return {"motion": motion, "sensor": sensor, "calibration": jaxslam.Estimated([1.0] * 3)}
    camera = jaxslam.Camera((calibration.fx, calibration.fy), (calibration.cx, calibration.cy))
    return {
        "motion": jaxslam.ConstantVelocity(linear + angular, [0.0] * 6, [0.5] * 6),
        "sensor": jaxslam.Pinhole(camera, 0.3),
        "calibration": DriftingFocal([0.01], [0.001]),
        "landmark": PlainHomogeneous(),
        "correction": Huber(3.0),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sensor and motion", "landmark, calibration and remedy"])
def test_additions_of_ones_own_track(kind):
    source = synthetic_source(frames=FRAMES)
    slam = jaxslam.Slam(
        **pieces_of(kind, source.calibration),
        depth=jaxslam.InverseDepth.beyond(1.0),
        frame=jaxslam.WorldCentric(),
    )
    tracker = Tracker(source.calibration, TrackerSettings(filter="world", wanted=20, spare=4), slam)
    tracked = [tracker.track(frame) for frame in source]
    assert [t.state for t in tracked] == ["start"] + ["tracked"] * (FRAMES - 1)
    assert not tracker.failed
    assert source.reference is not None
    # The camera turns by several degrees.
    step = np.linalg.inv(source.reference.T_wc[0]) @ source.reference.T_wc[FRAMES - 1]
    error = np.linalg.inv(step) @ tracked[-1].T_wc
    assert np.degrees(np.linalg.norm(error[:3, :3] - np.eye(3))) < 2.0
