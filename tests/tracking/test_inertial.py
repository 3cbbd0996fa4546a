"""Tracking with an inertial unit: in metres, from rest and in motion, by files and options."""

import json
from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest

pytest.importorskip("cv2")

from inertial_video import REST, T_CI, UNIT, film, measured

from jaxslam.cli.track import TrackOptions
from jaxslam.io.calibration import write_calibration
from jaxslam.io.tum import write_tum
from jaxslam.models.imu import Increments
from jaxslam.tracking.inertial import CLOCK_SIGMA, Inertial
from jaxslam.tracking.moving_start import begun
from jaxslam.tracking.settings import INERTIAL, TrackerSettings
from jaxslam.tracking.tracker import Tracker

SMALL = TrackerSettings(wanted=20, spare=8, calibration="known")
NOISE = (
    "gyroscope_noise_density: 3.0e-4\ngyroscope_random_walk: 2.0e-5\n"
    "accelerometer_noise_density: 3.0e-3\naccelerometer_random_walk: 1.0e-3\n"
)
MOUNT = "cam0:\n  T_cam_imu:\n" + "".join(f"  - {row}\n" for row in T_CI.tolist())


@pytest.fixture(scope="module")
def short():
    """A film that begins at rest."""
    return film(11, REST, seconds=3.0, rate=10.0, width=320)


def test_readings_at_rest_are_used_once(short):
    inertial = Inertial.of(short.log, UNIT, short.source.times)
    assert not inertial.why_moving
    assert inertial.rests_until == 1.0
    seconds = [float(inertial.control(*step).seconds) for step in [(0.2, 0.9), (0.9, 1.3), (2, 3)]]
    np.testing.assert_allclose(seconds, [0, 0.3, 1], rtol=0, atol=1e-9)
    off = (np.asarray(inertial.imu.bias) - short.bias)[:3]
    assert np.abs(off).max() < 5 * 3e-4


def test_a_clock_offset_moves_the_readings(short):
    later = short.log._replace(times=short.log.times + 100.0)
    one, other = (
        Inertial.of(log, UNIT, short.source.times, offset)
        for log, offset in ((short.log, 0.0), (later, 100.0))
    )
    same = jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-9),
        *(x.control(1.5, 1.6) for x in (one, other)),
    )
    assert isinstance(same, Increments)


def test_a_film_from_other_times_than_its_readings_is_refused(short):
    with pytest.raises(ValueError, match=r"from frame 0 to 1: .* the clocks differ"):
        Inertial.of(short.log, UNIT, short.source.times + 50)


def test_a_start_in_motion_is_found_by_who_has_numbers_of_32_bits():
    of = film(12, 0.0, seconds=2.0, rate=10.0, width=320)
    inertial = Inertial.of(of.log, replace(UNIT, clock_sigma=[5e-3]), of.source.times)
    assert inertial.why_moving
    with jax.enable_x64(False):
        rest, started = begun(of.source, inertial, SMALL)
    assert rest.times[0] == pytest.approx(1.5)
    assert of.source.reference is not None
    k, h = 15, 0.1
    before, now, after = of.source.reference.T_wc[k - 1 : k + 2] @ T_CI
    velocity = now[:3, :3].T @ (after - before)[:3, 3] / (2 * h)
    # The difference of two pictures is not quite the velocity.
    np.testing.assert_allclose(started.imu.velocity, velocity, atol=0.05)


@pytest.mark.slow
def test_a_path_is_in_metres_from_rest_and_in_motion():
    """The scale, and what is claimed of it, which only seconds of a film tell."""
    for rest in (REST, 0.0):
        of = film(12, rest, seconds=5.0)
        found = measured(of, replace(SMALL, wanted=30), imu=True, rest=rest)
        # Measured .02 to .1 %; without its unit the scale is off by more than 3 %.
        assert found["rmse"] < 0.01
        assert found["nees"] < 2
        assert found["lost"] == 0


def of_motion(tracker):
    """What the filter knows of its unit: the mean, and σ of each number."""
    _, state = tracker.estimator.slam.gaussian(tracker.state.map.state, None)
    part = state.core.part("motion")
    return state.core.motion, np.sqrt(np.diag(state.covariance[part, part]))


