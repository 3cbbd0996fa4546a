"""Real measurements with truth: how consistent is a monocular filter on Starry Night?

`python benchmarks/starry_night.py --data starry_night.npz` cuts the recording into windows without
common frames, each a run from a known pose, and uses the left camera only. The variants are the
measured velocities as odometry with the gyroscope's sign put right (`odometry`) or as recorded
(`recorded`), the pixels alone (`velocity`), and for control both with white noise simulated in
place of the recorded one (`odometry-white`, `velocity-white`). It writes, whole after every
filter, `benchmarks/results/starry_night.json`, `docs/starry-night.md` and its figure.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import tyro

import jaxslam
from jaxslam._runtime.files import write_atomically, write_json
from jaxslam._runtime.lookup import lookup
from jaxslam.consistency.montecarlo import filter_run
from jaxslam.datasets.starry_night import (
    StarryNight,
    pixel_errors,
    rate_errors,
    read,
    windows,
    with_reversed_gyroscope,
    with_white_noise,
)
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.registry import make_filter
from jaxslam.landmarks import LANDMARKS
from jaxslam.models.depth import InverseDepth
from jaxslam.models.motion import AbstractMotion, BodyRates, ConstantVelocity
from jaxslam.models.sensors import Pinhole
from jaxslam.plots.starry_night import plot_starry_night
from jaxslam.simulation import Room, Run, sightings
from jaxslam.statistics import lost_threshold, mean_band

VARIANTS = {
    "odometry": "measured velocities as odometry, the gyroscope reversed",
    "odometry-white": "the same windows with white noise, simulated with the same σ",
    "recorded": "measured velocities as odometry, as they are in the file",
    "velocity": "pixels alone, constant velocity with white accelerations, from rest",
    "velocity-white": "pixels alone, with white noise, simulated with the same σ",
}
VELOCITY_SIGMA = (0.2, 0.2, 0.2, 0.2, 0.2, 0.2)
"""`velocity`: σ of the velocity at the start around zero, m/s and rad/s."""
ACCELERATION_SIGMA = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
"""`velocity`: σ of the white acceleration, m/s² and rad/s²."""
LAGS = (1, 2, 5, 10, 20)
"""Steps over which noise is compared with itself."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    data: Path = Path("starry_night.npz")
    """The recording, `starry_night.npz`."""
    filters: tuple[str, ...] = ("robocentric", "world")
    landmarks: tuple[str, ...] = ("inverse_scaling", "inverse_depth")
    variants: tuple[str, ...] = tuple(VARIANTS)
    """What the filters are given: see above."""
    seeds: int = 10
    """Simulations of all windows, of the white variants."""
    steps: int = 100
    """Of a window."""
    nearest_depth: float = 0.5
    """d_min, m: the prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)."""
    out: Path = Path("benchmarks/results/starry_night.json")
    docs: Path = Path("docs")
    """Folder of starry-night.md and starry-night.png."""
    page_only: bool = False
    """Only write page and figure again."""

    def __post_init__(self) -> None:
        lookup("variants", self.variants, VARIANTS)
        if self.steps < 1 or self.seeds < 1 or not self.nearest_depth > 0:
            raise ValueError(
                "steps, seeds and nearest_depth must be positive, not "
                f"{self.steps}, {self.seeds}, {self.nearest_depth}"
            )


def pieces(data: StarryNight, variant: str, nearest_depth: float) -> dict[str, Any]:
    """What a filter is told: the noise figures of the recording, and a prior on depth."""
    still = np.zeros(6)
    motion: AbstractMotion = BodyRates(data.rates_sigma)
    if variant.startswith("velocity"):
        motion = ConstantVelocity(ACCELERATION_SIGMA, still, VELOCITY_SIGMA)
    return {
        "motion": motion,
        "sensor": Pinhole(data.camera, data.pixel_sigma),
        "depth": InverseDepth.beyond(nearest_depth),
    }


def filters_of(told: dict[str, Any], options: Options) -> dict[str, AbstractFilter]:
    """By name, `filter/landmarks`."""
    landmarks = lookup("landmarks", options.landmarks, LANDMARKS)
    return {
        f"{name}/{landmark.name}": make_filter(name, landmark=landmark, **told)
        for name in options.filters
        for landmark in landmarks.values()
    }


