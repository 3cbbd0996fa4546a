"""What the modes of a start from rest are in one planar run, frame by frame, and their figure: two
worlds that explain the pixels, and one of them dying."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxslam._numerics.arrays import AnyArray
from jaxslam.consistency import SimulatedFrame, run_through
from jaxslam.filters.linear.state import State
from jaxslam.filters.protocol import AbstractFilter
from jaxslam.filters.readouts import landmarks_from_above
from jaxslam.filters.slam import Slam
from jaxslam.filters.window.minimise import Minimum
from jaxslam.filters.window.problem import path, residuals
from jaxslam.filters.window.start import RestState
from jaxslam.plots.landmarks import region_from_above
from jaxslam.plots.style import COLOURS, GREY, new_figure, save
from jaxslam.simulation import Room, Run
from jaxslam.statistics.bands import normalised_squared

ALIKE = 0.7
"""Cosine of two paths, from which on they are of one mode."""


class Modes(NamedTuple):
    """Of every frame after 0 as long as the window holds all frames; the likeliest comes first."""

    weights: Float[np.ndarray, "frames modes"]
    """0 of places without a mode."""
    paths: Float[np.ndarray, "frames modes window 2"]
    """Where the camera was in every frame of the window, from frame 0 on, (x, z), m. After the
    newest frame nothing moves."""
    landmarks: Float[np.ndarray, "frames modes m 2"]
    """From the newest camera: azimuth (from z towards x, B's axes) and inverse distance, 1/m."""
    covariances: Float[np.ndarray, "frames modes m 2 2"]
    """Of these, given the scale, which no pixel tells."""
    misfits: Float[np.ndarray, "frames modes"]
    """Root mean square of all residuals so far, in σ of a pixel."""
    nees: Float[np.ndarray, " steps"]
    """Of the sum's pose, in every frame of the run."""


def modes_of_run(slam: AbstractFilter, room: Room, run: Run) -> Modes:
    """Follow the modes of a start from rest through a run.

    It ends where the sum goes on alone, or where frames of the window are merged. Raises
    ValueError for a filter without such a start.
    """
    if not isinstance(slam, Slam) or slam.start is None:
        raise ValueError("modes are those of a start from rest (+rest), and this filter has none")
    told, nees, newest, is_open = jax.device_get(_compiled(slam, room, run))
    whole = (newest == 1 + np.arange(len(newest))) & np.append(True, is_open[:-1])
    return Modes(*(numbers[: whole.sum()] for numbers in told), nees)


def _through(slam: Slam, room: Room, run: Run) -> tuple[Any, Array, Array, Array]:
    def told(state: RestState, _, frame: SimulatedFrame):
        nees = normalised_squared(*slam.pose_error(state, frame.pose))
        return _told(slam, state), nees, state.record.last, state.open

    return run_through(slam, room, run, told)[1]


_compiled = eqx.filter_jit(_through)
"""Once for all runs of a shape."""


def _told(slam: Slam, state: RestState) -> tuple[Array, ...]:
    """The fields of `Modes` that are each mode's, of one frame."""
    ekf, record, modes = slam.one, state.record, state.modes

    def one(minimum: Minimum, member: State) -> tuple[Array, ...]:
        at = path(ekf, record, minimum.x)
        r, slots = residuals(ekf, record, at, minimum.y), jnp.arange(record.first.size)
        misfit = jnp.sqrt(jnp.sum(r**2) / jnp.maximum(jnp.sum(record.compared) * r.shape[-1], 1))
        seen = landmarks_from_above(ekf, given_scale(member), slots)
        return at.frames.pose.translation(), *seen, misfit

    return jnp.exp(modes.log_weights), *jax.vmap(one)(modes.minima, state.sum.members)


def given_scale(state: State) -> State:
    """The Gaussian given λ: what is left when somebody tells the scale."""
    core: Any = state.core
    part, P = core.part("log_scale"), state.covariance
    across = P[:, part]
    left = P - across @ across.T / P[part, part]
    return replace(state, covariance=left)


def followed(modes: Modes) -> Int[np.ndarray, "frames modes"]:
    """A number for every mode, the same from frame to frame as long as it moves the same way, in
    the order in which they appear; −1 of places without a mode.

    Two paths are compared by their cosine, up to the older one's newest frame: scale and small
    bends change nothing of it.
    """
    numbers = np.full(modes.weights.shape, -1)
    last: dict[int, Float[np.ndarray, "k n"]] = {}
    for frame, (weights, paths) in enumerate(zip(modes.weights, modes.paths, strict=True)):
        here: dict[int, Float[np.ndarray, "k n"]] = {}
        for mode in np.flatnonzero(weights > 0):
            moved = paths[mode, 1 : frame + 2]
            numbers[frame, mode] = number = _number(moved, {**last, **here})
            here.setdefault(number, moved)
        last |= here
    return numbers


def _number(moved: Float[np.ndarray, "k n"], known: dict[int, Float[np.ndarray, "j n"]]) -> int:
    """Of the known path that this one is like, or a new one."""
    alike = {number: _cosine(moved[: len(other)], other) for number, other in known.items()}
    likest = max(alike, key=lambda number: alike[number], default=-1)
    return likest if alike.get(likest, 0.0) > ALIKE else len(known)


def _cosine(a: Float[np.ndarray, "k n"], b: Float[np.ndarray, "k n"]) -> float:
    return float(np.vdot(a, b) / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))


