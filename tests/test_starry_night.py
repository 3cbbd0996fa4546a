"""Tests of the reader of Starry Night and of its benchmark, on a small file of its format."""

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import quick_jit
from scipy.spatial.transform import Rotation

from jaxslam.datasets.starry_night import (
    pixel_errors,
    rate_errors,
    read,
    window,
    windows,
    with_reversed_gyroscope,
    with_white_noise,
)
from jaxslam.filters.registry import make_filter
from jaxslam.models.motion import BodyRates

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import starry_night

from jaxslam.filters.ekf import EkfSlam

FRAMES, LANDMARK_COUNT = 26, 6
FOCAL, CENTRE = np.array([480.0, 490.0]), np.array([320.0, 240.0])
PIXEL_SIGMA = np.array([2.0, 3.0])
RATES_SIGMA = np.array([0.02, 0.03, 0.01, 0.05, 0.04, 0.06])


@cache
def recording():
    """The arrays of a file, the noise that was added to the pixels, and that of the rates.

    A vehicle circles above a table and looks down at it with a camera off its centre.
    """
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.15, FRAMES))
    velocity = np.array([0.3, 0.05, -0.02]) + 0.1 * rng.normal(size=(FRAMES, 3))
    turn = np.array([0.02, -0.03, 0.2]) + 0.1 * rng.normal(size=(FRAMES, 3))
    rotations, positions = [Rotation.from_rotvec([0.1, 0.2, 0.3])], [np.array([0.1, -0.2, 1.5])]
    for k in range(FRAMES - 1):
        dt = t[k + 1] - t[k]
        positions.append(positions[-1] + rotations[-1].apply(velocity[k] * dt))
        rotations.append(rotations[-1] * Rotation.from_rotvec(turn[k] * dt))
    C_cv = Rotation.from_rotvec([np.pi, 0.1, 0.0]).as_matrix()  # the camera looks down
    rho = np.array([0.1, -0.05, 0.02])
    points = np.column_stack(
        [rng.uniform(-0.4, 0.8, (LANDMARK_COUNT, 2)), rng.uniform(-0.3, 0.3, LANDMARK_COUNT)]
    )
    pixel_noise = PIXEL_SIGMA * rng.normal(size=(FRAMES, LANDMARK_COUNT, 2))
    rate_noise = RATES_SIGMA * rng.normal(size=(FRAMES, 6))
    y = np.full((4, FRAMES, LANDMARK_COUNT), -1.0)
    for k in range(FRAMES):
        p = (C_cv @ (rotations[k].inv().apply(points - positions[k]) - rho).T).T
        y[:2, k] = (FOCAL * p[:, :2] / p[:, 2:] + CENTRE + pixel_noise[k]).T
        y[2:, k] = y[:2, k]
        y[:, k, (k // 5 + np.arange(2)) % LANDMARK_COUNT] = -1  # landmarks go and come back
    y[:, 7] = -1  # a frame without any
    arrays = {
        "t": t[None],
        "theta_vk_i": np.array([r.as_rotvec() for r in rotations]).T,
        "r_i_vk_i": np.array(positions).T,
        "v_vk_vk_i": (velocity + rate_noise[:, :3]).T,
        "w_vk_vk_i": -(turn + rate_noise[:, 3:]).T,  # the wrong sign, as in the recording
        "v_var": RATES_SIGMA[:3, None] ** 2,
        "w_var": RATES_SIGMA[3:, None] ** 2,
        "rho_i_pj_i": points.T,
        "y_k_j": y,
        "y_var": np.array([*PIXEL_SIGMA, *PIXEL_SIGMA])[:, None] ** 2,
        "C_c_v": C_cv,
        "rho_v_c_v": rho[:, None],
        "b": np.array([[0.24]]),
    }
    for name, value in zip(("fu", "fv", "cu", "cv"), (*FOCAL, *CENTRE), strict=True):
        arrays[name] = np.array([[value]])
    return arrays, pixel_noise, rate_noise


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "starry_night.npz"
    np.savez(path, **recording()[0])
    return path


def test_the_errors_of_the_measurements_are_the_noise_that_was_added(path):
    arrays, pixel_noise, rate_noise = recording()
    data = read(path)
    visible = (arrays["y_k_j"][0] != -1)[..., None]
    np.testing.assert_array_equal(data.visible, visible[..., 0])
    assert not data.visible[7].any()
    np.testing.assert_allclose(
        pixel_errors(data), np.where(visible, pixel_noise, np.nan), atol=1e-9
    )
    right = with_reversed_gyroscope(data)
    np.testing.assert_allclose(rate_errors(right), rate_noise[:-1], atol=1e-9)
    # Its σ is that of the errors, as long as the truth does not jump; the others are the file's.
    np.testing.assert_allclose(right.rates_sigma[:3], RATES_SIGMA[:3])
    np.testing.assert_allclose(right.rates_sigma[3:], rate_noise[:-1, 3:].std(axis=0))
    np.testing.assert_allclose(data.rates_sigma, RATES_SIGMA)
    np.testing.assert_allclose(data.pixel_sigma, PIXEL_SIGMA)


def test_a_window_is_a_run_from_its_first_camera(path):
    data = read(path)
    run = window(data, 4, 10)
    T_BC = jax.tree.map(lambda x: x[0], run.poses)
    np.testing.assert_allclose(T_BC.as_matrix(), np.eye(4), atol=1e-12)
    assert run.measured.shape == (11, LANDMARK_COUNT, 2)
    np.testing.assert_array_equal(run.measured, data.pixels[4:15])
    # The true rates move the camera along its true path.
    rates = data.rates[4:14] - rate_errors(data)[4:14]
    controls = replace(run.controls, rates=jnp.asarray(rates))
    motion, nothing = BodyRates(data.rates_sigma), jnp.zeros(6)

    @quick_jit
    def path_of(controls):
        def move(T, control):
            T = T @ motion.displacement((), nothing, control)
            return T, T

        return jax.lax.scan(move, T_BC, controls)[1]

    last = jax.tree.map(lambda x: x[-1], path_of(controls))
    true = jax.tree.map(lambda x: x[-1], run.poses)
    np.testing.assert_allclose(last.as_matrix(), true.as_matrix(), atol=1e-12)
    # And the points are where the camera measures them.
    seen = jax.vmap(true.inverse().apply)(run.points)
    pixels = FOCAL * seen[:, :2] / seen[:, 2:] + CENTRE
    visible = np.asarray(run.visible[-1])
    np.testing.assert_allclose(
        (run.measured[-1] - pixels)[visible], recording()[1][14][visible], atol=1e-9
    )


def test_a_jump_of_the_truth_is_no_error_of_the_gyroscope(tmp_path):
    arrays, _, rate_noise = recording()
    theta = arrays["theta_vk_i"].copy()
    theta[:, 12] += 1.0  # for one frame, at more than 3 rad/s
    np.savez(tmp_path / "x.npz", **(arrays | {"theta_vk_i": theta}))
    sigma = with_reversed_gyroscope(read(tmp_path / "x.npz")).rates_sigma[3:]
    kept = np.delete(rate_noise[:-1], [11, 12], axis=0)
    np.testing.assert_allclose(sigma, kept[:, 3:].std(axis=0))


def test_white_noise_takes_the_place_of_the_recorded_one(path):
    data = with_reversed_gyroscope(read(path))
    drawn = [with_white_noise(data, seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0].pixels, drawn[1].pixels)
    assert not np.array_equal(drawn[0].rates, drawn[2].rates)
    pixels = np.stack([pixel_errors(with_white_noise(data, seed)) for seed in range(40)])
    rates = np.stack([rate_errors(with_white_noise(data, seed)) for seed in range(40)])
    np.testing.assert_allclose(np.nanstd(pixels, axis=(0, 1, 2)), PIXEL_SIGMA, rtol=0.05)
    np.testing.assert_allclose(rates.std(axis=(0, 1)), data.rates_sigma, rtol=0.1)
    assert (drawn[0].pixels[~data.visible] == -1).all()
    # Nothing is left of the recorded errors.
    left = np.nanmean(pixels.mean(axis=0) * pixel_errors(data), axis=(0, 1)) / PIXEL_SIGMA**2
    assert np.abs(left).max() < 0.1


def test_windows_share_no_frame_and_leave_none_out_that_fits(path):
    data = read(path)
    runs = windows(data, 7)
    assert runs.measured.shape[0] == FRAMES // 8
    expected = data.pixels[: 3 * 8].reshape(3, 8, LANDMARK_COUNT, 2)
    np.testing.assert_array_equal(runs.measured, expected)
    assert windows(data, FRAMES - 1).measured.shape[0] == 1


@pytest.mark.parametrize(("start", "steps"), [(0, FRAMES), (-1, 5), (FRAMES - 5, 5), (0, 0)])
def test_a_window_outside_the_recording_is_refused(path, start, steps):
    with pytest.raises(ValueError, match=f"not in {FRAMES} frames"):
        window(read(path), start, steps)


@pytest.mark.parametrize("steps", [0, -3, FRAMES])
def test_a_recording_without_a_window_is_refused(path, steps):
    with pytest.raises(ValueError, match=f"no window of {steps} steps"):
        windows(read(path), steps)


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "x.npz"
    with pytest.raises(ValueError, match=r"x\.npz does not exist"):
        read(path)
    path.write_text("text")
    with pytest.raises(ValueError, match="not an npz file of numbers"):
        read(path)
    arrays = recording()[0]
    np.savez(path, **{name: a for name, a in arrays.items() if name not in ("t", "fu")})
    with pytest.raises(ValueError, match="lacks t, fu: it is no Starry Night"):
        read(path)
    for change, message in (
        ({"y_k_j": arrays["y_k_j"][:2]}, r"y_k_j must have the shape \(4, 26, 6\)"),
        ({"w_var": np.ones((2, 1))}, r"w_var must have the shape \(3, 1\), not \(2, 1\)"),
        ({"fu": np.array([[np.nan]])}, "fu holds a number that is not finite"),
        ({"t": arrays["t"][:, ::-1]}, "t must increase"),
    ):
        np.savez(path, **(arrays | change))
        with pytest.raises(ValueError, match=message):
            read(path)


def test_each_measured_number_may_have_its_own_noise(path):
    """S − S without noise is R: one σ for both coordinates, or one each."""
    data = read(path)
    told = starry_night.pieces(data, "odometry", 0.5)

    @quick_jit
    def ellipse(sigma):
        sensor = replace(told["sensor"], sigma=sigma)
        slam = make_filter("world", **{**told, "sensor": sensor})
        assert isinstance(slam, EkfSlam)
        slots = jnp.zeros(1, int)
        return slam.predict_features(slam.init(1), slam.motion.still(), slots).covariance[0]

    for sigma, expected in ((jnp.array([2.0, 3.0]), [4.0, 9.0]), (jnp.array(1.5), [2.25] * 2)):
        without, S = ellipse(0 * sigma), ellipse(sigma)
        np.testing.assert_allclose(S - without, np.diag(expected), atol=1e-9)


def test_white_noise_has_no_correlation_and_shared_noise_has(path):
    data = read(path)
    found = starry_night.noise(data)
    few = 5 / np.sqrt(FRAMES * LANDMARK_COUNT)
    for axis in "uv":
        assert np.abs(found["pixel_correlation"][axis][:2]).max() < few
        assert abs(found["pixel_correlation_between_landmarks"][axis]) < few
    shared = np.random.default_rng(1).normal(size=(FRAMES, 1, 2)) * 10
    found = starry_night.noise(replace(data, pixels=data.pixels + shared))
    for axis in "uv":
        assert found["pixel_correlation_between_landmarks"][axis] > 0.8
    # A walk of pixels is close to itself one step before.
    walk = np.cumsum(np.random.default_rng(2).normal(size=(FRAMES, 1, 2)), axis=0) * 10
    found = starry_night.noise(replace(data, pixels=data.pixels + walk))
    for axis in "uv":
        assert found["pixel_correlation"][axis][0] > 0.5


def test_the_benchmark_writes_its_files(path, tmp_path, capsys):
    out, docs = tmp_path / "results" / "starry_night.json", tmp_path / "docs"
    options = starry_night.Options(
        data=path, filters=("robocentric",), landmarks=("inverse_scaling",), steps=7, out=out,
        docs=docs, variants=("odometry", "odometry-white"), seeds=2,
    )  # fmt: skip
    starry_night.main(options)
    summary = json.loads(out.read_text())
    white = summary["variants"]["odometry-white"]["robocentric/inverse_scaling"]
    assert white["windows"] == 6
    result = summary["variants"]["odometry"]["robocentric/inverse_scaling"]
    assert (result["windows"], result["diverged"], result["lost"]) == (3, 0, 0)
    assert len(result["nees"]) == 7
    # White noise as stated, in three windows: a consistent filter is below with 99.99 %.
    assert 0 < result["nees_end"] < 14.2
    # 68 innovations of 2 numbers or so: within a half of 1.
    assert 0.5 < result["nis_per_dof"] < 1.5
    assert result["rmse_m"] < 0.2
    assert "Windows of 7 steps" in (docs / "starry-night.md").read_text()
    assert (docs / "starry-night.png").stat().st_size > 1000


def test_numbers_of_windows_are_those_of_their_records():
    rng = np.random.default_rng(0)
    records = {
        "nees": rng.chisquare(6, (5, 30)),
        "nis": rng.chisquare(4, (5, 30)),
        "nis_dof": np.full((5, 30), 4.0),
        "error": rng.normal(size=(5, 30, 6)),
        "variance": np.full((5, 30, 6), 4.0),
    }
    records["nees"][1, 3] = np.nan
    records["nees"][2, -1] = 1000.0
    numbers = starry_night.summarise(records)
    kept = [0, 2, 3, 4]
    assert (numbers["windows"], numbers["diverged"], numbers["lost"]) == (5, 1, 2 / 5)
    assert numbers["nees_end"] == pytest.approx(records["nees"][kept, -1].mean())
    assert numbers["nis_per_dof"] == pytest.approx(records["nis"][kept].mean() / 4)
    squares = (records["error"][kept] ** 2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    rmse = np.sqrt(squares)
    assert (numbers["rmse_m"], numbers["rmse_rad"]) == pytest.approx(tuple(rmse))
    assert numbers["sigma_over_rmse_m"] == pytest.approx(np.sqrt(12) / rmse[0])
    assert numbers["sigma_over_rmse_rad"] == pytest.approx(np.sqrt(12) / rmse[1])
    assert abs(numbers["nis_correlation"][0]) < 0.4


def test_a_missing_recording_is_one_line_and_status_2(tmp_path, capsys):
    options = starry_night.Options(data=tmp_path / "no.npz", out=tmp_path / "x.json", docs=tmp_path)
    with pytest.raises(SystemExit) as stop:
        starry_night.main(options)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "no.npz does not exist: give the recording by --data" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"variants": ("flight",)}, "unknown variants 'flight'; known: odometry, "),
        ({"steps": 0}, "steps, seeds and nearest_depth must be positive, not 0"),
        ({"seeds": 0}, "must be positive, not 100, 0, 0.5"),
        ({"nearest_depth": 0.0}, "steps, seeds and nearest_depth must be positive"),
    ],
)
def test_options_that_make_no_sense_are_refused(fields, message):
    given: dict[str, Any] = {"data": Path("x.npz"), **fields}
    with pytest.raises(ValueError, match=message):
        starry_night.Options(**given)