def measure(data: StarryNight, options: Options) -> Iterator[dict[str, Any]]:
    """`{variant: {"filter/landmarks": numbers}}`, yielded after every filter."""
    results: dict[str, Any] = {}
    most = jax.tree.map(
        lambda x: max(1, int(x.max())), jax.vmap(sightings)(windows(data, options.steps))
    )
    # The slot of a landmark is its number, in every window.
    room = Room(data.points.shape[0], most.first, most.known, most.new)
    for variant in options.variants:
        results[variant] = {}
        told, batches = given(data, variant, options)
        for name, slam in filters_of(told, options).items():
            start = time.perf_counter()
            parts = [jax.device_get(_batch(slam, room, told["sensor"], runs)) for runs in batches]
            records = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
            results[variant][name] = summarise(records)
            seconds = time.perf_counter() - start
            last = {k: v for k, v in results[variant][name].items() if not isinstance(v, list)}
            print(f"{variant} {name}, {seconds:.0f} s: {json.dumps(last)}", flush=True)
            yield results


def given(data: StarryNight, variant: str, options: Options) -> tuple[dict[str, Any], list[Run]]:
    """What the filters are told in a variant, and batches of its windows."""
    if variant != "recorded":
        data = with_reversed_gyroscope(data)
    told = pieces(data, variant, options.nearest_depth)
    seeds = range(options.seeds) if variant.endswith("-white") else ()
    recordings = [with_white_noise(data, seed) for seed in seeds] or [data]
    batches = [windows(recording, options.steps) for recording in recordings]
    if variant.startswith("velocity"):
        batches = [replace(runs, controls=runs.controls.seconds) for runs in batches]
    return told, batches


@eqx.filter_jit
def _batch(slam: AbstractFilter, room: Room, sensor: Pinhole, runs: Run) -> dict[str, Any]:
    return jax.vmap(lambda run: filter_run(slam, room, sensor, run)[0])(runs)


def summarise(records: dict[str, np.ndarray]) -> dict[str, Any]:
    """Numbers of all windows [windows, steps, …]; NIS is pooled, NEES never over steps.

    A window is lost when its NEES at the end is above the 99.99 % quantile of χ², or not finite
    at any step; the others are all in the means.
    """
    nees = records["nees"]
    healthy = np.isfinite(nees).all(axis=1)
    good = {name: values[healthy] for name, values in records.items()}
    dof, count = good["error"].shape[-1], int(healthy.sum())
    band = mean_band(dof, max(count, 1))
    mean = good["nees"].mean(axis=0)
    lost = good["nees"][:, -1] > lost_threshold(dof)
    # Per step: position, orientation.
    squares = np.stack([_parts(good["error"] ** 2), _parts(good["variance"])])
    rmse, sigma = np.sqrt(squares.mean(axis=(1, 2)))
    seen = good["nis_dof"] > 0
    per_dof = np.where(seen, good["nis"] / np.where(seen, good["nis_dof"], 1), np.nan)
    return {
        "windows": int(healthy.size),
        "diverged": int((~healthy).sum()),
        "lost": float((lost.sum() + (~healthy).sum()) / healthy.size),
        "dof": dof,
        "band95": list(band),
        "nees_end": float(mean[-1]),
        "nees_median_end": float(np.median(good["nees"][:, -1])),
        "nees_all_steps": float(mean.mean()),
        "inside": float(np.mean((mean >= band[0]) & (mean <= band[1]))),
        "nis_per_dof": float(good["nis"].sum() / good["nis_dof"].sum()),
        "nis_dof": int(good["nis_dof"].sum()),
        "nis_correlation": [float(x) for x in _autocorrelation(per_dof, LAGS)],
        "rmse_m": float(rmse[0]),
        "rmse_rad": float(rmse[1]),
        "sigma_over_rmse_m": float(sigma[0] / rmse[0]),
        "sigma_over_rmse_rad": float(sigma[1] / rmse[1]),
        "nees": mean.tolist(),
        "nees_median": np.median(good["nees"], axis=0).tolist(),
    }


def _parts(per_axis: np.ndarray) -> np.ndarray:
    """Sums over the axes of position and of orientation, [windows, steps, 2]."""
    return np.stack([per_axis[..., :3].sum(axis=-1), per_axis[..., 3:].sum(axis=-1)], axis=-1)