# --- the figure ---------------------------------------------------------------------------------

FRAMES = (1, 10, 20, 27, 40)
"""Of the maps."""
WORLDS = 2
"""That have maps: those with the most weight over all frames."""
LEAST = 0.005
"""Weight below which a world is dead."""
_SHARE = 0.393
"""Of a Gaussian in the plane inside one σ."""
_OTHERS, _DEAD, _FILTER = "#BBBBBB", "#F3F3F3", COLOURS[2]


@dataclass(frozen=True)
class Worlds:
    """What there is to be drawn of one run: the modes, the truth, and a filter, all in (x, z)."""

    modes: Modes
    numbers: Int[np.ndarray, "frames modes"]
    """Which world a mode is; −1 of none."""
    truth: Float[np.ndarray, "times 2"]
    """Where the camera is from frame 0 on, m."""
    points: Float[np.ndarray, "m 2"]
    """The true landmarks, m."""
    filtered: Float[np.ndarray, "steps 2"]
    """Where a filter with one mode believes the camera to be, m."""
    filter_name: str
    rate: float
    """Frames per second."""

    def shares(self) -> Float[np.ndarray, "frames worlds"]:
        """The weight of every world: the sum of its modes'."""
        each = np.arange(self.numbers.max() + 1)
        return np.sum(self.modes.weights[..., None] * (self.numbers[..., None] == each), axis=1)

    def mode(self, frame: int, number: int) -> int | None:
        """The likeliest mode of a world in a frame; None where it is dead."""
        weights = np.where(self.numbers[frame - 1] == number, self.modes.weights[frame - 1], 0.0)
        return int(np.argmax(weights)) if weights.max() > LEAST else None


def worlds_of(
    run: Run, modes: Modes, filtered: Float[AnyArray, "steps 2"], filter_name: str, rate: float
) -> Worlds:
    """What is drawn of a run, of its modes and of where a filter believes the camera to be in every
    frame after 0."""
    truth, points, filtered = map(np.asarray, (run.poses.translation(), run.points, filtered))
    return Worlds(modes, followed(modes), truth, points, filtered, filter_name, rate)


class _Look(NamedTuple):
    """Of a world that is shown."""

    colour: str
    way: str
    """In which its camera goes."""
    filtered: bool
    """Whether the filter is in it."""


