"""The page of stress has the numbers on disk, and says which of them are old."""

import json
from pathlib import Path

import disturbances
import pytest
import starts

FOLDER = Path(__file__).resolve().parents[2]
PAGE = (FOLDER / "docs/stress.md").read_text()


def on_disk(name):
    return json.loads((FOLDER / f"benchmarks/results/{name}.json").read_text())


@pytest.mark.parametrize("benchmark", [starts, disturbances], ids=lambda module: module.__name__)
def test_the_tables_are_of_the_numbers_on_disk(benchmark):
    table = benchmark.as_table(on_disk(benchmark.__name__))
    assert f"{benchmark.MARK}\n\n{table}\n\n" in PAGE


def test_rows_of_an_older_tracker_have_a_dagger():
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and " † |" in line]
    words = [disturbances.DISTURBANCES[name][1] for name in disturbances.OLDER]
    assert sorted(row.split(" † |")[0] for row in rows) == sorted(f"| {x}" for x in words)
    assert "`python benchmarks/endurance.py` †" not in PAGE


def test_the_answer_is_that_of_the_numbers():
    found = on_disk("disturbances")
    assert [row["maps"] for row in found["cut"]].count(1) == 1
    assert [row["lies"] > 0.01 for row in found["rotation"]].count(True) == 1
    assert all(row["lies"] > 0.05 for row in found["ghost"])
    sequences = on_disk("starts").values()
    of_starts = [one for sequence in sequences for one in sequence["starts"].values()]
    assert len(of_starts) == 80
    assert [maps for _, maps, *_ in of_starts].count(2) == 1
    assert all(sign is None or sign > 0 for _, _, sign, *_ in of_starts)
