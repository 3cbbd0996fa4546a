"""An inertial unit beside the camera of a tracker: how it starts, and what it reads."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxslam._runtime.programs import Program
from jaxslam.io.imu import InertialLog
from jaxslam.io.imu_calibration import InertialCalibration
from jaxslam.models.imu import Imu, Increments, increments
from jaxslam.models.imu_start import at_rest, moving

BEGINNING = 1.0
"""Seconds by whose readings the unit starts."""
BIAS_SIGMA = 0.05, 0.2
"""σ of the biases of a gyroscope, rad/s, and of an accelerometer, m/s², of which nothing is known:
those of telephones and of units for robots."""
CLOCK_SIGMA = 5e-3
"""σ of the offset between two clocks of which nothing is known, s."""


@dataclass(frozen=True)
class Inertial:
    """The readings of a unit beside a camera, and the model with its start at the first frame."""

    log: InertialLog
    imu: Imu
    clock_offset: float = 0.0
    """Seconds by which the clock of the unit is ahead of the camera's."""
    rests_until: float = -np.inf
    """The unit is at rest until then, by the clock of the camera. The readings until then are used
    for the start, and are no control."""
    why_moving: str = ""
    """Why it is not taken to be at rest in the beginning, if so."""

    @classmethod
    def of(
        cls,
        log: InertialLog,
        calibration: InertialCalibration | Imu,
        times: Float[np.ndarray, " n"],
        clock_offset: float | None = None,
    ) -> Inertial:
        """That of frames at these times, s, by the clock of the camera. It is at rest where the
        readings of the first second are, and else has any velocity, σ 1 m/s: too little to track
        with, but for `jaxslam.tracking.moving_start`.

        Raises ValueError, naming the frame, where no readings lead to one.
        """
        c, imu = calibration, calibration
        if not isinstance(c, Imu):
            clock_offset = c.clock_offset if clock_offset is None else clock_offset
            density = c.gyroscope_noise_density, c.accelerometer_noise_density
            walk = c.gyroscope_random_walk, c.accelerometer_random_walk
            imu = Imu(density, walk=walk, bias_sigma=BIAS_SIGMA, camera_from_imu=c.camera_from_imu)
            if clock_offset is None:
                imu = replace(imu, clock_sigma=(CLOCK_SIGMA,))
        assert isinstance(imu, Imu)
        made = cls(log, imu, clock_offset or 0.0)
        begin, until = float(times[0]), float(min(times[0] + BEGINNING, times[-1]))
        for i, step in enumerate(itertools.pairwise(times.tolist())):
            try:
                made._between(*step)
            except ValueError as error:
                raise ValueError(f"from frame {i} to {i + 1}: {error}") from None
        with jax.enable_x64(True):
            readings = made._between(begin, until)
            try:
                return replace(made, imu=at_rest(imu, *readings), rests_until=until)
            except ValueError as error:
                return replace(made, imu=moving(imu, *readings), why_moving=str(error))

    def control(self, start: float, end: float) -> Increments:
        """The control of the motion between two times by the clock of the camera, s."""
        start = max(start, self.rests_until)
        if start >= end:
            return self.imu.still()
        readings = self._between(start, end)
        # So that few programs are compiled; a reading of no seconds is none.
        more = (1 << (len(readings[0]) - 1).bit_length()) - len(readings[0])
        padded = (np.pad(x, ((0, more), (0, 0))[: x.ndim]) for x in readings)
        return _increments(*padded, self.imu.bias)

    def _between(self, start: float, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.log.between(start + self.clock_offset, end + self.clock_offset)


@Program
def _increments(
    seconds: jax.Array, gyroscope: jax.Array, accelerometer: jax.Array, bias: jax.Array
) -> Increments:
    return increments(seconds, gyroscope, accelerometer, bias)
