"""Tests of the benchmark of filters from rest: what its table and its sentences say."""

from typing import Any

import from_rest as benchmark
import numpy as np

from jaxslam.statistics import run_verdict

STEPS = 60


def found(**changed):
    numbers = {
        "runs": 50, "seed": 3, "dof": 3, "band95": [2.4, 3.7], "milliseconds_per_run": 1500.0,
        "reversed": [None] + [0.0] * (STEPS - 1),
        "rmse": {"position": [0.1] * STEPS}, "sigma": {"position": [0.2] * STEPS},
    }  # fmt: skip
    means = {"nees": 4.0, "nees_not_lost": 3.0, "lost": 0.25, "lost_ever": 0.5}
    return numbers | {key: [value] * STEPS for key, value in means.items()} | changed


def test_a_row_says_at_every_frame_what_is_lost_and_how_true_the_others_are():
    nees: list[Any] = [3.0] * STEPS
    nees[9], nees[-1] = 7.25, None
    table = benchmark.as_table({"standstill": {"mine": found(nees_not_lost=nees)}})
    assert table.splitlines()[-1].split(" | ") == [
        "| `mine`", "50; 2.40–3.70", "25, 25, 25, 25", "4.0, 4.0, 4.0, 4.0",
        "3.0, 3.0, 7.2, –", "50.0%", "0.10; 0.20", "1.5 |",
    ]  # fmt: skip


def test_the_sentences_are_of_the_numbers_of_all_runs():
    nees: list[Any] = [3.0] * STEPS
    lost, reversed_ = [0.0] * STEPS, [None, *[0.0] * (STEPS - 1)]
    # A mean that does not exist is above the band.
    nees[8], nees[9], nees[33], nees[40] = 9.0, 3.8, None, 2.3
    lost[8], lost[33], reversed_[56] = 0.5, 0.1, 0.02
    numbers = found(nees=nees, lost=lost, reversed=reversed_)
    (said,) = benchmark.sentences(
        {"standstill": {"mine": numbers, "mine+rest8": numbers}}
    ).splitlines()
    assert said.startswith("- `standstill`, `mine+rest8`: of 50 runs (seed 3) at most 5 are lost")
    assert "at most 1 is reversed at any of frames 10 to 60" in said
    assert "above its band at 2 of these 51 frames and below it at 1." in said
    assert said.endswith("The verdict was not recorded.")
    verdicts = {
        "verdict": run_verdict(np.random.default_rng(0).chisquare(3, (50, STEPS)) * 2.0, 3),
        "beyond_scale": {"verdict": run_verdict(np.full((50, STEPS), 2.5), 3, fitted=1.0)},
        "scale_drift": {"verdict": None},
    }
    said = benchmark.sentences({"standstill": {"mine+rest8": numbers | verdicts}})
    assert "over-confident" in said.split("Over all frames: ")[1].split("At one scale a run:")[0]