def plot_modes(
    worlds: Worlds, frames: Sequence[int] = FRAMES, path: str | Path | None = None
) -> Figure:
    """Draw the two weightiest worlds at some frames, and the weights of all over the frames.

    Above: a row for each world, seen from above, the stronger the likelier, with 1σ of the
    landmarks; under every map the camera's path, enlarged. Where a world is dead only the truth is
    left, and what the filter still believes. Below: the weights, one on the other. Written to
    `path` where one is given. Raises ValueError where none of the frames has modes.
    """
    last = len(worlds.modes.weights)
    frames = [frame for frame in frames if 1 <= frame <= last]
    if not frames:
        raise ValueError(f"no frame to draw: the modes are known in frames 1 to {last}")
    looks = _looks(worlds)
    figure = new_figure(10, 3.7 * len(looks) + 2.4)
    figure.suptitle("Two worlds explain the same pixels, until one dies", fontsize=14)
    grid = figure.add_gridspec(len(looks) + 1, 1, height_ratios=[*[3.7] * len(looks), 2.1])
    *rows, bands = (figure.add_subfigure(grid[i]) for i in range(len(looks) + 1))
    for row, (number, look) in zip(rows, looks.items(), strict=True):
        _row(row, worlds, frames, number, look)
    for axes, frame in zip(rows[0].axes, frames, strict=False):
        axes.set_title(f"frame {frame}, {frame / worlds.rate:.2f} s", fontsize=11)
    _weights(bands.subplots(), worlds, frames, looks)
    _legend(bands, worlds)
    if path is not None:
        save(figure, path)
    return figure


def _looks(worlds: Worlds) -> dict[int, _Look]:
    """Of the worlds with the most weight over all frames."""
    weightiest = np.argsort(-worlds.shares().sum(axis=0), kind="stable")
    shown = weightiest[:WORLDS].tolist()
    astray = _nearest(worlds, shown)
    return {
        number: _Look(COLOURS[i], _way(worlds, number), number == astray)
        for i, number in enumerate(shown)
    }


def _nearest(worlds: Worlds, shown: list[int]) -> int:
    """Which of the worlds shown the filter is in: whose path it is nearest to."""
    away = np.zeros(len(shown))
    for frame in range(1, len(worlds.modes.weights) + 1):
        modes = [m for number in shown if (m := worlds.mode(frame, number)) is not None]
        if len(modes) == len(shown):
            here = worlds.modes.paths[frame - 1, modes, frame]
            away += np.linalg.norm(here - worlds.filtered[frame - 1], axis=1)
    return shown[int(np.argmin(away))]


def _way(worlds: Worlds, number: int) -> str:
    """Where the camera of a world goes, as long as it lives."""
    last = int(np.flatnonzero(worlds.shares()[:, number] > LEAST)[-1]) + 1
    mode = worlds.mode(last, number)
    x, z = worlds.modes.paths[last - 1, mode or 0, last]
    if abs(x) > abs(z):
        return "right" if x > 0 else "left"
    return "ahead" if z > 0 else "back"


def _row(row: SubFigure, worlds: Worlds, frames: Sequence[int], number: int, look: _Look) -> None:
    """A world's maps, and under them its camera."""
    axes = row.subplots(
        2, len(frames), sharex="row", sharey="row", squeeze=False, height_ratios=[2.6, 1]
    )
    for above, below, frame in zip(*axes, frames, strict=True):
        above.plot(*worlds.points.T, "+", color="black", ms=7, mew=1.1, zorder=4)
        below.plot(*worlds.truth[: frame + 1].T, color="black", lw=1.4, zorder=5)
        if look.filtered:
            way = np.concatenate([worlds.truth[:1], worlds.filtered[:frame]])
            below.plot(*way.T, color=_FILTER, lw=2, zorder=4)
            below.plot(*way[-1], "s", color=_FILTER, ms=5, zorder=4)
        mode = worlds.mode(frame, number)
        if mode is None:
            _dead(above, below, worlds, number, look)
        else:
            weight = worlds.shares()[frame - 1, number]
            _map(above, worlds, frame, mode, look.colour, _strength(weight))
            _camera(below, worlds.modes.paths[frame - 1, mode, : frame + 1], weight, look.colour)
    _view(axes, worlds, frames[-1])
    row.supylabel(f"the camera goes {look.way}", color=look.colour, fontweight="bold", fontsize=13)


def _strength(weight: float) -> float:
    return 0.35 + 0.65 * weight


def _map(axes: Axes, worlds: Worlds, frame: int, mode: int, colour: str, strength: float) -> None:
    """The landmarks: a dot, and the outline of one σ, which is thin along the ray."""
    of, at = worlds.modes, (frame - 1, mode)
    camera = of.paths[at][frame]
    for mean, covariance in zip(of.landmarks[at], of.covariances[at], strict=True):
        outline = camera[:, None] + region_from_above(mean, covariance, _SHARE)
        axes.plot(*outline, color=colour, lw=3, alpha=0.6 * strength, solid_capstyle="round")
        middle = camera + np.array([np.sin(mean[0]), np.cos(mean[0])]) / mean[1]
        axes.plot(*middle, "o", color=colour, ms=5.5, alpha=strength, mec="white", mew=0.6)


