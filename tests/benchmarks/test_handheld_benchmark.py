"""Tests of benchmarks/handheld.py: its numbers are those of its runs, and measured only once."""

import json

import handheld as benchmark
import numpy as np
import pytest
import recordings
import test_tracks
from benchmark import END

from jaxslam.statistics.beyond_scale import one_scale_of


def records(runs=50, steps=40):
    """Of a consistent filter, of which one run is lost from step 20 on and one diverges there; the
    scale is right in every run's own unit, which is fixed from step 12 on."""
    rng = np.random.default_rng(0)
    nees, sigma = rng.chisquare(5, (runs, steps)), rng.uniform(0.1, 0.3, (runs, steps))
    nees[3, 20:], nees[4, 20:] = 500.0, np.nan
    away = np.zeros((runs, steps))
    away[:5], away[:, :15] = 1.0, np.nan
    return {
        "beyond_scale": nees,
        "log_scale": sigma * rng.normal(size=sigma.shape),
        "log_scale_sigma": sigma,
        "unit_log_scale": np.log(2.0) + 0.01 * rng.normal(size=sigma.shape),
        "unit_log_scale_sigma": np.full_like(sigma, 0.01),
        "unit_fixed": np.broadcast_to((np.arange(steps) >= 11) * 1.0, nees.shape),
        "reversed": away,
        "nis": np.full((runs, steps), 9.0),
        "nis_dof": np.full((runs, steps), 10.0),
    }


def test_numbers_are_those_of_the_runs():
    given = records()
    found = benchmark.numbers(given)
    assert found["at"] == [10, 30, 40]
    normalised, one = (given["log_scale"] / given["log_scale_sigma"]) ** 2, one_scale_of(given)
    good = np.arange(50) != 4
    for i, step in enumerate((9, 29, 39)):
        kept = good if step > 20 else np.ones(50, bool)
        assert found["one_scale"][i] == pytest.approx(one.nees[kept, step].mean() / 6)
        assert found["lost"][i] == (0.04 if step > 20 else 0)
        rms = np.sqrt(np.mean(normalised[kept, step]))
        assert found["log_scale_normalised"][i] == pytest.approx(rms)
    assert found["one_scale_median"][0] == pytest.approx(np.median(one.nees[:, 9]) / 6)
    assert found["drift_rms"][0] is None  # no unit yet
    assert found["drift_rms"][1] == pytest.approx(np.sqrt(np.mean(one.drift[good, 29] ** 2)))
    rms = np.sqrt(np.mean(one.normalised[good, 29]))
    assert found["drift_normalised"][1] == pytest.approx(rms)
    # Of those that moved; the one that diverged, reversed as it is, does not count.
    assert found["reversed"] == [None, pytest.approx(4 / 49), pytest.approx(4 / 49)]
    assert found["nis"] == pytest.approx(0.9)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.fixture
def options(tmp_path, monkeypatch):
    """A folder of one trajectory and one drive."""
    monkeypatch.setenv("JAXSLAM_DATA", str(tmp_path))
    (tmp_path / "handheld.md").write_text(f"{benchmark.MARK}\n{END}\n")
    (tmp_path / "trajectories").mkdir()
    (tmp_path / "kitti_tracks" / "street").mkdir(parents=True)
    times = np.arange(0, 2, 0.02)
    recordings.write(tmp_path / "trajectories" / "walk.txt", times)
    test_tracks.write(tmp_path / "kitti_tracks" / "street")
    return benchmark.Handheld(
        filters=("robocentric",), runs=2, steps=3, starts=2, frames=4,
        out=tmp_path / "x.json", docs=tmp_path,
    )  # fmt: skip


@pytest.mark.slow
def test_everything_in_the_folder_is_measured(options):
    """A drive whose windows, or a trajectory whose runs, a filter cannot go through."""
    options()
    found = json.loads(options.out.read_text())
    assert set(found) == {"handheld-walk", "tracks-street"}
    for where, steps in {"handheld-walk": 3, "tracks-street": 4}.items():
        result = found[where]["robocentric/inverse_scaling"]
        assert (result["runs"], result["steps"], result["at"]) == (2, steps, [steps])
        assert result["one_scale"][0] is not None
        assert where.removeprefix("handheld-") in (options.docs / "handheld.md").read_text()
    assert not list(options.measure())
