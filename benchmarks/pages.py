"""Numbers in the sentences of pages: a mark behind them says which result they show.

    python benchmarks/pages.py

writes all of them anew. In `σ × 1.02 [0.96, 1.11]<!-- =sigma('circle', 'recommended') -->` they are
three of `consistency.json`; a file of results is a name, as in `1.1<!-- =cost['filters'] … -->`.
A number keeps its decimals, and small whole ones may be words. `tests/benchmarks/test_pages.py`
fails where a page is older than its results.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmark import RESULTS, write_page
from consistency import label, verdicts_of
from sequences import LANDMARKS, ON_VIDEO

MARK = re.compile(r"<!-- =(.+?) -->", re.DOTALL)
WORDS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
         "eleven", "twelve")  # fmt: skip
NUMBER = re.compile(rf"\d(?:[\d,]*\d)?(?:\.\d+)?|\b(?:{'|'.join(WORDS)})\b", re.IGNORECASE)
FUNCTIONS = {f.__name__: f for f in (abs, len, max, min, round, sum)} | {
    "count": lambda values: sum(1 for _ in values)
}


def read(folder: Path = RESULTS) -> dict[str, Any]:
    """The names of a mark: the files of results, and what is computed from `consistency.json`."""
    files = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}

    def row(scenario: str, name: str) -> dict[str, Any]:
        """Its row of a filter, by the name in the tables."""
        return {label(key): x for key, x in files["consistency"][scenario].items()}[name]

    def mean(scenario: str, name: str) -> dict[str, Any]:
        """The verdict over all steps."""
        return verdicts_of(row(scenario, name))["tally"]["mean"]

    def sigma(scenario: str, name: str) -> list[float]:
        """The factor of σ over all steps, and the ends of its 99 % interval."""
        return [mean(scenario, name)["sigma_factor"], *mean(scenario, name)["interval99"]]

    def lost(scenario: str, name: str) -> float:
        """The share of runs that are lost at the last step."""
        return row(scenario, name)["lost"] / row(scenario, name)["runs"]

    def end(scenario: str, name: str) -> list[float]:
        """At the last step: NEES, the share of lost runs, and NEES of the others."""
        one = row(scenario, name)
        return [one["nees"][-1], lost(scenario, name), one["nees_not_lost"]]

    def theirs(study: str, name: str) -> list[float]:
        """Our values beside those of a published table, quantity by quantity."""
        rows = files["published"]["rows"]
        return [x["ours"] for x in rows if (x["study"], x["filter"]) == (study, name)]

    def sot(scenario: str) -> list[float]:
        """NEES and the share of lost runs of three parametrizations."""
        rows = files["comparison"]["scenarios"][scenario]
        names = ("inverse_scaling", "image_plane", "sot_normal")
        each = (rows[f"robocentric/{name}"] for name in names)
        return [row[key] for row in each for key in ("nees", "lost")]

    def told() -> list[int]:
        """How many published values there are, and how many are within our interval."""
        within = [x["within"] for x in files["published"]["rows"] if x["theirs"] is not None]
        return [len(within), sum(within)]

    def along(trajectory: str, name: str) -> list[float]:
        """Of a filter with an inertial unit: NEES per degree of freedom and its interval, of
        orientation and position, in the first third and at the end; the RMSE there; the lost."""
        row = files["inertial"][trajectory][name]
        parts = [row[part] for part in ("orientation", "position")]
        found = [x for part in parts for of in ("first", "end") for x in part[of]]
        return [*found, *(part["rmse"] for part in parts), row["lost"]]

    def observed(scenario: str, name: str) -> list[float]:
        """The numbers of a row of the table about observability."""
        one = files["observability"]["scenarios"][scenario][f"{name}/inverse_scaling"]
        along = one["along"]
        told = (one[key] for key in ("nees", "nees_median", "lost", "inside"))
        return [*told, along["error"], along["sigma"]]

    def initialised(scenario: str, name: str) -> list[float]:
        """The numbers of a row of the table about delayed initialisation, the bias unsigned."""
        one = files["initialisation"][scenario]["filters"][name]
        landmarks = one["landmarks"]["all"]
        told = (one[key] for key in ("nees", "nees_median", "lost", "delay_mean"))
        return [*told, landmarks["dropped"], abs(landmarks["bias"])]

    def walked(key: str) -> list[float]:
        """Of `handheld.json`, at the ends of the runs along simulated trajectories, sorted."""
        found = {name: next(iter(x.values())) for name, x in files["handheld"].items()}
        return sorted(x[key][-1] for name, x in found.items() if name.startswith("handheld"))

    def believed(name: str = ON_VIDEO, video: str = "synthetic") -> dict[str, list[float]]:
        """What the tracker believes on videos of which the names begin so, NEES and drift sorted:
        the drift itself, and in its σ."""
        found = [
            filters[f"{name}/{LANDMARKS}"]["belief"]
            for key, filters in files["sequences"].items()
            if key.startswith(video)
        ]
        drifts = zip(*(x["drift"] for x in found), strict=True)
        itself, normalised = (sorted(x) for x in drifts)
        return {"nees": sorted(x["nees"] for x in found), "drift": itself, "of_sigma": normalised}

    def filmed(key: str) -> list[float]:
        """A number of all rendered videos that have it, sorted."""
        videos = (x for seeds in files["rendered"].values() for x in seeds.values())
        return sorted(x[key] for x in videos if key in x)

    def accused(test: str = "verdict", *without: str) -> float:
        """The largest share of right filters that a test of one run calls over-confident."""
        rows = (row for row in files["one_run"]["right"] if row["name"] not in without)
        return max(row["over_confident"][test] for row in rows)

    def cautious(name: str) -> list[float]:
        """The least and the largest share of right filters of a kind whose NEES seems too small."""
        found = [row["cautious"] for row in files["one_run"]["right"] if row["name"] == name]
        return [min(found), max(found)]

    def shown(factor: float) -> float:
        """The least share of filters whose σ is too small by a factor that one run shows."""
        rows = (row for row in files["one_run"]["wrong"] if row["factor"] == factor)
        return min(row["over_confident"]["verdict"] for row in rows)

    def on_gpu(name: str, dtype: str = "float64") -> float:
        """µs a step of a run in batches of 10,000."""
        found = files["gpu"]["filters"][name][dtype]["device"]["10000"]
        return found["microseconds_per_step"]

    functions = (
        row, mean, sigma, lost, end, theirs, told, along, observed, initialised, walked,
        believed, filmed, accused, cautious, shown, on_gpu, sot,
    )  # fmt: skip
    return files | {function.__name__: function for function in functions}


def value_of(expression: str, results: Mapping[str, Any]) -> list[float]:
    """The numbers that a mark names. Raises KeyError where the results have no such thing."""
    names = {"__builtins__": FUNCTIONS, **results}
    found = eval(" ".join(expression.split()), names)
    return list(found) if isinstance(found, Sequence) else [found]


def shown_as(old: str, value: float, percent: bool = False) -> str:
    """The value in the form of the number in whose place it is; a share in percent as in tables."""
    if old[0].isalpha() and not percent and value == round(value) and value < len(WORDS):
        word = WORDS[round(value)]
        return word.capitalize() if old[0].isupper() else word
    decimals = len(old.partition(".")[2])
    form = f"{',' if ',' in old else ''}.{decimals}{'%' if percent else 'f'}"
    return format(value, form).removesuffix("%")


def rewritten(text: str, results: Mapping[str, Any]) -> str:
    """A page with the numbers of the results. Raises ValueError where a mark finds too few."""
    parts, end = [], 0
    for mark in MARK.finditer(text):
        before = text[end : mark.start()]
        values = value_of(mark[1], results)
        numbers = list(NUMBER.finditer(before))[-len(values) :]
        if len(numbers) < len(values):
            raise ValueError(f"{len(values)} numbers are needed before {mark[0]}")
        for number, value in reversed(list(zip(numbers, values, strict=True))):
            percent = before[number.end() :].lstrip()[:1] == "%"
            new = shown_as(number[0], value, percent)
            before = before[: number.start()] + new + before[number.end() :]
        parts += [before, mark[0]]
        end = mark.end()
    return "".join([*parts, text[end:]])


def pages(root: Path = Path()) -> list[Path]:
    """The pages that may show results."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


if __name__ == "__main__":
    results = read()
    for page in pages():
        if (new := rewritten(page.read_text(), results)) != page.read_text():
            write_page(page, new)
            print(f"wrote {page}")