@pytest.mark.slow
def test_a_lost_camera_goes_on_by_its_readings():
    """Frames without a picture: then it finds its map where the unit says. A map that begins anew
    has the unit as it was."""
    of = film(13, REST, seconds=4.0, rate=20.0)
    inertial = Inertial.of(of.log, UNIT, of.source.times)
    tracker = Tracker(of.source.calibration, SMALL, inertial=inertial)
    history = []
    for frame in of.source:
        dark = 50 <= frame.index < 60
        image = np.full_like(frame.image, 99) if dark else frame.image
        history.append(tracker.track(replace(frame, image=image)))
    assert [x.index for x in history if x.lost] == list(range(50, 60))
    assert tracker.restarts == 0
    assert of.source.reference is not None
    for k in (59, -1):
        off = np.linalg.norm((history[k].T_wc - of.source.reference.T_wc[k])[:3, 3])
        assert off < 3 * np.sqrt(np.trace(history[k].covariance[:3, :3])) < 0.1
    (mean, sigma), camera = of_motion(tracker), tracker.state.map.place.camera.T_wc
    with jax.enable_x64(True):
        tracker.state = tracker.state.restarted().begun(frame.image, np.full((1, 2), 99.0))
    assert tracker.state.map.number == 1
    np.testing.assert_array_equal(tracker.state.map.place.camera.T_wc, camera)
    after, now = of_motion(tracker)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), mean, after)
    np.testing.assert_allclose(now, sigma, rtol=1e-3, atol=2e-6)


@pytest.fixture(scope="module")
def folder(short, tmp_path_factory):
    """The film as files, without a calibration of its unit."""
    path = tmp_path_factory.mktemp("film")
    (path / "images").mkdir()
    names = []
    for frame in short.source:
        names.append(f"{frame.time:.6f} {frame.index}.png\n")
        cv2.imwrite(str(path / "images" / f"{frame.index}.png"), frame.image)
    (path / "timestamps.txt").write_text("".join(names))
    write_calibration(path / "calibration.json", short.source.calibration)
    assert short.source.reference is not None
    write_tum(path / "groundtruth.txt", *short.source.reference)
    rows = np.column_stack([short.log.times, short.log.gyroscope, short.log.accelerometer])
    np.savetxt(path / "imu.csv", rows, delimiter=",", header="t,gx,gy,gz,ax,ay,az", comments="")
    for name, text in (("imu.yaml", NOISE), ("camchain-imucam.yaml", MOUNT)):
        (path.parent / name).write_text(text)
    return path


@pytest.mark.slow
def test_the_command_tracks_with_the_readings_of_a_folder(short, folder, tmp_path, capsys):
    """The way of files and options into the filter, and of metres into the summary."""
    files = tuple(folder.parent / x for x in ("imu.yaml", "camchain-imucam.yaml"))
    TrackOptions(
        source=folder, imu=(), imu_calibration=files, out=tmp_path, overlay=False, wanted=20
    ).run()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["unit"] == "m"
    assert summary["filter"] == INERTIAL
    unit = summary["inertial"]
    assert (unit["readings"], unit["start"]) == (str(folder / "imu.csv"), "at rest")
    off = (np.asarray(unit["biases"]) - short.bias) / unit["biases_sigma"]
    assert np.abs(off).max() < 4
    # The files state no offset, and there is none.
    assert 0 < unit["clock_offset_sigma"][0] < CLOCK_SIGMA
    assert abs(unit["clock_offset"][0]) < 4 * unit["clock_offset_sigma"][0]
    assert "length=m" in (tmp_path / "covariance.txt").read_text().splitlines()[0]
    assert summary["ate_metres"]["alignment"] == "se3"
    assert summary["ate_metres"]["rmse"] < 0.02 * summary["ate_metres"]["path_length"]
    assert "positions are in metres, by" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"imu": ()}, "are not known: give --imu-calibration imu.yaml"),
        ({"imu": (), "imu_calibration": ("imu.yaml",)}, "the pose of the camera is missing"),
        (
            {"imu": (), "imu_calibration": ("camchain-imucam.yaml",)},
            "gyroscope_noise_density is missing",
        ),
        ({"imu": ("a.csv", "b.csv")}, "--imu takes one FILE of readings"),
        ({"imu": (), "map": "map.npz"}, "without --map and --target"),
        ({"imu_calibration": ("imu.yaml",)}, "--imu-calibration needs --imu"),
    ],
)
def test_what_is_missing_is_said(options, told, folder, tmp_path):
    paths = {
        key: folder.parent / x if isinstance(x, str) else tuple(folder.parent / y for y in x)
        for key, x in options.items()
    }
    with pytest.raises(ValueError, match=told):
        replace(TrackOptions(source=folder, out=tmp_path), **paths).run()
