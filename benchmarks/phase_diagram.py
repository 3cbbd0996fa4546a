"""Where does a filter hold? Its NEES over noise, prior, motion and depth: hundreds of worlds.

`python benchmarks/phase_diagram.py` goes through a grid of worlds of the `matched` family and
writes `benchmarks/results/phase-diagram.csv`, one row for each world and filter, and from it
`docs/phase-diagram.md` with its figures. The file is whole after every world: the same command
again skips what is there, and another filter or another value of an axis adds its rows.

The direction `from-rest` has no nominal motion, and an axis of its own: how little is known of the
initial velocity. Filters with a window (`+rest`) cost seconds a run and take fewer runs.
"""

from __future__ import annotations

import csv
import itertools
import os
import statistics
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro

import jaxslam
from jaxslam._runtime.files import write_atomically
from jaxslam._runtime.lookup import lookup
from jaxslam.consistency import CHUNK
from jaxslam.plots.phase import PhaseCell, plot_phase_diagram
from jaxslam.statistics.bands import mean_band
from jaxslam.statistics.verdict import LOST_BOUND, together, verdict

ACCELERATION = (0.5, 0.5, 0.3)
"""σ of the white acceleration at scale 1, m/s² and rad/s²: that of `matched-loose`."""
VELOCITY = (0.1, 0.1, 0.05)
"""σ of the initial velocity at scale 1, m/s and rad/s."""
DIRECTIONS = {
    "sideways": (1.2, 0.0, 0.0),
    "forward": (0.0, 1.2, 0.0),
    "turn": (0.0, 1.2, 0.3),
    "sideways-turn": (1.2, 0.0, 0.3),
    "from-rest": (0.0, 0.0, 0.0),
}
"""Nominal velocity (x, z, θ), m/s and rad/s; `turn` is forward and turning."""
REST = "from-rest"
MOVING = tuple(name for name in DIRECTIONS if name != REST)

Row = dict[str, Any]
KEY = {
    "direction": str,
    "nearest_depth_m": float,
    "acceleration_sigma_m_s2": float,
    "velocity_sigma_m_s": float,
    "filter": str,
    "landmarks": str,
}
"""Columns that name a row, in the order of the file."""
SETTINGS = {"runs": int, "seed": int, "steps": int}
"""Columns that all rows of a file share; `runs` those of the filters without a window."""
COLUMNS = {
    **KEY,
    "velocity_x_m_s": float,
    "velocity_z_m_s": float,
    "turn_rate_rad_s": float,
    "turn_acceleration_sigma_rad_s2": float,
    "turn_rate_sigma_rad_s": float,
    **SETTINGS,
    "dof": int,
    "nees": float,
    "nees_median": float,
    "nees_not_lost": float,
    "band_low": float,
    "band_high": float,
    "inside": float,
    "lost": float,
    "diverged": int,
    "rmse_m": float,
    "sigma_m": float,
    "sigma_over_rmse": float,
    "seconds": float,
}
"""All columns; a number that does not exist is an empty field."""


@dataclass(frozen=True)
class Options:
    """The grid, and how much of it."""

    accelerations: tuple[float, ...] = (0.04, 0.2, 1.0, 2.0, 6.0)
    """σ of the acceleration, as multiples of (0.5, 0.5 m/s², 0.3 rad/s²)."""
    velocities: tuple[float, ...] = (0.02, 0.1, 0.5, 1.0)
    """σ of the initial velocity, as multiples of (0.1, 0.1 m/s, 0.05 rad/s)."""
    rest_velocities: tuple[float, ...] = (0.5, 1.5, 5.0, 15.0)
    """The same from rest."""
    depths: tuple[float, ...] = (1.5, 3.0, 6.0)
    """d_min, m: the prior on 1/z is N(1/(2 d_min), (1/(4 d_min))²)."""
    directions: tuple[str, ...] = MOVING
    """Nominal motions; `from-rest` beside."""
    filters: tuple[str, ...] = ("robocentric", "world")
    landmarks: tuple[str, ...] = ("inverse_scaling", "inverse_depth")
    runs: int = 1000
    """Runs of every filter in every world."""
    window_runs: int = 40
    """Runs of a filter with a window, one by one: in a batch the longest window is waited for."""
    seed: int = 0
    """The same draws in every world: neighbours differ by their numbers and not by their luck."""
    steps: int = 60
    lost_bound: float = LOST_BOUND
    """A cell with a larger share of lost runs is lost."""
    out: Path = Path("benchmarks/results/phase-diagram.csv")
    """The file to write, and to go on with."""
    docs: Path = Path("docs")
    """Folder of phase-diagram.md and its figures."""


