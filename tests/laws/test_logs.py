"""Every format of a log gives the verdict of its arrays, and says in one line what is wrong."""

import re
from functools import cache

import numpy as np
import pytest
from logs import LOGS, TIMES
from refusals import refused

TEXTS = [name for name in LOGS if not (name.startswith(("npz", "mat", "bag")) or "16" in name)]
UNSAID = {
    "TUM and a triangle", "TUM, variances by titles", "titles of angles in degrees, and σ",
    "titles of PlotJuggler and ROS 2", "titles of ROS' CSV with covariances", "titles of PX4",
    "echo of ROS 2", "titles of deviations", "titles of an information matrix",
}  # fmt: skip
"""Logs that do not say of which error their covariances are."""
TABLES = [name for name in TEXTS if name.startswith("CSV")]


@pytest.fixture
def written(request, tmp_path):
    """A log, what evaluates it, whatever became of its files, and these."""
    log = LOGS[request.param]
    log.write(tmp_path)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    return log, (lambda: log.evaluated(tmp_path)), files


def of_logs(names):
    return pytest.mark.parametrize("written", names, indirect=True, ids=str)


@cache
def wanted_of(verdict):
    """The verdict of the arrays, once for all formats."""
    return verdict()


@pytest.mark.parametrize("name", LOGS)
def test_a_log_has_the_verdict_of_its_arrays(name, tmp_path):
    log = LOGS[name]
    log.write(tmp_path)
    found, wanted = log.evaluated(tmp_path), wanted_of(log.wanted)
    np.testing.assert_allclose(found.nees, wanted.nees, rtol=log.rtol)
    assert found.verdict["word"] == wanted.verdict["word"]
    assert found.convention == (log.convention or wanted.convention)
    assert (found.quantity, found.dof, found.fitted) == (wanted.quantity, wanted.dof, wanted.fitted)
    assert set(found.names) == set(wanted.names)
    assert log.convention or found.names == wanted.names
    assert ("NEES" in str(found)) == (wanted.quantity == "NEES")
    unsaid = any("does not state its convention" in note for note in found.notes)
    assert unsaid == (name in UNSAID)
    if name.startswith(("TUM", "states", "poses", "plane", "bag")):  # which are of stamps
        np.testing.assert_allclose(found.times, TIMES, rtol=0, atol=1e-6)


# Of one error the NaN of its covariance is that of all of it: nothing was logged.
@of_logs([name for name in TEXTS if name != "CSV, n = 1"])
def test_a_line_that_is_cut_or_not_finite_is_named(written):
    log, evaluated, files = written
    for path in files:
        whole = path.read_text().splitlines()
        between = re.search(r"[ ,;\t]", whole[-1])
        cut = whole[-1][: len(whole[-1]) // 2].rpartition(between[0])[0] if between else "x"
        without = re.sub(r"\d[^ ,;\t]*,?$", "nan", whole[-1])
        for spoilt in (cut, *[without] * (not log.spare), whole[-1] + ".x"):
            path.write_text("\n".join([*whole[:-1], spoilt]))
            refused(evaluated, rf"{path.name}, line {len(whole)}: expected .*(numbers|times)")
        path.write_text("\n".join(whole))


SPOILT_TEXTS = b"", b"\xff\xfe", b"a: [", b"rosbag2_bagfile_information:\n  version: 5\n"


@of_logs([name for name in LOGS if not name.startswith("bag:")])
def test_a_file_that_is_empty_or_of_another_kind_is_named(written):
    _, evaluated, files = written
    for path in files:
        whole = path.read_bytes()
        expected, spoilt = rf"{path.name}|has no covariance\.txt or", SPOILT_TEXTS
        if path.suffix in (".bag", ".mcap", ".db3", ".yaml"):
            expected = "cannot be read .*; expected a ROS bag .*, complete"
        if path.suffix in (".npz", ".mat", ".bag", ".mcap", ".db3"):
            spoilt = b"", b"hello\n", whole[: len(whole) // 2], whole[:20], bytes(3000)
        for content in spoilt:
            path.write_bytes(content)
            refused(evaluated, expected)
        path.write_bytes(whole)


@of_logs([name for name in TEXTS if not name.startswith(("KITTI", "g2o", *TABLES))])
def test_lines_of_a_trajectory_are_in_the_order_of_their_times(written):
    _, evaluated, files = written
    for path in files:
        whole = path.read_text().splitlines()
        if len(whole[-1].split()) != 12:  # of KITTI, whose times are beside
            path.write_text("\n".join([*whole[:-2], *reversed(whole[-2:])]))
            refused(evaluated, r"times decrease from .* s; expected one run in temporal order")
            path.write_text("\n".join(whole))


@of_logs([name for name in TABLES if "NEES" not in name])
def test_lines_of_a_table_are_in_any_order(written):
    _, evaluated, (path,) = written
    before = evaluated()
    whole = path.read_text().splitlines()
    titles = 1 if whole[0][0].isalpha() else 0
    path.write_text("\n".join([*whole[:titles], *reversed(whole[titles:])]))
    np.testing.assert_array_equal(evaluated().nees, before.nees)


@of_logs(["TUM", "TUM, of the tracker", "states of OpenVINS, 1 cameras", "plane, σ"])
def test_a_file_that_is_missing_is_named(written):
    _, evaluated, files = written
    for path in files:
        kept = path.rename(path.with_suffix(".away"))
        refused(evaluated, "has (no|neither) ")
        kept.rename(path)


def test_a_number_that_is_too_large_to_be_squared_is_refused(tmp_path):
    LOGS["TUM"].write(tmp_path)
    for text in ("1 2 3 4 1e200 0 1\n", "t,x,y,z,sx,sy,sz\n0,1,2,3,1e200,1,1\n"):
        (tmp_path / "truth.txt").write_text(text)
        with pytest.raises(ValueError, match=r"truth\.txt"):
            LOGS["TUM"].evaluated(tmp_path)
