"""Recorded trajectories that tests make up: a slow, smooth motion as a TUM file."""

import numpy as np
from scipy.spatial.transform import Rotation


def path_at(times):
    """A slow, smooth motion: positions and turns, of which x tells the time."""
    position = np.stack([times**2 / 10, np.sin(times), 0.3 * np.cos(times)], axis=1)
    return position, Rotation.from_rotvec(np.outer(np.sin(0.5 * times), [0.3, 1.0, -0.2]))


def write(path, times, *, jitter=0.0, flip=False):
    """The motion at these times as a TUM file, with Gaussian jitter in metres."""
    position, turn = path_at(times)
    rng = np.random.default_rng(0)
    quaternions = turn.as_quat()
    if flip:
        quaternions *= rng.choice([-1, 1], (times.size, 1))
    rows = [times, *(position + jitter * rng.normal(size=position.shape)).T, *quaternions.T]
    np.savetxt(path, np.column_stack(rows), fmt="%.10f", header="t tx ty tz qx qy qz qw")
    return path
