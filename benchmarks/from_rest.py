"""From rest: how many runs of a filter are lost, and how true the others are, frame by frame.

    python benchmarks/from_rest.py --filters scale_gauge+mixture3+rest --scenarios standstill-6dof
    python benchmarks/from_rest.py --figure

The camera sets out with a velocity that nobody told the filter. Results are added to
`from_rest.json`; what it already has, of as many runs, is not measured again. The tables of
`docs/from-rest.md` and the sentences on them are written from it, by `--page` alone from what is
there. `--figure` draws one run beside it, whose modes live long.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchmark import RESULTS, OfRuns, table
from modes import modes_of_run, plot_modes, worlds_of

import jaxslam
from jaxslam.consistency import draw, filter_run
from jaxslam.statistics.verdict import headline

STEPS = (1, 3, 10, 60)
"""Frames of the table."""
TOLD = {"seed": 0, "run": 35, "steps": 40}
"""The run of the figure: of the first sixty, one in which an EKF is in the world that dies."""
SUM, EKF = "scale_gauge+mixture5+rest", "robocentric"
"""Its filters."""
BEGIN = "<!-- from_rest.py -->"
"""Behind this the tables are written …"""
SAID = "<!-- from_rest.py, in words -->"
"""… and behind this what they say."""
KEYS = (
    "dof", "band95", "nees", "nees_not_lost", "lost", "lost_ever", "rmse", "sigma", "reversed",
    "verdict", "beyond_scale", "scale_drift",
)  # fmt: skip
SETTLED = 10
"""The frame from which on the sentences speak."""


@dataclass(frozen=True, kw_only=True)
class FromRest(OfRuns):
    """Filters that are not told how the camera sets out."""

    scenarios: tuple[str, ...] = ("standstill", "standstill-6dof")
    filters: tuple[str, ...] = ("robocentric", "scale_gauge+mixture9")
    seed: int = 101
    """One that nothing was chosen by."""
    chunk: int = 1
    """Runs in one batch. Windows of different lengths wait for one another in a batch."""
    figure: bool = False
    """Only draw the figure."""
    out: Path = RESULTS / "from_rest.json"

    def measure(self) -> Iterator[dict[str, Any]]:
        if self.figure:
            draw_figure(self)
            return
        yield from self.each(self._measured, self.scenarios, self.filters)

    def _measured(self, scenario: str, name: str) -> dict[str, Any]:
        _, found = self.study(jaxslam.scenario(scenario), name)
        return {
            **{key: found[key] for key in KEYS},
            "milliseconds_per_run": 1e3 * found["seconds"]["run"] / self.runs,
            "compile": found["seconds"]["compile"],
        }

    def tables(self, results: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        yield "from-rest.md", BEGIN, as_table(results)
        yield "from-rest.md", SAID, sentences(results)


def as_table(results: dict[str, dict[str, Any]]) -> str:
    """The numbers of all filters, one table a scenario."""
    parts = []
    for scenario, filters in results.items():
        dof = next(iter(filters.values()))["dof"]
        frames = ", ".join(map(str, STEPS))
        parts.append(f"`{scenario}`, ideal NEES {dof}. Three columns are at frames {frames}:")
        header = ["filter", "runs; 95 % band", "lost, %", "mean NEES", "NEES without lost"]
        header += ["ever lost", "RMSE; σ, m", "s a run"]
        parts.append(table(header, (_row(*item) for item in filters.items())))
    return "\n\n".join(parts)


def sentences(results: dict[str, dict[str, Any]]) -> str:
    """What the numbers of every filter that finds out its start say, in words: a list."""
    return "\n".join(
        f"- `{scenario}`, `{name}`: {_said(found)}"
        for scenario, filters in results.items()
        for name, found in filters.items()
        if "+rest" in name
    )


def _said(found: dict[str, Any]) -> str:
    runs, (low, high) = found["runs"], found["band95"]
    counts = {key: [round(runs * (x or 0)) for x in found[key]] for key in ("lost", "reversed")}
    frames = range(SETTLED, len(found["nees"]) + 1)
    lost, reversed_ = (max(counts[key][k - 1] for k in frames) for key in ("lost", "reversed"))
    above = sum(not (found["nees"][k - 1] or np.inf) <= high for k in frames)
    below = sum((found["nees"][k - 1] or np.inf) < low for k in frames)
    return (
        f"of {runs} runs (seed {found['seed']}) {_at_most(lost)} lost and {_at_most(reversed_)} "
        f"reversed at any of frames {SETTLED} to {frames[-1]}. The mean NEES of all runs (ideal "
        f"{found['dof']}) is above its band at {above} of these {len(frames)} frames and below it "
        f"at {below}. {_words(found)}"
    )


def _at_most(count: int) -> str:
    """So many runs, and their verb."""
    return "none is" if count == 0 else f"at most {count} {'is' if count == 1 else 'are'}"


def _words(found: dict[str, Any]) -> str:
    """The verdicts, where they were recorded."""
    if "verdict" not in found:
        return "The verdict was not recorded."
    said = f"Over all frames: {headline(found['verdict'])}."
    drift = found["scale_drift"]["verdict"]
    said += f" At one scale a run: {headline(found['beyond_scale']['verdict'])}"
    return said + (f"; on the drift of scale: {drift['word']}." if drift else ".")


def _row(name: str, found: dict[str, Any]) -> list[str]:
    def at_steps(key: str) -> str:
        values = (found[key][step - 1] for step in STEPS)
        return ", ".join("–" if x is None else _digits(x) for x in values)

    rmse, sigma = (found[key]["position"][-1] for key in ("rmse", "sigma"))
    low, high = found["band95"]
    return [
        f"`{name}`",
        f"{found['runs']}; {low:.2f}–{high:.2f}",
        ", ".join(f"{100 * found['lost'][step - 1]:.3g}" for step in STEPS),
        at_steps("nees"),
        at_steps("nees_not_lost"),
        f"{found['lost_ever'][-1]:.1%}",
        f"{rmse:.2f}; {sigma:.2f}",
        f"{found['milliseconds_per_run'] / 1e3:.2g}",
    ]


def _digits(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.1e}".replace("e+0", "e")


def draw_figure(options: FromRest) -> None:
    """The modes of one run, beside the page."""
    with jax.enable_x64(True):
        scenario = jaxslam.scenario("standstill", steps=TOLD["steps"])
        room, runs = draw(scenario, TOLD["run"] + 1, seed=TOLD["seed"])
        run = jax.tree.map(lambda x: x[TOLD["run"]], runs)
        made = jaxslam.make_filters(scenario, [SUM, EKF], ["inverse_scaling"])
        rest, ekf = (jaxslam.cast(slam, jnp.float64) for slam in made.values())
        _, path, _ = eqx.filter_jit(filter_run)(ekf, room, scenario.sensor, run)
        modes = modes_of_run(rest, room, run)
    worlds = worlds_of(run, modes, path.translation(), "the EKF", scenario.rate)
    plot_modes(worlds, path=options.docs / "from-rest.png")


if __name__ == "__main__":
    FromRest.run()
