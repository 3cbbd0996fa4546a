"""Every step of every run, in a Parquet file that other tools read."""

import json
import sys

import numpy as np
import pyarrow.parquet as parquet
import pytest

import jaxslam
from jaxslam.cli import main
from jaxslam.consistency import write_records

STEPS, RUNS, CHUNK = 6, 5, 2


@pytest.fixture(
    scope="module", params=["matched-tight", pytest.param("matched-6dof", marks=pytest.mark.slow)]
)
def study(request):
    scenario = jaxslam.scenario(request.param, steps=STEPS, landmarks=5)
    filters = jaxslam.make_filters(scenario, ["robocentric", "world"], ["inverse_scaling"])
    return jaxslam.monte_carlo(scenario, filters, runs=RUNS, seed=4, chunk=CHUNK)


@pytest.mark.slow
def test_every_number_of_every_step_is_in_the_file(study, tmp_path):
    write_records(study, tmp_path / "new" / "records.parquet")
    rows = parquet.read_table(tmp_path / "new" / "records.parquet").to_pandas()
    assert len(rows) == len(study.filters) * RUNS * STEPS
    axes = ["x", "z", "rotation"]
    if study.scenario.geometry == "spatial":
        axes = ["x", "y", "z", "rotation_x", "rotation_y", "rotation_z"]
    for name in study.filters:
        own = rows[rows["filter"] == name].sort_values(["run", "step"])
        np.testing.assert_array_equal(own["run"], np.repeat(range(RUNS), STEPS))
        np.testing.assert_array_equal(own["step"], np.tile(range(1, STEPS + 1), RUNS))
        np.testing.assert_allclose(own["time"], own["step"] / study.scenario.rate)
        parts = [study.store.load(name, chunk) for chunk in study.chunks]
        for key in parts[0]:
            if key.startswith("sample_"):
                assert key not in rows
                continue
            whole = np.concatenate([part[key] for part in parts])
            columns = [f"{key}_{axis}" for axis in axes] if whole.ndim == 3 else [key]
            found = np.stack([own[column] for column in columns], axis=-1)
            np.testing.assert_array_equal(found.ravel(), whole.ravel())


def test_a_file_says_what_made_it_and_holds_a_chunk_at_a_time(study, tmp_path):
    write_records(study, tmp_path / "records.parquet")
    file = parquet.ParquetFile(tmp_path / "records.parquet")
    assert file.num_row_groups == len(study.filters) * len(study.chunks)
    made_by = json.loads(file.schema_arrow.metadata[b"jaxslam"])
    assert made_by["seed"] == 4
    assert made_by["scenario"]["landmarks"] == 5


@pytest.mark.slow
def test_the_command_writes_it_and_resumes_to_the_same(tmp_path):
    sizes = "--scenario matched --steps 3 --runs 4 --chunk 2 --landmarks inverse_scaling"
    command = ["consistency", *sizes.split(), "--out", str(tmp_path)]
    path = tmp_path / "all.parquet"
    main([*command, "--records", str(path)])
    before = path.read_bytes()
    next((tmp_path / "runs").rglob("*.npz")).unlink()
    main([*command, "--resume", "--records", str(path)])
    assert path.read_bytes() == before


def test_another_format_is_refused_before_anything_is_computed(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["consistency", "--out", str(tmp_path / "out"), "--records", str(tmp_path / "a.csv")])
    assert ended.value.code == 2
    assert "written as Parquet, FILE.parquet, not as a.csv" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_the_extra_it_is_named(study, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ValueError, match=r"need the parquet extra .* pip install '\.\[parquet\]'$"):
        write_records(study, tmp_path / "records.parquet")