def _camera(axes: Axes, way: Float[np.ndarray, "k 2"], weight: float, colour: str) -> None:
    strength = _strength(weight)
    axes.plot(*way.T, color=colour, lw=4, alpha=strength, zorder=3)
    axes.plot(*way[-1], "o", color=colour, ms=8, alpha=strength, zorder=3)
    axes.text(
        0.96, 0.06, f"{weight:.0%}", transform=axes.transAxes, ha="right", va="bottom",
        fontsize=14, fontweight="bold", color=colour,
    )  # fmt: skip


def _dead(above: Axes, below: Axes, worlds: Worlds, number: int, look: _Look) -> None:
    alive = np.flatnonzero(worlds.shares()[:, number] > LEAST) + 1
    for axes in (above, below):
        axes.set_facecolor(_DEAD)
    said = f"dead since frame {alive[-1] + 1}"
    if look.filtered:
        said += f";\n{worlds.filter_name} is still here"
    above.text(0.5, 0.72, said, transform=above.transAxes, ha="center", va="center", fontsize=10)


def _view(axes: np.ndarray, worlds: Worlds, last: int) -> None:
    low, high = worlds.points.min(axis=0), worlds.points.max(axis=0)
    side = 1.35 * np.abs(worlds.points[:, 0]).max()
    axes[0, 0].set_xlim(-side, side)
    axes[0, 0].set_ylim(0.75 * low[1], 1.08 * high[1])
    alive = worlds.modes.paths[:last][worlds.modes.weights[:last] > LEAST].reshape(-1, 2)
    ways = np.concatenate([worlds.truth[: last + 1], worlds.filtered[:last], alive])
    reach = 1.12 * np.abs(ways[:, 0]).max()
    axes[1, 0].set_xlim(-reach, reach)
    axes[1, 0].set_ylim(min(-0.6 * reach, 1.2 * ways[:, 1].min()), 1.2 * ways[:, 1].max() + 0.1)
    for each in axes.flat:
        each.tick_params(labelsize=9)
        each.grid(alpha=0.2)
    axes[0, 0].set_ylabel("landmarks: z, m")
    axes[1, 0].set_ylabel("camera: z, m")
    for each in axes[1]:
        each.set_xlabel("x, m", labelpad=1)
        each.yaxis.set_major_locator(MaxNLocator(2))


def _weights(axes: Axes, worlds: Worlds, frames: Sequence[int], looks: dict[int, _Look]) -> None:
    """The weights of all worlds over the frames, one on the other; white at some frames."""
    shares = worlds.shares()
    steps, bottom = np.arange(1, len(shares) + 1), np.zeros(len(shares))
    for number, look in looks.items():
        share = shares[:, number]
        axes.fill_between(steps, bottom, bottom + share, color=look.colour, alpha=0.9, lw=0)
        middle = int(np.sum(share * steps) / np.sum(share)) - 1
        axes.text(
            steps[middle], (bottom + share / 2)[middle], f"goes {look.way}", color="white",
            ha="center", va="center", fontsize=12, fontweight="bold",
        )  # fmt: skip
        bottom = bottom + share
    axes.fill_between(steps, bottom, 1, color=_OTHERS, lw=0)
    for frame in frames:
        axes.axvline(frame, color="white", lw=1.2)
    axes.set(xlim=(1, steps[-1]), ylim=(0, 1), xticks=frames, yticks=[0, 0.5, 1])
    axes.set(xlabel="frame", ylabel="weight")


def _legend(row: SubFigure, worlds: Worlds) -> None:
    handles = [
        Line2D([], [], color="black", marker="+", ms=8, label="truth"),
        Line2D([], [], color=GREY, marker="o", lw=3, label="a mode: mean, 1σ given the scale"),
        Line2D([], [], color=_FILTER, marker="s", lw=2, label=worlds.filter_name),
    ]
    row.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
