"""The offset of clocks is found from rotations, to a few ms and with a σ that is one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxslam.evaluation.clock import clock_offset
from jaxslam.io.logs.log import Log
from jaxslam.io.tum import of_xytheta


def run(offset, seed, sigma=0.005, seconds=20.0, drift=0.0, mounting=None, flat=False):
    """An estimate of ten poses a second, late by the offset, and a truth of a hundred."""
    rng = np.random.default_rng(seed)
    true_times = np.arange(0, seconds, 0.01)
    rates, phases = rng.uniform(1.0, 3.0, (2, 3, 1))
    angles = np.array([[0.3], [0.3], [1.0]]) * np.sin(rates * true_times + 3 * phases)
    T = np.tile(np.eye(4), (len(true_times), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("xyz", angles.T).as_matrix()
    T[:, :2, 3] = np.stack([np.sin(true_times), true_times], axis=1)
    own = T[::10].copy()
    noise = rng.normal(size=(2, len(own), 3))
    walk, noise = drift * np.cumsum(noise[0], axis=0), sigma * noise[1]
    own[:, :3, :3] = Rotation.from_rotvec(noise + walk).as_matrix() @ own[:, :3, :3]
    own[:, :3, 3] += walk
    if mounting is not None:
        own = own @ mounting
    if flat:
        angle = angles[2] + 0.3 * true_times
        T = of_xytheta(np.column_stack([T[:, :2, 3], angle]))
        own = of_xytheta(np.column_stack([T[::10, :2, 2], angle[::10] + noise[:, 0]]))
    none = np.empty((0, 6, 6))
    return Log(true_times[::10] + offset, own, none), Log(true_times, T, none)


BODY = np.eye(4)
BODY[:3, :3] = Rotation.from_euler("xyz", [0.4, 1.2, -2.0]).as_matrix()


@pytest.mark.parametrize(
    ("offset", "how"),
    [
        (0.02, {"drift": 0.002}),
        (-0.02, {"mounting": BODY}),
        (0.137, {"flat": True}),
        (-0.05, {"seconds": 5.0}),
    ],
    ids=["drifting", "another body", "in the plane", "short"],
)
def test_an_offset_is_found_within_5_ms_and_its_sigma_is_one(offset, how):
    found = [clock_offset(*run(offset, seed, **how)) for seed in range(5)]
    assert all(x is not None and x.found for x in found)
    off = np.array([x.seconds - offset for x in found if x is not None])
    assert np.abs(off).max() < 0.005
    sigma = np.array([x.sigma for x in found if x is not None])
    assert np.sqrt(np.mean((off / sigma) ** 2)) < 2


def test_clocks_that_agree_have_no_offset():
    for seed in range(6):
        found = clock_offset(*run(0.0, seed))
        assert found is not None
        assert not found.found


@pytest.mark.parametrize(
    "spoil",
    [
        lambda own: own._replace(poses=own.poses[:1].repeat(len(own.times), 0)),
        lambda own: own._replace(times=own.times[:10], poses=own.poses[:10]),
        lambda own: own._replace(times=own.times + 60.0),
    ],
    ids=["no rotation", "few poses", "another hour"],
)
def test_where_rotations_do_not_tell_it_there_is_none(spoil):
    own, true = run(0.03, 0)
    found = clock_offset(spoil(own), true)
    assert found is None or not found.found
