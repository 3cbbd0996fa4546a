"""Films with the readings of an inertial unit: how far off metres are, and how sure.

    python benchmarks/inertial_video.py
    python benchmarks/inertial_video.py --seconds 4 --kinds rest moving --seeds $(seq 400 499)

Every seed is a rendered film of `seconds` at 20 Hz with readings at 200 Hz, tracked with the unit
from rest, with the unit in motion, and without it. Errors are of the path in metres, from its first
pose on; without the unit they are at its best scale. NEES and 90 % sets are of every tenth pose; a
start is lost where the last of them exceeds what one consistent run in 10,000 reaches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmark import RESULTS, Benchmark
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxslam.io.calibration import Calibration
from jaxslam.io.imu import InertialLog
from jaxslam.io.source import Source, Trajectory
from jaxslam.models.imu import Imu
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.moving_start import begun
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import add_noise, handheld_trajectory, render, room
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import absolute_trajectory_error

DOWN = np.array([0.1, 0.97, 0.2]) / np.linalg.norm([0.1, 0.97, 0.2])
"""Gravity in the world of a film, which is its first camera."""
T_CI = np.eye(4)
T_CI[:3, :3] = Rotation.from_rotvec([0.5, -1.2, 0.8]).as_matrix()
T_CI[:3, 3] = 0.03, -0.05, 0.02
UNIT = Imu((3e-4, 3e-3), walk=(2e-5, 1e-3), bias_sigma=(0.05, 0.2), camera_from_imu=T_CI)
"""Twice the noise of EuRoC's unit; biases are drawn from this σ."""
REST = 1.2
"""Seconds at rest, in a film that begins so."""
IMU_RATE = 200.0


class Film(NamedTuple):
    """A video with the readings that were made with it."""

    source: Source
    log: InertialLog
    bias: np.ndarray
    """True biases at time 0."""


def path(times: np.ndarray, seed: int, rest: float) -> np.ndarray:
    """The hand-held path of the synthetic video; from `rest` on it takes a second to its speed, on
    a course of time whose third derivative exists."""
    x = np.clip(times - rest, 0, 1) if rest else np.ones_like(times)
    on = x**6 - 3 * x**5 + 2.5 * x**4 + np.clip(times - rest - 1, 0, None)
    return handheld_trajectory(on if rest else times, seed)


def film(
    seed: int, rest: float, seconds: float = 10.0, rate: float = 20.0, width: int = 640
) -> Film:
    """A rendered film, and what the unit read: the derivatives of the path, biases that walk, and
    white noise."""
    height, focal = width * 3 // 4, 0.82 * width
    camera = Calibration(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    times = np.arange(round(seconds * rate)) / rate
    T_wc = path(times, seed, rest)
    quads = room(seed, focal)
    pictures = [
        add_noise(render(quads, T, camera), np.random.default_rng([seed, i]))
        for i, T in enumerate(T_wc)
    ]
    t, h = np.arange(-2, round(seconds * IMU_RATE) + 2) / IMU_RATE, 1e-3
    before, now, after = (path(t + dt, seed, rest) @ T_CI for dt in (-h, 0, h))
    turned = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    rates = Rotation.from_matrix(turned).as_rotvec() / (2 * h)
    pull = (before + after - 2 * now)[:, :3, 3] / h**2 - UNIT.gravity * DOWN
    forces = np.einsum("nji,nj->ni", now[:, :3, :3], pull)
    draw, normal = np.random.default_rng([seed, 7]), (len(t), 6)
    bias = np.repeat(UNIT.bias_sigma, 3) * draw.standard_normal(6)
    walk = np.repeat(UNIT.walk, 3) * draw.standard_normal(normal) / np.sqrt(IMU_RATE)
    white = np.repeat(UNIT.density, 3) * draw.standard_normal(normal) * np.sqrt(IMU_RATE)
    read = np.hstack([rates, forces]) + bias + np.cumsum(walk, axis=0) + white
    source = Source(f"film {seed}", camera, times, lambda: iter(pictures), Trajectory(times, T_wc))
    return Film(source, InertialLog(t, read[:, :3], read[:, 3:], "imu.csv"), bias)


def measured(one: Film, settings: TrackerSettings, *, imu: bool, rest: float) -> dict[str, Any]:
    """The errors of a film that is tracked, with its unit or without."""
    source, inertial = one.source, None
    if imu:
        inertial = Inertial.of(one.log, UNIT, source.times)
        source, inertial = begun(source, inertial, settings)
    tracker = Tracker(source.calibration, settings, inertial=inertial)
    history = [tracker.track(frame) for frame in source]
    assert source.reference is not None
    true = source.reference.T_wc[-len(history) :]
    true = np.linalg.inv(true[0]) @ true
    found = np.stack([one.T_wc for one in history])
    ate = absolute_trajectory_error(source.times, found, source.times, true)
    length = ate["path_length"]
    result = {"length": length, "sim3": ate["rmse"] / length, "lost": sum(x.lost for x in history)}
    if not imu:
        return result
    away = np.linalg.norm((found - true)[:, :3, 3], axis=1)
    nees = []
    for k in range(10, len(history), 10):
        if source.times[k] > rest + 0.1:  # what rests is known exactly
            error = np.linalg.inv(found[k]) @ true[k]
            e = np.r_[error[:3, 3], Rotation.from_matrix(error[:3, :3]).as_rotvec()]
            nees.append(float(e @ np.linalg.solve(history[k].covariance, e)))
    return result | {
        "rmse": float(np.sqrt(np.mean(away**2))) / length,
        "end": float(away[-1]) / length,
        "nees": float(np.mean(nees)) / 6,
        "start_lost": bool(nees[-1] > chi2.isf(1e-4, 6)),
        "in90": float(np.mean(np.array(nees) < chi2.ppf(0.9, 6))),
    }


@dataclass(frozen=True, kw_only=True)
class InertialVideo(Benchmark):
    """Tracks films with and without their inertial unit."""

    out: Path = RESULTS / "inertial_video.json"
    seeds: tuple[int, ...] = tuple(range(200, 208))
    """None of which anything was tuned with."""
    seconds: float = 10.0
    """Of every film."""
    kinds: tuple[str, ...] = ("rest", "moving", "without")
    """Of these: a start at rest, one in motion, and one in motion without the unit."""

    def measure(self) -> Iterator[dict[str, Any]]:
        results: dict[str, Any] = {kind: {} for kind in self.kinds}
        for seed in self.seeds:
            for kind in self.kinds:
                rest, imu = REST if kind == "rest" else 0.0, kind != "without"
                of = film(seed, rest, self.seconds)
                results[kind][str(seed)] = measured(of, TrackerSettings(), imu=imu, rest=rest)
                yield results


if __name__ == "__main__":
    InertialVideo.run()
