"""Tests of benchmarks/real_logs.py and of what it stored."""

import pytest
import real_logs as benchmark

STORED = benchmark.RealLogs().found()
LOGS = STORED["logs"]
WORLD, BODY = "estimate and truth are not in one world", "estimate and truth are of two bodies"


@pytest.mark.parametrize("name", benchmark.OF_SMFEVAL)
def test_the_numbers_of_smfeval_are_reproduced_to_nine_digits(name):
    ours, theirs = (STORED["smfeval"][name][x] for x in ("ours", "theirs"))
    assert ours == pytest.approx(theirs, rel=1e-9)


def test_what_is_known_of_the_logs_is_found():
    """By NumPy alone, from the raw files."""
    assert list(LOGS) == [log.name for log in benchmark.LOGS]
    in_its_world = LOGS["OpenVINS on EuRoC MH_01, `--align yaw`"]
    assert in_its_world["nees"] == pytest.approx(775, rel=0.01)
    assert in_its_world["parts"] == pytest.approx({"position": 415, "rotation": 360}, rel=0.02)
    assert LOGS["RTKLIB on UrbanNav"]["sigma_factor"] == pytest.approx(14.2, rel=0.01)
    right, wrong, left = (x for name, x in LOGS.items() if "cnspy, errors" in name)
    assert right["parts"] == pytest.approx({"position": 3.01, "rotation": 3.03}, abs=0.01)
    assert [wrong["nees"], left["nees"]] == pytest.approx([9.9, 6.0], abs=0.05)
    point_lio = LOGS["Point-LIO on Oxford Spires, `--align se3`"]
    for log, cause in ((LOGS["OpenVINS on EuRoC MH_01"], WORLD), (point_lio, BODY)):
        assert [x["cause"] for x in log["causes"]] == [cause]


def test_smfeval_is_reproduced_from_its_files(shared_data):
    folder = shared_data / "logs" / "smfeval_point_lio"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not on this machine")
    assert benchmark.as_smfeval(folder) == pytest.approx(
        STORED["smfeval"]["smfeval_point_lio"]["ours"], rel=1e-9
    )
