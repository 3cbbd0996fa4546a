"""Track a whole video and write its files, from the trajectory to the overlay."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from jaxslam._runtime.files import write_json, write_text
from jaxslam.evaluation import write_covariances
from jaxslam.filters.protocol import AbstractStaged
from jaxslam.io.source import Frame, Source
from jaxslam.plots.tracking import plot_map
from jaxslam.tracking.film import Aside, OverlayWriter
from jaxslam.tracking.first_pass import finds_lens, with_lens_found
from jaxslam.tracking.inertial import Inertial
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.moving_start import begun
from jaxslam.tracking.overlay import overlay_of, overlay_size
from jaxslam.tracking.pointcloud import write_ply
from jaxslam.tracking.report import TEXTS, Tracked, add_latest
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.summary import (
    Summary,
    caveat_of,
    known_points,
    reference_in_map,
    summarised,
    trajectory_of,
)
from jaxslam.tracking.target import Target
from jaxslam.tracking.tracker import Tracker
from jaxslam.tracking.trajectory import TRACKED, absolute_trajectory_error
from jaxslam.tracking.viewer import Viewer

_GIVEN_SCALE = (
    "in the unit of each map; the unit itself is uncertain by sigma_log_scale (frames.csv) and "
    "approximate where unit_fixed is 0"
)
_KNOWN_SCALE = "in the unit of each map, which the filter takes as exactly known"


def track(
    source: Source,
    out: str | Path,
    settings: TrackerSettings | None = None,
    *,
    slam: AbstractStaged | None = None,
    target: Target | None = None,
    known: str | Path | None = None,
    inertial: Inertial | None = None,
    overlay: bool = True,
    viewer: str | Path | None = None,
    progress: Callable[[int], None] = lambda frames: None,
) -> Summary:
    """Track `source`, write `trajectory.txt`, `covariance.txt`, `frames.csv`, `summary.json`,
    `map.ply`, `map.npz`, `map.png` and, if wanted, `overlay.mp4` into the folder `out`, and
    return the summary.

    `trajectory.txt` and `frames.csv` grow with every frame from the second on, so that whatever
    ends the process leaves them of the frames so far. An interruption (KeyboardInterrupt), an
    unreadable frame (ValueError) or a smoothing that fails leaves all files for these, and is
    raised again; an interruption of the first frame or the second leaves none. `slam` is a filter
    of your own, in place of the one that the settings name. `target`, known points that the first
    frame sees, makes the map metric. `known` is the `map.npz` of another video by the same camera:
    this one goes on with that map where it is known again, by its settings. `inertial`, the
    readings of an inertial unit, make all lengths metres; where it moves in the beginning, the
    first 1.5 s are used for its start alone. Where the calibration is guessed, the first frames of
    a recording are tracked twice, once to find the lens. `viewer` is a file for the rerun viewer,
    FILE.rrd, written beside the others.
    """
    out, begins = Path(out), time.perf_counter()
    recording = None if viewer is None else Viewer(viewer, source.calibration)
    if known is None:
        settings = settings or TrackerSettings()
        if inertial is not None:
            source, inertial = begun(source, inertial, settings)
        elif slam is None and finds_lens(source, settings):
            source = with_lens_found(source, settings, out)
        tracker = Tracker(source.calibration, settings, slam, target, inertial)
    else:
        tracker = Tracker.localising(known, source.calibration, slam)
    if source.clock is not None:
        tracker.compile()
    out.mkdir(parents=True, exist_ok=True)
    history: list[Tracked] = []
    seconds: list[float] = []
    try:
        film = out / "overlay.mp4" if overlay else None
        with _shown(source, tracker, film, recording, history) as show:
            start = begins
            for frame in source:
                history.append(tracker.track(frame))
                add_latest(out, history)
                show(frame)
                now = time.perf_counter()
                seconds.append(now - start)
                start = now
                progress(1)
        smooth = tracker.smoothed(history)
    except BaseException as error:
        # After the first frame there is nothing to tell yet, and what tells it may be compiling.
        if len(history) > isinstance(error, KeyboardInterrupt):
            _write(source, tracker, history, (history, tracker.points()), seconds, out)
            if isinstance(error, KeyboardInterrupt):
                told = f"{out} has the files of the {len(history)} frames so far"
                raise KeyboardInterrupt(told) from None
        raise
    return _write(source, tracker, history, smooth, seconds, out)


@contextmanager
def _shown(
    source: Source,
    tracker: Tracker,
    film: Path | None,
    viewer: Viewer | None,
    history: list[Tracked],
) -> Generator[Callable[[Frame], None]]:
    """Return what shows the newest frame, as film and in the viewer, aside from the tracking."""
    with ExitStack() as stack:
        writer = None if film is None else stack.enter_context(_writer(source, film))
        recording = None if viewer is None else stack.enter_context(viewer)
        aside = stack.enter_context(Aside())

        def show(frame: Frame) -> None:
            if writer is not None:
                aside.give(lambda *drawn: writer.write(overlay_of(*drawn)), frame, history[-1])
            if recording is not None:
                aside.give(recording.show, frame, history[-1])
                # Frames from one map of a recording to the next.
                if len(history) % 10 == 0:
                    aside.give(recording.show_map, known_points(tracker.points(), history))

        try:
            yield show
        finally:
            if recording is not None and history:
                aside.give(recording.show_map, known_points(tracker.points(), history))


def _writer(source: Source, path: Path) -> OverlayWriter:
    times, calibration = source.times, source.calibration
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 30.0
    return OverlayWriter(path, overlay_size(calibration.width, calibration.height), rate)


def _write(
    source: Source,
    tracker: Tracker,
    before: list[Tracked],
    now: tuple[list[Tracked], Points],
    seconds: list[float],
    out: Path,
) -> Summary:
    """Write all files, of frames and landmarks as they are known now, and as they were `before`."""
    history, points = now
    for name, text in TEXTS.items():
        write_text(out / name, text(history))
    tracker.save(out / "map.npz")
    scaled = any(result.sigma_log_scale is not None for result in history)
    remark = _GIVEN_SCALE if scaled else _KNOWN_SCALE
    treatment, *_ = tracker.camera() or [""]
    write_covariances(
        out / "covariance.txt",
        [result.time for result in history],
        [result.covariance for result in history],
        replace(TRACKED, scale="given" if scaled else "marginal"),
        length=tracker.unit,
        remark="; ".join(filter(None, [remark, caveat_of(treatment, tracker.calibration)])),
    )
    summary = summarised(source, tracker, history, points, seconds)
    if "ate" in summary:
        assert source.reference is not None
        with suppress(ValueError):
            error = absolute_trajectory_error(*trajectory_of(before), *source.reference)
            summary["ate_causal"] = error
    write_json(out / "summary.json", summary, allow_nan=False)
    known = known_points(points, history)
    write_ply(out / "map.ply", known.points, known.covariances, known.numbers, known.maps)
    ends = {r.submap: r.T_wc[:3, 3] for r in history}
    loops = [(r.T_wc[:3, 3], ends[r.loop]) for r in history if r.loop in ends]
    begun = [place for place, result in enumerate(history) if result.starts and result.map]
    plot_map(
        trajectory_of(history).T_wc,
        known.points,
        known.in_map,
        reference=reference_in_map(source, history),
        path=out / "map.png",
        unit="m" if tracker.unit == "m" else "map units",
        lost=[result.lost for result in history],
        begun=begun,
        begun_covariances=[history[place].camera.position_covariance for place in begun],
        loops=loops,
        before=trajectory_of(before).T_wc[: len(before) if loops else 0],
    )
    return summary