def worlds(options: Options) -> Iterator[tuple[str, jaxslam.Scenario]]:
    """`(direction, scenario)` of the grid. All have one shape: filters compile once.

    Raises ValueError for an axis without values and for values that make no sense.
    """
    for name in ("accelerations", "velocities", "rest_velocities", "depths"):
        if not getattr(options, name):
            raise ValueError(f"{name} holds no value: an axis needs at least one")
    for name, velocity in lookup("directions", options.directions, DIRECTIONS).items():
        velocities = options.rest_velocities if name == REST else options.velocities
        for depth, a, v in itertools.product(options.depths, options.accelerations, velocities):
            yield (
                name,
                jaxslam.scenario(
                    "matched",
                    steps=options.steps,
                    velocity=velocity,
                    nearest_depth=depth,
                    acceleration_sigma=_scaled(a, ACCELERATION),
                    velocity_sigma=_scaled(v, VELOCITY),
                ),
            )


def _scaled(scale: float, sigmas: tuple[float, ...]) -> list[float]:
    """Without the last digits of a product: these numbers name rows."""
    return [float(f"{scale * sigma:.9g}") for sigma in sigmas]


def measure(options: Options, rows: list[Row]) -> Iterator[list[Row]]:
    """All rows so far, yielded after every world that was not complete."""
    done = {_key(row) for row in rows}
    grid = list(worlds(options))
    for number, (direction, scenario) in enumerate(grid, 1):
        missing = {
            name: slam
            for name, slam in _filters_of(scenario, options).items()
            if _key(_named(direction, scenario, name)) not in done
        }
        if not missing:
            continue
        start = time.perf_counter()
        new = _measure(direction, scenario, missing, options)
        rows = sorted([*rows, *new], key=_key)
        done |= {_key(row) for row in new}
        seconds = time.perf_counter() - start
        print(f"world {number} of {len(grid)}: {len(new)} rows, {seconds:.1f} s", flush=True)
        yield rows


def _filters_of(scenario, options: Options):
    return jaxslam.make_filters(scenario, options.filters, options.landmarks)


def _runs(filter_name: str, options: Options) -> int:
    return options.window_runs if _has_window(filter_name) else options.runs


def _has_window(filter_name: str) -> bool:
    return "+rest" in filter_name


def _measure(direction: str, scenario, filters, options: Options) -> list[Row]:
    """A row of every filter."""
    return [_row(direction, scenario, name, slam, options) for name, slam in filters.items()]


def _row(direction: str, scenario, name: str, slam, options: Options) -> Row:
    runs, chunk = _runs(name, options), 1 if _has_window(name) else CHUNK
    study = jaxslam.monte_carlo(scenario, {name: slam}, runs=runs, seed=options.seed, chunk=chunk)
    return {
        **_named(direction, scenario, name),
        "velocity_x_m_s": scenario.velocity[0],
        "velocity_z_m_s": scenario.velocity[1],
        "turn_rate_rad_s": scenario.velocity[2],
        "turn_acceleration_sigma_rad_s2": scenario.acceleration_sigma[2],
        "turn_rate_sigma_rad_s": scenario.velocity_sigma[2],
        "runs": runs,
        "seed": options.seed,
        "steps": options.steps,
        **_numbers(jaxslam.summarise(study)["filters"][name]),
    }


def _named(direction: str, scenario, name: str) -> Row:
    """The columns that name a row."""
    frame, landmarks = name.split("/")
    return {
        "direction": direction,
        "nearest_depth_m": scenario.nearest_depth,
        "acceleration_sigma_m_s2": scenario.acceleration_sigma[0],
        "velocity_sigma_m_s": scenario.velocity_sigma[0],
        "filter": frame,
        "landmarks": landmarks,
    }


def _numbers(f: dict[str, Any]) -> Row:
    """Those of the last step."""
    rmse, sigma = f["rmse"]["position"][-1], f["sigma"]["position"][-1]
    return {
        "dof": f["dof"],
        "nees": f["nees"][-1],
        "nees_median": f["nees_median"][-1],
        "nees_not_lost": f["nees_not_lost"][-1],
        "band_low": f["band95"][0],
        "band_high": f["band95"][1],
        "inside": f["inside"],
        "lost": f["lost"][-1],
        "diverged": f["diverged"],
        "rmse_m": rmse,
        "sigma_m": sigma,
        "sigma_over_rmse": sigma / rmse if rmse and sigma else None,
        "seconds": round(f["seconds"]["run"], 3),
    }


