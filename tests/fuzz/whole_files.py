"""Whole files of every kind that something reads: what `fuzz.py` then breaks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
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


def write_run(folder: Path) -> None:
    arrays, times = pose_arrays(), np.arange(5) / 10
    for run in range(2):
        place = folder / f"run{run}"
        place.mkdir()
        write_tum(place / "estimate.txt", times, arrays["estimates"][run])
        write_tum(place / "truth.txt", times, arrays["truths"][run])
        P = arrays["covariances"][run]
        write_covariances(place / "covariance.txt", times, P, Convention("right"))


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