def noise(data: StarryNight) -> dict[str, Any]:
    """What the recording's noise is like: is it white, and independent of landmark and axis?"""
    right = with_reversed_gyroscope(data)
    pixels, rates = pixel_errors(data), rate_errors(right)
    true = right.rates[:-1] - rates
    return {
        "lags": list(LAGS),
        "mean_step_s": float(np.diff(data.time).mean()),
        "pixel_sigma": data.pixel_sigma.tolist(),
        "rates_sigma": right.rates_sigma.tolist(),
        "rates_sigma_recorded": data.rates_sigma.tolist(),
        "gyroscope_with_truth": [
            float(np.corrcoef(data.rates[:-1, i], true[:, i])[0, 1]) for i in (3, 4, 5)
        ],
        "rates_beyond_4_sigma": (np.abs(rates) > 4 * right.rates_sigma).mean(axis=0).tolist(),
        # Time last, and a batch of sequences.
        "pixel_correlation": {
            axis: _autocorrelation(pixels[:, :, i].T, LAGS).tolist() for i, axis in enumerate("uv")
        },
        "pixel_correlation_between_landmarks": {
            axis: _between(pixels[:, :, i]) for i, axis in enumerate("uv")
        },
        "rate_correlation": {
            axis: _autocorrelation(rates[:, i][None], LAGS).tolist()
            for i, axis in enumerate(("v_x", "v_y", "v_z", "ω_x", "ω_y", "ω_z"))
        },
    }


def _autocorrelation(values: np.ndarray, lags: tuple[int, ...]) -> np.ndarray:
    """Of [sequences, time], NaN where there is no value; at each lag, NaN if none is so long."""
    centred = values - np.nanmean(values)

    def one(lag):
        products = centred[:, lag:] * centred[:, :-lag]
        both = np.isfinite(products)
        return products[both].mean() / np.nanvar(values) if both.any() else np.nan

    return np.array([one(lag) for lag in lags])


def _between(errors: np.ndarray) -> float:
    """Correlation of the errors of two landmarks in one frame, [frames, landmarks]."""
    centred = errors - np.nanmean(errors)
    total, count = np.nansum(centred, axis=1), np.isfinite(errors).sum(axis=1)
    pairs = (total**2 - np.nansum(centred**2, axis=1)).sum() / (count * (count - 1)).sum()
    return float(pairs / np.nanvar(errors))


# --- what it says -------------------------------------------------------------------------------


def page(summary: dict[str, Any]) -> str:
    """The Markdown page."""
    noise = summary["noise"]
    results = next(iter(summary["variants"].values()))
    depth = InverseDepth.beyond(summary["nearest_depth"])
    parts = [
        "# Starry Night: real measurements with truth",
        "Made by `python benchmarks/starry_night.py --data starry_night.npz`; do not edit. The "
        "data (T. D. Barfoot, University of Toronto) are those of a stereo camera and an inertial "
        "sensor among 20 landmarks, with motion capture as truth. Only the left camera is used. "
        f"Windows of {summary['steps']} steps without common frames are the runs, each begun at a "
        "known pose with an empty map; a landmark that comes back is still in the map. A "
        "consistent filter has a mean NEES of 6 at any one step. The windows of the recording are "
        "few, so that the 95 % band is wide. Those of the `-white` variants are "
        f"{summary['seeds']} simulations of the same windows: their noise is independent, their "
        "truth the same. Landmarks are where they are, and not drawn from the prior on depth, so "
        "that 6 is not exact even for a perfect filter. RMSE and σ are over all steps of all "
        "windows; *inside* is the share of steps in the band.",
        _in_short(summary["variants"]),
        "**Noise** as the recording states it: pixels σ "
        f"{_list(noise['pixel_sigma'], '.1f')}, velocities σ "
        f"{_list(noise['rates_sigma'][:3], '.3f')} m/s. **The gyroscope** of this file "
        "has the opposite sign of its poses: its axes correlate with the true "
        f"rates by {_list(noise['gyroscope_with_truth'], '+.2f')}, and its stated σ of "
        f"{_list(noise['rates_sigma_recorded'][3:], '.2f')} rad/s is that of the mis-signed "
        f"difference. Reversed, it has {_list(noise['rates_sigma'][3:], '.2f')} rad/s against the "
        "truth. Inverse depth is "
        f"{depth.mean:g} ± {depth.sigma:g} 1/m (d_min {summary['nearest_depth']:g} m, chosen for a "
        "table of landmarks 0.5 to 3 m away).",
        "![Mean NEES over the windows, and how the noise is correlated](starry-night.png)",
    ]
    for variant, filters in summary["variants"].items():
        if filters:
            first = next(iter(filters.values()))
            low, high = first["band95"]
            parts += [
                f"## `{variant}`: {VARIANTS[variant]}",
                f"{first['windows']} windows, 95 % band {low:.2f}–{high:.2f}.",
                _rows(filters),
            ]
    parts += ["## The noise is not white", _noise_text(noise, results)]
    return "\n\n".join(parts) + "\n"