def _key(row: Row) -> tuple:
    return tuple(row[name] for name in KEY)


# --- the file -----------------------------------------------------------------------------------


def read(path: Path) -> list[Row]:
    """The rows of a file; none where there is no file. Raises ValueError for another's."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != list(COLUMNS):
            raise ValueError(
                f"{path} has other columns than a phase diagram: give another --out; "
                f"expected {', '.join(COLUMNS)}"
            )
        return [_parsed(path, reader.line_num, row) for row in reader]


def _parsed(path: Path, line: int, row: dict[str, str]) -> Row:
    try:
        return {name: kind(row[name]) if row[name] else None for name, kind in COLUMNS.items()}
    except (ValueError, TypeError):
        raise ValueError(f"{path}, line {line} is not a row of a phase diagram: {row}") from None


def write(rows: Iterable[Row], path: Path) -> None:
    """All rows, or the file as it was."""
    with write_atomically(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def check_same(rows: list[Row], options: Options) -> None:
    """Raise ValueError unless rows made with these options may join the file."""
    for row in rows:
        now = {name: getattr(options, name) for name in SETTINGS}
        now["runs"] = _runs(row["filter"], options)
        for name, value in now.items():
            if row[name] != value:
                raise ValueError(
                    f"cannot go on with {options.out}: it was made with {name} {row[name]}, "
                    f"now {value}; give another --out"
                )


# --- what it says -------------------------------------------------------------------------------


def judged(rows: list[Row], lost_bound: float) -> list[Row]:
    """The rows with a `verdict` by the 95 % band, and one by the band of all rows `together`."""

    def verdicts(row):
        numbers = {name: row[name] for name in ("dof", "runs", "diverged")}
        judge = partial(verdict, row["nees"], row["lost"], **numbers)
        return {
            "verdict": judge(lost_bound=lost_bound),
            "together": judge(lost_bound=lost_bound, comparisons=len(rows)),
        }

    return [{**row, **verdicts(row)} for row in rows]


def page(rows: list[Row], options: Options) -> str:
    """The Markdown page, from judged rows."""
    moving, resting = _apart(rows)
    parts = [
        "# Phase diagram: where a filter holds",
        *(_of_moving(moving, options) if moving else []),
        *(_of_rest(resting, options) if resting else []),
    ]
    return "\n\n".join(parts) + "\n"


def _apart(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """Those with a nominal motion, and those from rest."""
    resting = [row for row in rows if row["direction"] == REST]
    return [row for row in rows if row["direction"] != REST], resting


def _of_moving(rows: list[Row], options: Options) -> list[str]:
    low, high = mean_band(rows[0]["dof"], options.runs)
    wide = mean_band(rows[0]["dof"], options.runs, together(len(rows)))
    csv_file = Path(os.path.relpath(options.out, options.docs)).as_posix()
    seconds = statistics.median(row["seconds"] for row in rows)
    names = _filters(rows)
    return [
        f"Made by `python benchmarks/phase_diagram.py --runs {options.runs}` from "
        f"[{options.out.name}]({csv_file}); do not edit. "
        f"{len(rows)} cells, {options.runs} runs each, {options.steps} steps, seed "
        f"{options.seed}: planar worlds of 12 landmarks with truth drawn from the filter's own "
        "prior, the calibration known. The pose has 3 degrees of freedom: a consistent filter "
        f"has a mean NEES of 3, at the last step inside {low:.2f}–{high:.2f} with 95 %. A cell "
        f"took {seconds:.2g} s (median, compilation apart) on a machine that others used too.",
        f"**Many comparisons.** Of {len(rows)} consistent cells {0.05 * len(rows):.0f} would be "
        "outside the 95 % band by chance, so one such cell says little. Bonferroni's band, "
        f"{wide[0]:.2f}–{wide[1]:.2f}, holds *all* of them together with 95 %, however they are "
        "correlated; outside it a cell is inconsistent beyond doubt. Inside it a small "
        "inconsistency may hide. All worlds use the same draws, so that chance moves "
        "neighbours together. A cell is *lost* when more than "
        f"{options.lost_bound:.0%} of its runs are (NEES above the 99.99 % quantile of χ²).",
        *_partial(rows, names),
        "![Mean NEES of every filter by direction](phase-diagram.png)",
        "## Cells by verdict",
        _shares(rows, names),
        "## How much it bears",
        "The largest σ of the acceleration, m/s², up to which every cell of the grid, at every "
        "d_min, is inside the band of all cells together and not lost; – where not even the "
        "smallest is:",
        _frontier(rows, names, "acceleration_sigma_m_s2", "velocity_sigma_m_s", "σ_v = {:g} m/s"),
        "The largest σ of the initial velocity, m/s, likewise:",
        _frontier(rows, names, "velocity_sigma_m_s", "acceleration_sigma_m_s2", "σ_a = {:g} m/s²"),
        "## All cells",
        *(f"![{'/'.join(name)}]({_figure_name(name)})" for name in names),
    ]


def _of_rest(rows: list[Row], options: Options) -> list[str]:
    depths = ", ".join(f"{d:g}" for d in sorted({row["nearest_depth_m"] for row in rows}))
    filters, landmarks = (
        " ".join(dict.fromkeys(row[name] for row in rows)) for name in ("filter", "landmarks")
    )
    return [
        "## From rest",
        f"`--directions {REST} --filters {filters} --landmarks {landmarks} "
        f"--window-runs {options.window_runs}` adds worlds in which the camera's mean velocity is "
        f"zero, and only σ of the initial velocity is told, up to a walker's; d_min {depths} m. "
        "One Gaussian cannot say that a camera goes left or right ([from-rest.md](from-rest.md)).",
        *(_how_many(name, rows) for name in _filters(rows)),
        "![Mean NEES from rest](phase-diagram-from-rest.png)",
        _shares(rows, _filters(rows)),
    ]


def _how_many(name: tuple[str, str], rows: list[Row]) -> str:
    """The runs of a filter's cells, and what band that makes."""
    row = _select(rows, name, REST)[0]
    low, high = mean_band(row["dof"], row["runs"])
    return (
        f"`{'/'.join(name)}`: {row['runs']} runs a cell, 95 % band {low:.2f}–{high:.2f}; "
        f"one lost run is {1 / row['runs']:.1%}."
    )


