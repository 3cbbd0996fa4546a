"""The tracker where a camera sees what it should not: is a lie believed, and what comes after?

    python benchmarks/disturbances.py
    python benchmarks/disturbances.py --only black cut --seeds 3

Synthetic videos whose truth is known exactly, with the settings of `jaxslam track`. A *lie* is a
frame that is said to be tracked, in the first map, and of which the NEES beyond scale is that of an
error of 5 σ; after a cut, any frame that is: the camera is elsewhere. Results are added to
`disturbances.json`, and their table to `docs/stress.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import cv2
import numpy as np
from benchmark import RESULTS, Benchmark, table, write_table
from scipy.stats import chi2
from starts import LIE

from jaxslam.evaluation import errors_beyond_scale
from jaxslam.io.source import Frame, Source
from jaxslam.statistics.beyond_scale import one_scale
from jaxslam.tracking.policy import Policy
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.synthetic import (
    add_noise,
    handheld_trajectory,
    render,
    room,
    synthetic_source,
)
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import TRACKED

RATE = 30
MARK = "<!-- by disturbances.py -->"
FIRST_SEED = 150
"""Of the videos; nothing was tried on these."""


class Disturbed(NamedTuple):
    """A video of which the frames `during` are not as they should be."""

    frames: Iterator[Frame]
    T_wc: np.ndarray
    """Where the camera is; NaN where it is in another world."""
    during: range
    wrong: float = 0.0
    """Share of the matches of which the place is any other in the ellipse."""


class Confused:
    """A search that errs while it is `on`, as often as its share says."""

    def __init__(self, share: float, seed: int) -> None:
        self.share, self.on = share, False
        self._rng, self._agreeing = np.random.default_rng(seed), Policy.agreeing

    def agreeing(self, policy, seen, matches, landmarks, agree, *, lost):
        """With wrong places in that of the true ones."""
        if self.on:
            wrong = self._rng.random(len(seen.slots)) < self.share
            pixels = [
                self._elsewhere(seen, owner) if wrong[owner] else pixel
                for owner, pixel in zip(matches.owner, matches.pixels, strict=True)
            ]
            matches = matches._replace(pixels=np.array(pixels).reshape(-1, 2))
        return self._agreeing(policy, seen, matches, landmarks, agree, lost=lost)

    def _elsewhere(self, seen, row):
        angle, radius = self._rng.uniform(0, 2 * np.pi), 3 * np.sqrt(self._rng.random())
        aside = radius * np.array([np.cos(angle), np.sin(angle)])
        return seen.predicted[row] + np.linalg.cholesky(seen.covariances[row]) @ aside


def black(seed: int) -> Disturbed:
    """5 s without light."""
    source, during = _source(330, seed), range(60, 60 + 5 * RATE)
    return Disturbed(
        _changed(source, during, lambda frame: np.zeros_like(frame.image)), *_of(source, during)
    )


def cut(seed: int) -> Disturbed:
    """From here on another room."""
    source, other, during = _source(180, seed), list(_source(180, seed + 1000)), range(80, 180)
    T_wc = _of(source, during)[0].copy()
    T_wc[during.start :] = np.nan
    return Disturbed(_changed(source, during, lambda f: other[f.index].image), T_wc, during)


def cut_back(seed: int) -> Disturbed:
    """3 s of another room, and this one again, a little further on."""
    source, other, during = _source(240, seed), list(_source(240, seed + 1000)), range(80, 170)
    T_wc = _of(source, during)[0].copy()
    T_wc[during.start : during.stop] = np.nan
    return Disturbed(_changed(source, during, lambda f: other[f.index].image), T_wc, during)


def hand(seed: int) -> Disturbed:
    """A hand, blurred, goes across in front of the lens."""
    source, during = _source(180, seed), range(60, 100)
    noise = np.random.default_rng(seed).integers(60, 120, (480, 400), dtype=np.uint8)
    skin = cv2.GaussianBlur(noise, (0, 0), 3)

    def covered(frame: Frame) -> np.ndarray:
        image, left = frame.image.copy(), 20 * (frame.index - during.start) - 200
        there = image[:, max(0, left) : left + 400]
        there[:] = skin[:, : there.shape[1]]
        return image

    return Disturbed(_changed(source, during, covered), *_of(source, during))


def ghost(seed: int) -> Disturbed:
    """A reflection: every picture has itself over it, 37 pixels aside."""
    source, during = _source(180, seed), range(60, 180)

    def doubled(frame: Frame) -> np.ndarray:
        return cv2.addWeighted(frame.image, 0.5, np.roll(frame.image, 37, axis=1), 0.5, 0)

    return Disturbed(_changed(source, during, doubled), *_of(source, during))


def half_wrong(seed: int) -> Disturbed:
    """Half of the picture moves otherwise, all of it alike: a lorry, a door."""
    source, during = _source(180, seed), range(60, 180)
    pan = np.cumsum(np.random.default_rng(seed).normal(0, 1, 400)) + 1.5 * np.arange(400)
    still = next(iter(source)).image

    def partly(frame: Frame) -> np.ndarray:
        image = frame.image.copy()
        aside = int(pan[frame.index] - pan[during.start])
        image[:, :320] = np.roll(still, aside, axis=1)[:, :320]
        return image

    return Disturbed(_changed(source, during, partly), *_of(source, during))


def scattered(seed: int) -> Disturbed:
    """Half of all matches are wrong, each in its own way: a repeated texture, leaves."""
    source, during = _source(180, seed), range(60, 180)
    return Disturbed(iter(source), *_of(source, during), wrong=0.5)


def rotation(seed: int) -> Disturbed:
    """A camera that only turns; it sets out after 4 s, within one."""
    during = range(1, 4 * RATE)
    T_wc = handheld_trajectory(np.arange(240) / RATE, seed)
    T_wc[:, :3, 3] = 0
    T_wc[during.stop :, :3, 3] = _set_out(240 - during.stop, seed)[:, :3, 3]
    return Disturbed(_rendered(T_wc, seed), T_wc, during)


def standing(seed: int) -> Disturbed:
    """60 s on a tripod, and then by hand."""
    during = range(1, 60 * RATE)
    T_wc = np.concatenate([np.tile(np.eye(4), (during.stop, 1, 1)), _set_out(90, seed)])
    return Disturbed(_rendered(T_wc, seed), T_wc, during)


def _set_out(count: int, seed: int) -> np.ndarray:
    """Poses of a hand that comes from rest to its speed within a second."""
    pace = np.clip(np.arange(count) / RATE, 0, 1)
    return handheld_trajectory(np.cumsum(3 * pace**2 - 2 * pace**3) / RATE, seed)


DISTURBANCES: dict[str, tuple[Callable[[int], Disturbed], str]] = {
    "black": (black, "5 s black"),
    "cut": (cut, "a cut to another room"),
    "cut_back": (cut_back, "3 s of another room, and back"),
    "hand": (hand, "a hand in front, 1.3 s"),
    "scattered": (scattered, "half of the matches wrong, each differently, 4 s"),
    "half_wrong": (half_wrong, "half of the image moves differently, 4 s"),
    "ghost": (ghost, "a double image, 4 s"),
    "rotation": (rotation, "pure rotation, 4 s from the start"),
    "standing": (standing, "standing, 60 s from the start"),
}
"""By name, and in words."""


@dataclass(frozen=True, kw_only=True)
class Disturbances(Benchmark):
    """Videos that are disturbed."""

    only: tuple[str, ...] = tuple(DISTURBANCES)
    """Disturbances."""
    seeds: int = 5
    """Videos of each."""
    filter: str = "recommended"
    """Filter."""
    out: Path = RESULTS / "disturbances.json"
    double = False

    def measure(self) -> Iterator[dict[str, Any]]:
        results, settings = self.found(), TrackerSettings(filter=self.filter)
        for name in self.only:
            results[name] = []
            for seed in range(FIRST_SEED, FIRST_SEED + self.seeds):
                results[name].append(measure(DISTURBANCES[name][0](seed), settings, seed))
                print(name, seed, results[name][-1], flush=True)
            yield results

    def report(self, results: dict[str, Any]) -> None:
        write_table(self.docs / "stress.md", MARK, as_table(results))


def _source(frames: int, seed: int) -> Source:
    return synthetic_source(frames=frames, seed=seed, rate=RATE)


def _of(source: Source, during: range) -> tuple[np.ndarray, range]:
    assert source.reference is not None
    return source.reference.T_wc, during


def _changed(
    source: Source, during: range, picture: Callable[[Frame], np.ndarray]
) -> Iterator[Frame]:
    for frame in source:
        yield replace(frame, image=picture(frame)) if frame.index in during else frame


def _rendered(T_wc: np.ndarray, seed: int) -> Iterator[Frame]:
    """The room of a seed from these poses; one that is as the one before is rendered once."""
    calibration = _source(1, seed).calibration
    quads, before, clean = room(seed, calibration.fx), np.full((4, 4), np.nan), None
    for index, pose in enumerate(T_wc):
        if clean is None or not np.array_equal(pose, before):
            before, clean = pose, render(quads, pose, calibration)
        yield Frame(index, index / RATE, add_noise(clean, np.random.default_rng([seed, index])))


def measure(disturbed: Disturbed, settings: TrackerSettings, seed: int) -> dict[str, float]:
    """What becomes of a tracker: shares of the frames meanwhile, and in the last second."""
    tracker = Tracker(_source(1, seed).calibration, settings)
    during = disturbed.during if disturbed.wrong else range(0)
    confused, results = Confused(disturbed.wrong, seed), []
    with mock.patch.object(Policy, "agreeing", lambda *a, **k: confused.agreeing(*a, **k)):
        for frame in disturbed.frames:
            confused.on = frame.index in during
            results.append(tracker.track(frame))
    tracked = np.array([result.state == "tracked" for result in results])
    believed = tracked & [result.map == 0 for result in results]
    index = np.arange(len(results))
    elsewhere = np.isnan(disturbed.T_wc[:, 0, 0])
    lies = believed & elsewhere
    known = np.flatnonzero(believed & ~elsewhere)
    poses, covariances = ([getattr(results[k], x) for k in known] for x in ("T_wc", "covariance"))
    fixed = np.array([results[k].unit_fixed for k in known])
    stacked = np.stack(poses), disturbed.T_wc[known], np.stack(covariances)
    best = errors_beyond_scale(TRACKED, *stacked)
    nees, dof = one_scale(*best, fixed).nees, np.where(fixed, 6, 5)
    lies[known] = chi2.sf(nees, dof) < LIE
    during, after = np.isin(index, disturbed.during), index >= disturbed.during.stop
    late = after & (index >= len(index) - RATE)
    back = np.flatnonzero(believed & after)
    return {
        "back_after": float(back[0] - disturbed.during.stop) if len(back) else -1.0,
        "tracked_during": float(tracked[during].mean()),
        "tracked_at_end": float(tracked[late].mean())
        if late.any()
        else float(tracked[-RATE:].mean()),
        "in_first_map_at_end": float(results[-1].map == 0),
        "maps": tracker.restarts + 1,
        "reversed": tracker.reversed,
        "lies": float(lies.sum() / tracked.sum()),
        "beyond_scale": float(np.median(nees / dof)),
    }


def as_table(results: dict[str, list[dict[str, float]]]) -> str:
    """As Markdown, a row for each disturbance."""
    header = ("disturbance", "videos", "tracked meanwhile", "in the last second")
    rows = []
    for name, (_, words) in DISTURBANCES.items():
        if of := results.get(name):
            mean = {key: float(np.mean([row[key] for row in of])) for key in of[0]}
            shares = ("tracked_during", "tracked_at_end", "in_first_map_at_end")
            numbers = (f"{mean[key]:.2g}" for key in ("maps", "beyond_scale"))
            row = (words, len(of))
            row += (*(f"{mean[key]:.0%}" for key in shares), *numbers)
            rows.append((*row, f"{mean['lies']:.1%}"))
    return table((*header, "in the first map", "maps", "NEES/dof", "beyond 5 σ"), rows)


if __name__ == "__main__":
    Disturbances.run()
