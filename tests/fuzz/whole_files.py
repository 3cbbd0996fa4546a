"""Whole files of every kind that something reads: what `fuzz.py` then breaks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bags import EPOCH, ros_of
from bags import write_bag as written
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.consistency import FolderStore, monte_carlo
from jaxslam.evaluation import Convention, write_covariances
from jaxslam.io.calibration import Calibration, write_calibration
from jaxslam.io.tum import write_tum
from jaxslam.tracking.persistence import write_record
from jaxslam.tracking.synthetic import synthetic_source

WIDTH, HEIGHT = 64, 48


def _poses(count: int) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(count), [0.01, 0.02, 0.0])).as_matrix()
    T[:, 0, 3] = 0.1 * np.arange(count)
    return T


def errors_and_covariances() -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(0)
    return draw.normal(size=(4, 5, 3)), np.tile(np.diag([1.0, 2.0, 0.5]), (4, 5, 1, 1))


def pose_arrays() -> dict[str, np.ndarray]:
    truth = np.tile(_poses(5), (3, 1, 1, 1))
    estimates = truth.copy()
    estimates[..., :3, 3] += 0.01 * np.random.default_rng(0).normal(size=(3, 5, 3))
    P = np.tile(1e-4 * np.eye(6), (3, 5, 1, 1))
    return {"estimates": estimates, "covariances": P, "truths": truth}


def write_errors(folder: Path) -> None:
    errors, P = errors_and_covariances()
    np.savez(folder / "runs.npz", errors=errors, covariances=P, times=np.arange(5.0))


def write_pose_arrays(folder: Path) -> None:
    said: dict[str, Any] = {"error": "right", "axes": "body"}
    np.savez(folder / "runs.npz", allow_pickle=False, **pose_arrays(), **said)


def write_bag(name: str) -> Callable[[Path], None]:
    """A bag of estimates, truths, pictures and their lens."""

    def write(folder: Path) -> None:
        r, held = ros_of(name), pose_arrays()
        told = list(
            zip(EPOCH + np.arange(5) / 10, held["estimates"][0], held["truths"][0], strict=True)
        )
        K = np.diag([60.0, 60.0, 1.0])
        topics = {
            "/odom": [r.odometry(t, T, 1e-4 * np.eye(6)) for t, T, _ in told],
            "/gt": [r.pose_stamped(t, T) for t, _, T in told],
            "/camera/image": [
                r.image(t, np.zeros((48, 64), np.uint8), "mono8") for t, _, _ in told
            ],
            "/camera/camera_info": [r.camera_info(told[0][0], (48, 64), K, np.zeros(5))],
        }
        written(folder / name, topics)

    return write


def write_csv(folder: Path) -> None:
    errors, P = errors_and_covariances()
    upper = np.triu_indices(3)
    rows = [
        ",".join(map(str, [run, step, *errors[run, step], *P[run, step][upper]]))
        for run in range(4)
        for step in range(5)
    ]
    (folder / "runs.csv").write_text("run,step,x,y,z,a,b,c,d,e,f\n" + "\n".join(rows) + "\n")


def write_run(folder: Path) -> None:
    arrays, times = pose_arrays(), np.arange(5) / 10
    for run in range(2):
        place = folder / f"run{run}"
        place.mkdir()
        write_tum(place / "estimate.txt", times, arrays["estimates"][run])
        write_tum(place / "truth.txt", times, arrays["truths"][run])
        P = arrays["covariances"][run]
        write_covariances(place / "covariance.txt", times, P, Convention("right"))


def write_run_of(columns: int) -> Callable[[Path], None]:
    """A run whose poses, and covariances, are of so many numbers a line: other programs' files."""

    def write(folder: Path) -> None:
        arrays, times = pose_arrays(), np.arange(5) / 10
        P = arrays["covariances"][0]
        names = ("state_estimate", "state_deviation", "state_groundtruth")
        names = names if columns == 34 else ("estimate", "covariance", "truth")
        for name, T in zip(names[::2], (arrays["estimates"][0], arrays["truths"][0]), strict=True):
            q, p = Rotation.from_matrix(T[:, :3, :3]).as_quat(), T[:, :3, 3]
            rows = {
                4: [times, p[:, :2], 0.1 * times],
                12: [T[:, :3].reshape(5, 12)],
                20: [times, p, q, P[:, :3, :3][:, *np.triu_indices(3)], P[:, 0, :6] + 1e-4],
                34: [times, q, p, np.zeros((5, 26))],
            }[columns]
            np.savetxt(folder / f"{name}.txt", np.column_stack(rows))
        deviations = {4: 3, 12: 6, 34: 31}.get(columns)
        if columns == 20:
            write_tum(folder / "truth.txt", times, arrays["truths"][0])
        if columns == 12:
            np.savetxt(folder / "times.txt", times)
        if deviations is not None:
            rows = [times, 0.01 * np.ones((5, deviations))]
            np.savetxt(folder / f"{names[1]}.txt", np.column_stack(rows))

    return write


def write_csv_of(header: str, columns: int) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        draw = np.random.default_rng(0)
        rows = [[run, step, *draw.uniform(0.5, 1.5, columns)] for run in (0, 1) for step in (0, 1)]
        if "dof" in header:
            rows = [[*row[:-1], 3] for row in rows]
        text = "\n".join(",".join(map(str, row)) for row in rows)
        (folder / "runs.csv").write_text(f"{header}\n{text}\n")

    return write


