"""The page of stress has the numbers on disk, and its answer is theirs."""

import json
import re
from pathlib import Path

import disturbances
import endurance
import numpy as np
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


def test_the_table_of_the_long_run_is_of_the_numbers_on_disk(tmp_path):
    """The command that only writes its page leaves that as it is."""
    (tmp_path / "stress.md").write_text(PAGE)
    results = FOLDER / "benchmarks/results/endurance.json"
    endurance.Endurance(out=results, docs=tmp_path, page=True)()
    assert (tmp_path / "stress.md").read_text() == PAGE


def test_the_answer_is_that_of_the_numbers():
    found = on_disk("disturbances")
    assert all(row["maps"] == 2 for name in ("cut", "cut_back") for row in found[name])
    assert all(row["lies"] < 0.02 for row in found["rotation"])
    ghosts = np.mean([row["lies"] for row in found["ghost"]])
    assert f"and {ghosts:.1%} of the poses are beyond 5 σ".replace("%", " %", 1) in " ".join(
        re.sub("<!--.*?-->", "", PAGE).split()
    )
    sequences = on_disk("starts").values()
    of_starts = [one for sequence in sequences for one in sequence["starts"].values()]
    assert len(of_starts) == 80
    assert [maps for _, maps, *_ in of_starts].count(2) == 1
    assert all(sign is None or sign > 0 for _, _, sign, *_ in of_starts)
