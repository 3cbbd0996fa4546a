"""The program written by hand in C++: built by one command, called in this process."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from benchmarks.speed.workload import Inputs, Records, kept
from jaxslam.models.sensors import Pinhole

SOURCE = Path(__file__).with_name("ekf.cpp")
FLAGS = ("-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-shared", "-fPIC", "-pthread")
SYSTEM = Path("/usr/include/eigen3")


class _Problem(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("runs", "steps", "landmarks")),
        ("dt", ctypes.c_double),
        ("focal", ctypes.c_double * 2),
        ("centre", ctypes.c_double * 2),
        ("pixel_sigma", ctypes.c_double),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "acceleration_sigma", "calibration_sigma", "pose", "velocity", "points",
                "covariance", "pixels", "truth", "nees", "last_covariance",
            )
        ),
    )  # fmt: skip


def headers() -> Path | None:
    """Eigen's headers, of the package cmeel-eigen or of the system."""
    candidates = [Path(root) / "cmeel.prefix/include/eigen3" for root in sys.path] + [SYSTEM]
    return next((path for path in candidates if (path / "Eigen").is_dir()), None)


def build(folder: Path) -> ctypes.CDLL | str:
    """The program; or why there is none."""
    compiler, include = shutil.which("g++") or shutil.which("clang++"), headers()
    if compiler is None:
        return "no C++ compiler"
    if include is None:
        return "no Eigen: pip install cmeel-eigen"
    library = folder / "ekf.so"
    command = [compiler, *FLAGS, "-I", str(include), str(SOURCE), "-o", str(library)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def by_hand(
    library: ctypes.CDLL, inputs: Inputs, *, threads: int = 1, fixed: bool = False
) -> Callable[[], Records]:
    """The program on these inputs."""
    runs, steps, m, p = inputs.pixels.shape
    index, slam, start = kept(inputs.slam, inputs.start), inputs.slam, inputs.start
    t = slam.motion.geometry.tangent_dim
    # Its acceleration follows the velocity.
    index = np.insert(index, [2 * t] * t, np.arange(2 * t, 3 * t))
    arrays = {
        "acceleration_sigma": slam.motion.noise_sigma,
        "calibration_sigma": slam.calibration.sigma,
        "pose": start.core.pose.as_matrix(),
        "velocity": start.core.motion,
        "points": start.landmarks,
        "covariance": start.covariance[:, index[:, None], index],
        "pixels": inputs.pixels,
        "truth": jax.vmap(jax.vmap(lambda pose: pose.inverse().as_matrix()))(inputs.poses),
        "nees": np.zeros((runs, steps)),
        "last_covariance": np.zeros((runs, len(index), len(index))),
    }
    arrays = {name: np.ascontiguousarray(x, np.float64) for name, x in arrays.items()}
    assert isinstance(slam.sensor, Pinhole)
    camera, two = slam.sensor.camera, ctypes.c_double * 2
    problem = _Problem(
        runs, steps, m, float(inputs.seconds), two(*camera.focal), two(*camera.centre),
        float(slam.sensor.sigma), *(x.ctypes.data for x in arrays.values()),
    )  # fmt: skip
    keep = np.r_[: 2 * t, 3 * t : len(index)]

    def call() -> Records:
        library.ekf(ctypes.byref(problem), p + 1, threads, int(fixed))
        return arrays["nees"].copy(), arrays["last_covariance"][:, keep[:, None], keep]

    return call
