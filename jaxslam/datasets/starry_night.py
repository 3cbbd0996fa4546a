"""Starry Night: a camera and an inertial sensor among 20 landmarks, with truth by motion capture.

`dataset3.mat` of T. D. Barfoot, University of Toronto (used in *State Estimation for Robotics*),
as an `.npz` of its arrays. Frames: I the room, V the vehicle, C the left camera. The model of the
data: `p_C = C_cv (C_vi (ρ_I − r_I) − ρ_V)`, `u = f_u x/z + c_u`, `v = f_v y/z + c_v`.

In the file at hand the angular rates have the opposite sign of what the poses say, and `w_var` is
the variance of that difference: see `with_reversed_gyroscope`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxslam._runtime.files import check_real, read_arrays
from jaxslam.models.camera import Camera, project
from jaxslam.models.motion import VehicleRates
from jaxslam.simulation import Run

GLITCH = 3.0
"""Rate above which the vehicle does not turn, rad/s: the truth jumps by 0.6 rad and back in one
frame, at 10 rad/s."""
SHAPES: dict[str, tuple[Any, ...]] = {
    "t": (1, None), "theta_vk_i": (3, None), "r_i_vk_i": (3, None), "w_vk_vk_i": (3, None),
    "v_vk_vk_i": (3, None), "w_var": (3, 1), "v_var": (3, 1), "rho_i_pj_i": (3, -1),
    "y_k_j": (4, None, -1), "y_var": (4, 1), "C_c_v": (3, 3), "rho_v_c_v": (3, 1),
    "fu": (1, 1), "fv": (1, 1), "cu": (1, 1), "cv": (1, 1),
}  # fmt: skip
"""Arrays of the file; None is the number of frames, −1 that of landmarks."""


@dataclass(frozen=True)
class StarryNight:
    """The recording, as the left camera sees it. SI units, radians, pixels."""

    time: Float[np.ndarray, " frames"]
    poses: jaxlie.SE3
    """T_IC of every frame, true."""
    points: Float[np.ndarray, "landmarks 3"]
    """In I, true."""
    pixels: Float[np.ndarray, "frames landmarks 2"]
    """(u, v) of the left camera; meaningless where not visible."""
    visible: Bool[np.ndarray, "frames landmarks"]
    rates: Float[np.ndarray, "frames 6"]
    """Measured linear and angular velocity of V in its own axes, from this frame to the next."""
    rates_sigma: Float[np.ndarray, " 6"]
    pixel_sigma: Float[np.ndarray, " 2"]
    vehicle_from_camera: jaxlie.SE3
    """T_VC."""
    camera: Camera

    @property
    def frames(self) -> int:
        return self.time.size


def read(path: str | Path) -> StarryNight:
    """Read the arrays. Raises ValueError, naming the file, unless they are those of the data."""
    path = Path(path)
    a = read_arrays(path, SHAPES)
    _check(path, a)
    a = {name: np.asarray(x, float) for name, x in a.items()}
    rotation = jaxlie.SO3.from_matrix(jnp.asarray(a["C_c_v"].T))
    T_VC = jaxlie.SE3.from_rotation_and_translation(rotation, jnp.asarray(a["rho_v_c_v"].ravel()))
    # C_vi = Exp(−θ), so that the vehicle's axes in the room are Exp(θ).
    T_IV = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.exp(jnp.asarray(a["theta_vk_i"].T)), jnp.asarray(a["r_i_vk_i"].T)
    )
    pixels = np.moveaxis(a["y_k_j"][:2], 0, -1)
    return StarryNight(
        time=a["t"].ravel(),
        poses=jax.vmap(lambda T: T @ T_VC)(T_IV),
        points=a["rho_i_pj_i"].T,
        pixels=pixels,
        visible=(pixels != -1).all(axis=-1),
        rates=np.concatenate([a["v_vk_vk_i"], a["w_vk_vk_i"]]).T,
        rates_sigma=np.sqrt(np.concatenate([a["v_var"], a["w_var"]]).ravel()),
        pixel_sigma=np.sqrt(a["y_var"].ravel()[:2]),
        vehicle_from_camera=T_VC,
        camera=Camera(
            jnp.asarray([a["fu"].item(), a["fv"].item()]),
            jnp.asarray([a["cu"].item(), a["cv"].item()]),
        ),
    )


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    missing = [name for name in SHAPES if name not in arrays]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: it is no Starry Night")
    sizes = {None: arrays["t"].size, -1: arrays["rho_i_pj_i"].shape[-1]}
    for name, shape in SHAPES.items():
        wanted = tuple(sizes.get(size, size) for size in shape)
        if arrays[name].shape != wanted:
            raise ValueError(
                f"{path}: {name} must have the shape {wanted}, not {arrays[name].shape}"
            )
        check_real(f"{path}: {name}", arrays[name])
    for name in ("w_var", "v_var", "y_var"):
        if (arrays[name] <= 0).any():
            raise ValueError(f"{path}: {name} holds a variance that is not positive")
    if (np.diff(arrays["t"].ravel()) <= 0).any():
        raise ValueError(f"{path}: t must increase")


def with_reversed_gyroscope(data: StarryNight) -> StarryNight:
    """With the opposite angular rates, and the σ of their errors, found against the truth.

    The recorded ones correlate with the true ones by −0.86, −0.66 and −0.27; reversed, their
    errors are smaller and nearly white. Steps at which the truth itself jumps do not count.
    """
    sign = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    turned = replace(data, rates=sign * data.rates)
    errors = rate_errors(turned)
    true = turned.rates[:-1] - errors
    steady = (np.abs(true[:, 3:]) < GLITCH).all(axis=1)
    sigma = np.concatenate([data.rates_sigma[:3], errors[steady, 3:].std(axis=0)])
    return replace(turned, rates_sigma=sigma)


def with_white_noise(data: StarryNight, seed: int) -> StarryNight:
    """The true measurements with independent Gaussian errors of the stated σ in place of theirs."""
    rng = np.random.default_rng(seed)
    true = data.rates[:-1] - rate_errors(data)
    rates = data.rates.copy()
    rates[:-1] = true + data.rates_sigma * rng.normal(size=true.shape)
    drawn = data.pixel_sigma * rng.normal(size=data.pixels.shape)
    pixels = np.where(data.visible[..., None], data.pixels - pixel_errors(data) + drawn, -1.0)
    return replace(data, rates=rates, pixels=pixels)


def window(data: StarryNight, start: int, steps: int) -> Run:
    """Frames `start` to `start + steps` as a run whose base B is the camera of its first frame.

    Its controls are `VehicleRates`. Raises ValueError for a window that is not in the recording.
    """
    if steps < 1 or start < 0 or start + steps >= data.frames:
        raise ValueError(
            f"a window of {steps} steps from frame {start} is not in {data.frames} frames"
        )
    frames = slice(start, start + steps + 1)
    T_IC = jax.tree.map(lambda x: x[frames], data.poses)
    T_CI = jax.tree.map(lambda x: x[0], T_IC).inverse()

    def every(tree, count):
        return jax.tree.map(lambda x: jnp.tile(x, (count, *[1] * x.ndim)), tree)

    return Run(
        poses=jax.vmap(lambda T: T_CI @ T)(T_IC),
        points=jax.vmap(T_CI.apply)(jnp.asarray(data.points)),
        measured=jnp.asarray(data.pixels[frames]),
        visible=jnp.asarray(data.visible[frames]),
        controls=VehicleRates(
            rates=jnp.asarray(data.rates[start : start + steps]),
            seconds=jnp.asarray(np.diff(data.time[frames])),
            camera=every(data.vehicle_from_camera, steps),
        ),
        cameras=every(data.camera, steps + 1),
    )


def windows(data: StarryNight, steps: int) -> Run:
    """All windows of that many steps, one after the other: a batch of runs without common frames.

    Raises ValueError where there is none.
    """
    starts = range(0, data.frames - steps, steps + 1) if steps > 0 else range(0)
    if not starts:
        raise ValueError(f"{data.frames} frames have no window of {steps} steps")
    runs = [window(data, start, steps) for start in starts]
    return jax.tree.map(lambda *parts: jnp.stack(parts), *runs)


def pixel_errors(data: StarryNight) -> Float[np.ndarray, "frames landmarks 2"]:
    """Measured minus true pixel, NaN where a landmark is not visible."""

    def frame(T_IC):
        seen = jax.vmap(T_IC.inverse().apply)(jnp.asarray(data.points))
        return jax.vmap(project, in_axes=(None, 0))(data.camera, seen)

    true = np.asarray(jax.vmap(frame)(data.poses))
    return np.where(data.visible[..., None], data.pixels - true, np.nan)


def rate_errors(data: StarryNight) -> Float[np.ndarray, "steps 6"]:
    """Measured minus true rates of the vehicle, the true ones from its poses."""
    T_CV = data.vehicle_from_camera.inverse()
    T_IV = jax.vmap(lambda T: T @ T_CV)(data.poses)
    before, after = (jax.tree.map(lambda x, s=s: x[s], T_IV) for s in (slice(-1), slice(1, None)))

    def rates(a, b, seconds):
        step = a.inverse() @ b
        return jnp.concatenate([step.translation(), step.rotation().log()]) / seconds

    true = jax.vmap(rates)(before, after, jnp.asarray(np.diff(data.time)))
    return data.rates[:-1] - np.asarray(true)