def write_nees(folder: Path) -> None:
    np.savez(folder / "runs.npz", nees=np.random.default_rng(0).chisquare(3, (4, 5)), dof=3)


def write_sigmas(folder: Path) -> None:
    errors, P = errors_and_covariances()
    sigmas = np.sqrt(np.diagonal(P, axis1=2, axis2=3))
    np.savez(folder / "runs.npz", errors=errors, sigmas=sigmas)


def write_trajectory(folder: Path) -> None:
    write_tum(folder / "t.txt", np.arange(30) / 30, _poses(30))


def write_scenario(folder: Path) -> None:
    (folder / "s.toml").write_text(
        'base = "circle"\nsteps = 5\npixel_sigma = 0.5\nvelocity = [0.0, 1.2, 0.3]\n'
        'calibration = "white"\nfirst_pixels = [[20.0, 620.0]]\nlandmarks = 12\n'
    )


def write_camera(folder: Path) -> None:
    write_calibration(folder / "camera.json", _calibration())


def write_target(folder: Path) -> None:
    points: list[dict[str, Any]] = [
        {"name": str(i), "position": [0.2 * (i % 2), 0.1 * i, 0.0], "pixel": [10 + i, 20.5]}
        for i in range(4)
    ]
    points[3] = {"position": [1, 1, 1], "patch": "corner.png"}
    (folder / "target.json").write_text(json.dumps({"points": points, "unit": "metre"}, indent=1))
    cv2.imwrite(str(folder / "corner.png"), _picture(0)[:20, :20])


def _calibration() -> Calibration:
    return Calibration(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)


def _picture(index: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), 10 * index + 5, np.uint8)


def _pictures(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / name), _picture(index))


def write_timestamped(folder: Path) -> None:
    names = [f"{i}.png" for i in range(3)]
    _pictures(folder / "images", names)
    lines = [f"{0.1 * i} {name}" for i, name in enumerate(names)]
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    write_calibration(folder / "calibration.json", _calibration())
    write_tum(folder / "groundtruth.txt", np.arange(3) / 10, _poses(3))


def write_tum_rgbd(folder: Path) -> None:
    _pictures(folder / "rgb", ["5.25.png", "5.5.png"])
    (folder / "rgb.txt").write_text("# color images\n5.25 rgb/5.25.png\n5.5 rgb/5.5.png\n")
    write_tum(folder / "groundtruth.txt", [5.2, 5.5], _poses(2))


def write_euroc(folder: Path) -> None:
    camera, truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    times = [1403636579763555584, 1403636579813555456]
    _pictures(camera / "data", [f"{time}.png" for time in times])
    (camera / "data.csv").write_text("#t\r\n" + "".join(f"{t},{t}.png\r\n" for t in times))
    (camera / "sensor.yaml").write_text(
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1,0,0,0, 0,1,0,0, 0,0,1,0, "
        f"0,0,0,1]\nresolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\n"
        "intrinsics: [60.5, 61.5, 31.0, 23.0]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]\n"
    )
    (truth / "data.csv").write_text(
        "#t\r\n" + "".join(f"{t},0,0,0,1,0,0,0,0.1,0.2,0.3\r\n" for t in times)
    )


def write_kitti(folder: Path) -> None:
    _pictures(folder / "image_0", [f"{i:06d}.png" for i in range(3)])
    (folder / "times.txt").write_text("0.0e+00\n1.04e-01\n2.07e-01\n")
    (folder / "calib.txt").write_text("P0: 70 0 30 0 0 71 20 0 0 0 1 0\n")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)


def write_seven_scenes(folder: Path) -> None:
    _pictures(folder, [f"frame-{i:06d}.color.png" for i in range(2)])
    for i in range(2):
        (folder / f"frame-{i:06d}.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    write_calibration(folder / "calibration.json", _calibration())


def write_pictures(folder: Path) -> None:
    _pictures(folder, ["a.png", "b.png", "c.jpg"])


def write_film(folder: Path) -> None:
    writer = cv2.VideoWriter(
        str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (WIDTH, HEIGHT)
    )
    for index in range(4):
        writer.write(cv2.cvtColor(_picture(index), cv2.COLOR_GRAY2BGR))
    writer.release()


SMALL = {"made_by": "fuzz", "seed": 0}


def small_study(folder: Path) -> Any:
    scenario = jaxslam.scenario("matched-tight", steps=2, landmarks=3)
    filters = jaxslam.make_filters(scenario, "robocentric", "inverse_scaling")
    store = FolderStore(folder, SMALL, resume=True)
    return monte_carlo(scenario, filters, runs=4, chunk=2, store=store)


def write_tracker(folder: Path) -> None:
    source = synthetic_source(frames=1, width=160, height=120)
    tracker = jaxslam.Tracker(
        source.calibration, jaxslam.TrackerSettings(filter="world", wanted=12, spare=4)
    )
    for frame in source:
        tracker.track(frame)
    tracker.save(folder / "tracker.npz")


def write_record_of_two(folder: Path) -> None:
    numbers = {"a": np.zeros(3), "b": np.ones((2, 2))}
    write_record(folder / "tracker.npz", {"filter": None, "settings": {}}, numbers)


def nothing(folder: Path) -> None:
    """No files."""