def _filters(rows: list[Row]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((r["filter"], r["landmarks"]) for r in rows))


def _partial(rows: list[Row], names: list[tuple[str, str]]) -> list[str]:
    """A sentence for every filter that was measured at some of the depths only."""
    depths = {row["nearest_depth_m"] for row in rows}
    own = {
        name: {r["nearest_depth_m"] for r in rows if (r["filter"], r["landmarks"]) == name}
        for name in names
    }
    return [
        f"`{'/'.join(name)}` is measured at d_min {', '.join(f'{d:g}' for d in sorted(found))} m "
        "only: below, its cells are fewer, and its shares and limits are of these alone."
        for name, found in own.items()
        if found != depths
    ]


def _directions(rows: list[Row]) -> list[str]:
    """In the order of the table of directions."""
    found = {row["direction"] for row in rows}
    return [name for name in DIRECTIONS if name in found]


def _shares(rows: list[Row], names: list[tuple[str, str]]) -> str:
    lines = [
        "| filter | direction | cells | in the 95 % band | in the band of all | under-confident | "
        "over-confident | lost |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, direction in itertools.product(names, _directions(rows)):
        cells = _select(rows, name, direction)
        counts = [
            sum(row["verdict"] == "consistent" for row in cells),
            *(
                sum(row["together"] == v for row in cells)
                for v in ("consistent", "under-confident", "over-confident", "lost")
            ),
        ]
        if cells:
            shares = " | ".join(f"{count / len(cells):.0%}" for count in counts)
            lines.append(f"| {'/'.join(name)} | {direction} | {len(cells)} | {shares} |")
    return "\n".join(lines)


def _frontier(rows: list[Row], names: list[tuple[str, str]], axis: str, by: str, label: str) -> str:
    """How far every filter goes along an axis, a column for each value of another."""
    values = sorted({row[by] for row in rows})
    header = " | ".join(label.format(value) for value in values)
    lines = [f"| filter | direction | {header} |", "|---|---|" + "---|" * len(values)]
    for name, direction in itertools.product(names, _directions(rows)):
        cells = _select(rows, name, direction)
        borne = [_borne([row for row in cells if row[by] == value], axis) for value in values]
        if cells:
            lines.append(f"| {'/'.join(name)} | {direction} | {' | '.join(borne)} |")
    return "\n".join(lines)


def _borne(cells: list[Row], axis: str) -> str:
    """The largest value of the axis up to which all cells are consistent."""
    best = "–"
    for value in sorted({row[axis] for row in cells}):
        here = [row for row in cells if row[axis] == value]
        if any(row["together"] != "consistent" for row in here):
            break
        best = f"{value:g}"
    return best


def _select(rows: list[Row], name: tuple[str, str], direction: str) -> list[Row]:
    return [
        r for r in rows if (r["filter"], r["landmarks"]) == name and r["direction"] == direction
    ]


def draw(rows: list[Row], options: Options) -> None:
    """One figure of all filters at the middle depth, one of every filter at all depths, and one of
    the worlds from rest."""
    rows, resting = _apart(rows)
    if resting:
        _draw_rest(resting, options)
    if not rows:
        return
    rows = sorted(rows, key=lambda row: list(DIRECTIONS).index(row["direction"]))
    depths = sorted({row["nearest_depth_m"] for row in rows})
    middle = depths[len(depths) // 2]
    cells = [_cell(row, _label(row)) for row in rows if row["nearest_depth_m"] == middle]
    runs = f"{options.runs} runs a cell"
    _draw(
        cells, f"mean pose NEES (ideal 3), d_min {middle:g} m, {runs}", options, "phase-diagram.png"
    )
    for name in _filters(rows):
        own = [row for row in rows if (row["filter"], row["landmarks"]) == name]
        cells = [_cell(row, _depth(row)) for row in own]
        title = f"{'/'.join(name)}: mean pose NEES (ideal 3), {runs}"
        _draw(cells, title, options, _figure_name(name))


def _draw_rest(rows: list[Row], options: Options) -> None:
    """A column for each filter."""
    cells = [
        replace(
            _cell(row, _depth(row)),
            column=f"{_label(row)}\n{row['runs']} runs a cell",
        )
        for row in sorted(rows, key=lambda row: _has_window(row["filter"]))
    ]
    title = "from rest: mean pose NEES (ideal 3)"
    _draw(cells, title, options, "phase-diagram-from-rest.png")


def _draw(cells: list[PhaseCell], title: str, options: Options, name: str) -> None:
    plot_phase_diagram(
        cells,
        x_label="σ of the acceleration, m/s² (of turning: × 0.6 rad/s²)",
        y_label="σ of the initial velocity, m/s",
        title=title,
        path=options.docs / name,
    )


def _figure_name(name: tuple[str, str]) -> str:
    return f"phase-diagram-{'-'.join(name)}.png"


def _depth(row: Row) -> str:
    return f"nearest depth\nd_min {row['nearest_depth_m']:g} m"


WORDS = {
    "robocentric": "robocentric",
    "world": "in the world",
    "scale_gauge": "scale kept apart",
    "scene": "depths share a scene",
    "mixture": "{} Gaussians",
    "rest": "windows from rest",
    "inverse_scaling": "Inverse Scaling",
    "inverse_depth": "Unified Inverse Depth",
}
"""What filters, their modifiers and landmarks are, in words; of others the name."""


def _label(row: Row) -> str:
    """Landmarks and filter in words, in lines that are short enough for the side of a panel."""
    return ",\n".join(_word(name) for name in [row["landmarks"], *row["filter"].split("+")])


def _word(name: str) -> str:
    kind = name.rstrip("0123456789")
    return WORDS.get(kind, name).format(name.removeprefix(kind))


def _cell(row: Row, panel: str) -> PhaseCell:
    return PhaseCell(
        row=panel,
        column=row["direction"],
        x=row["acceleration_sigma_m_s2"],
        y=row["velocity_sigma_m_s"],
        verdict=row["verdict"],
        certain=row["verdict"] == row["together"],
        lost=row["lost"],
        text=f"{row['lost']:.0%}" if row["verdict"] == "lost" else _short(row["nees"]),
    )


def _short(nees: float) -> str:
    if nees >= 1000:
        return f"{nees:.0e}".replace("e+0", "e")
    return f"{nees:.2f}" if nees < 10 else f"{nees:.0f}"


def main(options: Options) -> None:
    """Go on with the file, then draw it and write its page."""
    for folder in (options.out.parent, options.docs):
        folder.mkdir(parents=True, exist_ok=True)
    found = read(options.out)
    check_same(found, options)
    for rows in measure(options, found):
        write(rows, options.out)
    report(options)


def report(options: Options) -> None:
    """Draw the file and write its page."""
    found = _apart(read(options.out))
    rows = [row for part in found for row in judged(part, options.lost_bound)]
    draw(rows, options)
    with write_atomically(options.docs / "phase-diagram.md") as path:
        path.write_text(page(rows, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