def _in_short(variants: dict[str, Any]) -> str:
    """How much of the inconsistency is that of the noise: real beside simulated."""
    sentences = []
    for name in variants.get("odometry", {}):
        found = [variants.get(variant, {}).get(name) for variant in ("odometry", "odometry-white")]
        if all(found):
            real, white = (
                f"{_number(f['nees_end'])} (median {_number(f['nees_median_end'])}, NIS per dof "
                f"{f['nis_per_dof']:.2f})"
                for f in found
            )
            sentences.append(f"{name} has a mean NEES of {real}, with white noise {white}")
    if not sentences:
        return "**In short.** The noise of the recording is neither white nor independent."
    return (
        "**In short.** The noise of the recording is neither white nor independent. With odometry, "
        f"at the end: {'; '.join(sentences)}. What white noise leaves above 6 is the filter's own, "
        "or comes of the prior on depth."
    )


def _rows(filters: dict[str, Any]) -> str:
    lines = [
        "| filter | NEES at the end | median | all steps | inside | lost | NIS per dof | RMSE m | "
        "σ/RMSE | RMSE rad | σ/RMSE |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, f in filters.items():
        cells = (
            *(_number(f[key]) for key in ("nees_end", "nees_median_end", "nees_all_steps")),
            f"{f['inside']:.0%}",
            f"{f['lost']:.0%}",
            f"{f['nis_per_dof']:.2f}",
            f"{f['rmse_m']:.3f}",
            f"{f['sigma_over_rmse_m']:.2f}",
            f"{f['rmse_rad']:.3f}",
            f"{f['sigma_over_rmse_rad']:.2f}",
        )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _noise_text(noise: dict[str, Any], results: dict[str, Any]) -> str:
    between = noise["pixel_correlation_between_landmarks"]
    head = " | ".join(f"lag {lag}" for lag in noise["lags"])
    lines = [f"| correlation of | {head} |", "|---|" + "---|" * len(noise["lags"])]
    rows = {
        **{f"pixel error {axis}": c for axis, c in noise["pixel_correlation"].items()},
        **{f"rate error {axis}": c for axis, c in noise["rate_correlation"].items()},
        **{f"NIS per dof, {name}": f["nis_correlation"] for name, f in results.items()},
    }
    for name, values in rows.items():
        lines.append(f"| {name} | {' | '.join(f'{x:+.2f}' for x in values)} |")
    return "\n".join(
        [
            "The filters take every error as independent of the one before and of that of its "
            f"neighbour. Here (mean step {noise['mean_step_s']:.3f} s) it is not: two landmarks "
            f"in one frame have errors that correlate with {between['u']:+.2f} (u) and "
            f"{between['v']:+.2f} (v), and an error with itself later as in the table. Errors "
            "shared by a frame look like motion of the camera: the filter believes them, so that "
            "the NEES rises, while the innovations, in which the believed part is gone, stay "
            "small: an NIS per dof below 1 says under-confident where NEES says over-confident. "
            "That the NIS is correlated from step to step shows that something is wrong. The rates'"
            f" errors have long tails too: {_list(noise['rates_beyond_4_sigma'], '.1%')} of them "
            "are beyond 4 σ (0.006 % of a Gaussian's), partly where the truth jumps: a mean over "
            "few windows is that of the worst, and the median says more.",
            "",
            *lines,
        ]
    )  # fmt: skip


def _list(values: list[float], form: str) -> str:
    """`a, b and c`."""
    *first, last = (format(value, form) for value in values)
    return f"{', '.join(first)} and {last}"


def _number(value: float) -> str:
    return f"{value:.1e}" if value >= 1e4 else f"{value:.1f}"


def main(options: Options) -> None:
    """Measure, and write the three files after every filter."""
    if options.page_only:
        write(json.loads(options.out.read_text()), options)
        return
    jax.config.update("jax_enable_x64", True)
    if not options.data.exists():
        print(
            f"{options.data} does not exist: give the recording by --data starry_night.npz",
            file=sys.stderr,
        )
        raise SystemExit(2)
    data = read(options.data)
    for folder in (options.out.parent, options.docs):
        folder.mkdir(parents=True, exist_ok=True)
    for results in measure(data, options):
        summary = {
            "schema": 1,
            "version": jaxslam.__version__,
            "steps": options.steps,
            "nearest_depth": options.nearest_depth,
            "seeds": options.seeds,
            "device": jax.devices()[0].device_kind,
            "noise": noise(data),
            "variants": results,
        }
        write(summary, options)


def write(summary: dict[str, Any], options: Options) -> None:
    """The JSON file, the figure and the page."""
    write_json(options.out, summary, ensure_ascii=False)
    plot_starry_night(summary, options.docs / "starry-night.png")
    with write_atomically(options.docs / "starry-night.md") as path:
        path.write_text(page(summary))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
