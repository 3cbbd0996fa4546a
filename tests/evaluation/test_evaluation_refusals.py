"""What is no log, or no part of one, is refused in one line that says what is wrong and where."""

import numpy as np
import pytest
from logs import FIXED, drawn, logged, one_run, planar, tracked_run, write_runs
from refusals import ended, refused
from scipy.io import savemat

import jaxslam
from jaxslam.evaluation import Convention, evaluate_log, evaluate_nees, read_covariances
from jaxslam.evaluation.convention import write_covariances
from jaxslam.io.logs import read_log
from jaxslam.io.tum import write_tum

E, P = drawn()
T, POSE_P, TRUTH = logged(Convention(), runs=3)
STILL = logged(Convention(), spread=0.0)[:2]
TURNS = np.linspace(0.0, 3.0, 60)
COURSE = np.column_stack([np.sin(TURNS), 1 - np.cos(TURNS), np.degrees(TURNS)])[None]


def changed(values, place, value):
    values = np.array(values)
    values[place] = value
    return values


def arrays(e=E, P=P, **more):
    return lambda: jaxslam.evaluate(e, P, **more)


def spoilt_P(place, value):
    return arrays(P=changed(P, place, value))


def poses(T=T, P=POSE_P, truth=TRUTH, *more, **how):
    return lambda: jaxslam.evaluate_poses(T, P, truth, *more, **how)


def nees(value, dof):
    return lambda: evaluate_nees([[1.0, value]], dof)


KNOWN = changed(P, np.s_[:, 0], 0.0)
SET_OUT = changed(changed(E, np.s_[:, 0], 0.0), (3, 0, 1), 0.2)
OF_ARRAYS = [
    (arrays(E[0]), r"errors must be an array \(runs, steps, n\), .*errors\[None\]"),
    (arrays(P=P[:, :3]), r"covariances must be \(60, 7, 3, 3\), not \(60, 3, 3, 3\)"),
    (arrays(P=P[..., 0]), r"covariances must be an array \(runs, steps, n, n\)"),
    (arrays(changed(E, (4, 2, 1), np.nan)), "errors of run 4, step 2 holds nan"),
    (spoilt_P((5, 1, 0, 0), np.inf), "covariances of run 5, step 1 holds inf"),
    (arrays(changed(E, 2, np.nan), changed(P, 2, np.nan)), "run 2 is all NaN"),
    (spoilt_P((3, 4), -np.eye(3)), "run 3, step 4 has variance -1 at place 0"),
    (spoilt_P((3, 4, 0, 1), 9.0), r"run 3, step 4 is not symmetric .*it must be symmetric and pos"),
    (spoilt_P((6, 5), 2.0 - np.eye(3)), "run 6, step 5 has an eigenvalue"),
    (spoilt_P((6, 5), 0.0), "run 6, step 5 "),
    (spoilt_P((6, 5), np.where(np.eye(3) > 0, 1e-308, 1e308)), "1e.308 where its variances allow"),
    (arrays(E[:0], P[:0]), r"errors must be an array .*, not \(0, 7, 3\)"),
    (arrays("many"), "errors must be numbers"),
    (arrays(E.astype(complex)), "errors must be numbers"),
    (arrays(times=[0, 1, 2, 3, 2, 5, 6]), "times must be 7 finite, non-decreasing"),
    (arrays(times=np.full(7, np.nan)), "times must be 7 finite, non-decreasing"),
    (arrays(times="soon"), "times must be 7 finite, non-decreasing"),
    (arrays(names=["x", "x", "y"]), "names must be 3 different ones"),
    (arrays(quantity="NES"), r"unknown quantity 'NES' .*known: NEES, NIS"),
    (arrays(SET_OUT, KNOWN), r"run 3, step 0 is zero.* is not: 0\.2.*--align"),
    (spoilt_P((6, 5), np.where(np.eye(3) > 0, 1.0, 1.7e308)), "has an eigenvalue -"),
    (arrays(0 * E, 0 * P), "all covariances are zero"),
    (arrays(changed(E, 3, 0.0), changed(P, 3, 0.0)), "all covariances of run 3 are zero"),
    (nees(-1.0, 3), "NEES of run 0, step 1 is -1; 0 or more"),
    (nees(1.0, 10**6 + 1), "dof must be one whole number"),
    (lambda: Convention(error="lfet"), "unknown error 'lfet' .did you mean left"),
    (lambda: Convention(axes="camera"), "unknown axes 'camera'; known: body, world, mixed"),
    (lambda: Convention(scale="free"), "unknown scale"),
    (poses(changed(T, (1, 2, 0, 0), 9.0)), "estimates of run 1, step 2 is not a rigid motion"),
    (poses(truth=TRUTH[:2]), r"truths must have the same shape, not \(2, 6, 4, 4\)"),
    (poses(P=np.full((3, 36, 36), 1e300)), r"covariances of run 0 hold numbers .*beyond 1e\+100"),
    (poses(P=POSE_P[..., :3, :3]), r"must be \(3, 6, 6, 6\), or the joint ones"),
    (poses(truth=changed(TRUTH, (0, 0, 0, 3), 1e300), align="se3"),
     r"truths contain 1e\+300; the limit is 1e\+100"),
    (poses(T[..., :2, :2]), "estimates must be matrices"),
    (poses(COURSE, POSE_P[:1, [0] * 60, :3, :3], COURSE),
     "estimates have θ in degrees, as their course shows; expected radians"),
    (poses(times=np.arange(6) * 10**8), r"times 1e.08 from one to the next look like nanoseconds"),
    (poses(*planar(runs=3)[:3], Convention("split"), axes_used=["x", "yaw"]),
     "unknown axes used 'yaw'; known: x, y, z, rx, ry, rz"),
    (poses(T, POSE_P, TRUTH, Convention(scale="given"), align="se3"),
     "--align sim3, or se3 if the first covariance is zero"),
    (poses(align="rigid"), "unknown align 'rigid'; known: none, first, yaw, se3, sim3"),
    (poses(*STILL, np.tile(np.eye(4), (40, 6, 1, 1)), align="sim3"), "coincide"),
    (poses(T[:, :1], POSE_P[:, :1], TRUTH[:, :1], align="sim3"), "coincide"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "message"), OF_ARRAYS)
def test_arrays_that_make_no_sense_are_refused_by_run_and_step(call, message):
    refused(call, message)


def test_what_is_nearly_singular_or_rounded_or_large_is_no_fault():
    nearly = changed(P, (6, 5), np.ones((3, 3)) + 1e-3 * np.eye(3) - 5e-3)
    nearly[..., 0, 1] *= 1 + 1e-7
    assert jaxslam.evaluate(E, nearly).runs == 60
    assert evaluate_nees([[1e6]], 10**6).dof == 10**6


# --- files: each row writes into a folder, and reads ---------------------------------------------


@pytest.mark.parametrize("time", ["05/03/2023 12:00:01", "12:00:01 1"])
def test_dates_that_may_mean_several_times_are_refused_by_what_they_are(time, tmp_path):
    path = tmp_path / "log.txt"
    path.write_text(f"{time} 0 0 0 0 0 0 1\n")
    refused(lambda: read_log(path), f"line 1: {time.split()[0]}.* may mean several times")


def csv(text):
    def read(folder):
        (folder / "a.csv").write_text(text)
        return evaluate_log(folder / "a.csv")

    return read


def npz(arrays, **how):
    def read(folder):
        np.savez(folder / "a.npz", **arrays)
        return evaluate_log(folder / "a.npz", **how)

    return read


def of_errors(**how):
    """A whole file of errors, evaluated as what it is not."""
    return npz({"errors": E, "covariances": P}, **how)


def covariances(text):
    def read(folder):
        (folder / "c.txt").write_text(text)
        return read_covariances(folder / "c.txt")

    return read


def pose_alone(**how):
    def read(folder):
        write_tum(folder / "estimate.txt", [0.0], np.eye(4)[None])
        return evaluate_log(folder / "estimate.txt", **how)

    return read


def plane_and_space(folder):
    write_tum(folder / "truth.txt", np.arange(6), T[0])
    (folder / "estimate.txt").write_text("".join(f"{t} 0 0 0\n" for t in range(6)))
    (folder / "covariance.txt").write_text("".join(f"{t} 1 1 1\n" for t in range(6)))
    return evaluate_log(folder)


def with_truth_sigma(*sigma):
    return lambda folder: evaluate_log(one_run(folder), truth_sigma=sigma)


ONE, UPPER, DEVIATIONS = np.ones((1, 1, 1)), "1 " * 22, "0 1 1 -0.1 1 1 1"
NEES = "run,step,nees,dof\n0,0,1,3\n"
POSES = {"estimates": T, "covariances": POSE_P, "truths": TRUTH}
OF_FILES = [
    (csv("step,a,sigma_a\n5,1,1\n6,1,-1\n"),
     r"a\.csv: sigmas of run 0, step 6 must not be negative, not -1"),
    (csv("0,0,1,1\n0,1,1\n"), "line 2: expected numbers run, step, n errors"),
    (csv("0,0,1,1,3\n"), "5 columns; expected numbers run, step.*4 for n = 1, 7 for 2, 11 for 3"),
    (csv("0,0,1,1\n0,0,2,1\n"), "line 2: run 0, step 0 appears twice"),
    (csv("0,0,1,1\n0,1,1,1\n1,9,1,1\n1,10,1,1\n2,18,1,1\n2,19,1,1\n"), "6 different"),
    (csv("0,0,nan,1\n"), "run 0 is all NaN"),
    (csv("0,0,1,2,1,nan,1\n"), "line 1: expected numbers run"),
    (csv("1,1,1,1\n1,2,1,1\n3,2,1,-1\n"), "run 3, step 2 has variance"),
    (csv("run,step,e,P\n"), "has no errors"),
    (csv(NEES + "0,1,1,4.5\n"), "dof must be one whole number from 1"),
    (csv(NEES + "0,1,1,nan\n"), "line 3: expected numbers run, step"),
    (npz({"errors": ONE}), "errors and covariances"),
    (npz({"errors": np.array([None])}), "not an npz file of numbers"),
    (npz({"eror": ONE}), r"unknown array 'eror' \(did you mean error\?\)"),
    (npz({"errors": ONE, "covariances": np.array("many")}), "must be numbers"),
    (npz({"errors": 1, "innovations": 1, "covariances": 1}), "contains errors, innovations"),
    (npz({"estimates": np.ones((1, 1, 4, 4)), "covariances": 1.0}), "covariances and truths"),
    (npz(POSES | {"error": []}), "unknown error ''; known: right, left, split"),
    (npz({"errors": ONE, "sigmas": -1.22 * ONE}), r"sigmas of run 0, step 0 must not .* -1\.22"),
    (of_errors(stated={"error": "left"}), "axes used and σ of the truth apply to poses"),
    (of_errors(truth_sigma=(1, 1)), "σ of the truth apply to poses"),
    (of_errors(truth="t.txt"), "--truth goes with a trajectory"),
    (of_errors(nis=True, innovations="a.npz"), "--innovations FILE, not both"),
    (pose_alone(), r"needs a truth file .* one of covariances \(--covariance FILE\)"),
    (pose_alone(nis=True), "innovations must be in an npz or CSV file"),
    (plane_and_space, r"truth\.txt: estimate and truth must both be planar"),
    (lambda x: evaluate_log(x / "missing.npz"), "no such file or folder"),
    (evaluate_log, r"has neither estimate\.txt nor sub-folders"),
    (with_truth_sigma(-1, 0), "truth_sigma must be"),
    (with_truth_sigma(np.nan, 1), "truth_sigma must be"),
    (covariances("0 1 2 3\n"), r"c\.txt, line 1: expected 22 finite numbers"),
    (covariances("# a\n" + "nan " * 22), r"c\.txt, line 2: expected 22 finite numbers"),
    (
        covariances("1 1 nan" + UPPER[5:]),
        r"line 1: expected a covariance of finite numbers, or of NaN alone .* has the variance −1",
    ),
    (covariances("# error=lfet\n" + UPPER), r"c\.txt: unknown error 'lfet' \(did you mean left\?"),
    (covariances("# eror=left\n" + UPPER), r"c\.txt: unknown key 'eror' in the header \(did you"),
    (covariances("# angle=grad\n" + UPPER), r"c\.txt: unknown angle 'grad'"),
    (covariances("#\n"), r"c\.txt has no covariances"),
    (covariances(f"{DEVIATIONS}{' 0' * 11}\n"), r"c\.txt: a σ is -0\.1; expected 0 to 1e\+\d+"),
]  # fmt: skip


def two_runs(spoil):
    def read(folder):
        write_runs(folder, T[:2], POSE_P[:2], TRUTH[:2], Convention())
        spoil(folder)
        return evaluate_log(folder)

    return read


def another(place):
    """A file of the second run elsewhere."""
    return two_runs(lambda x: (x / place).write_text((x / "run01" / "estimate.txt").read_text()))


def without(place):
    return two_runs(lambda x: (x / place).unlink())


def stated(P, convention):
    def spoil(folder):
        P_each, path = np.tile(P, (6, 1, 1)), folder / "run01" / "covariance.txt"
        write_covariances(path, np.arange(6) / 10, P_each, convention)

    return two_runs(spoil)


def shown(of, *names):
    """A run with other times in these of its files."""
    names = names or ("estimate.txt", "covariance.txt", "truth.txt")
    return lambda folder: evaluate_log(one_run(folder / "run", shown=dict.fromkeys(names, of)))


def of_text(name, text):
    """A run of which one file is another, or what is made of it."""

    def read(folder):
        file = one_run(folder / "run") / name
        file.write_text(text(file.read_text()) if callable(text) else text)
        return evaluate_log(folder / "run")

    return read


def frames(old, new):
    """The tracker's own record of its frames, spoilt."""

    def read(folder):
        tracked_run(folder, [20 * [FIXED]])
        file = folder / "frames.csv"
        file.write_text(file.read_text().replace(old, new))
        return evaluate_log(folder)

    return read


def in_the_plane(folder):
    for name, numbers in (("estimate", "1 2 0"), ("covariance", "1 1 1"), ("truth", "1 2 0")):
        text = "".join(f"{t / 10} {numbers}\n" for t in range(6))
        (folder / "run01" / f"{name}.txt").write_text(text)


OF_FOLDERS = [
    (two_runs(in_the_plane), ": planar and spatial runs cannot be mixed"),
    (two_runs(lambda x: evaluate_log(x, covariance=x / "c.txt")), "needs its own covariance"),
    (of_text("estimate.txt", "#%FORMAT SQUARE/0.3\n1 2 3\n"), "line 2: expected 29 numbers"),
    (another("run00/trajectory.txt"), r"run00 has both estimate\.txt and trajectory\.txt; keep"),
    (another("estimate.txt"), r"has a run and sub-folders with runs \(run00, run01\)"),
    (without("run01/truth.txt"), r"run01 has no truth\.txt"),
    (stated(np.eye(6), Convention("left")), "states a different convention"),
    (stated(-np.eye(6), Convention()), ": the covariance of run01, step 0 has variance -1"),
    (lambda x: evaluate_log(one_run(x / "run", offset=0.05)),
     r"truth\.txt have no time stamps in common within 0\.01 s"),
    (lambda x: evaluate_log(one_run(x / "run", offset=18.0 - 315964800.0)),
     r"One may be of GPS time, which is 315964782 s off: then say --time-offset 315964782"),
    (lambda x: evaluate_log(one_run(x / "run", offset=-37.0)),
     r"One may be of TAI, as of PTP, which is 37 s off: then say --time-offset 37"),
    (lambda x: evaluate_log(one_run(x / "run", offset=28800.0)),
     r"One may be of another zone, which is 28800 s off: then say --time-offset -28800"),
    (lambda x: evaluate_log(one_run(x / "run", offset=18 - 315964800.0 - 1790 * 604800.0)),
     r"GPS time, which is 1398556782 s off: then say --time-offset 1398556782"),
    (lambda x: evaluate_log(one_run(x / "run", offset=12345.0)),
     r"If one clock is known to be late, say --time-offset SECONDS"),
    (of_text("truth.txt", "PK\x03\x04"), r"truth\.txt: is compressed; unpack it first"),
    (
        shown(lambda t: f"{(t - 1.4e9) * 1e5:.0f}"),  # a hundred a second, in microseconds
        r"times 1e.04 from one to the next look like microseconds or milliseconds; expected "
        "seconds; a title such as t_us says which",
    ),
    (shown(lambda t: f"{t * 1e13:.0f}"), r"1\.4e.22 look like another unit; expected seconds"),
    (shown(lambda t: f"{t:g}"), "have only 1 different times, perhaps printed with too few digits"),
    (
        shown(lambda t: f"{t + (t > 1.4e9 + 0.7) * 0.03:.9f}", "truth.txt"),
        r"of its 40 times .* only 8 can be compared: 40 have a covariance .* 8 a truth\. "
        r".*truth\.txt has 40 times .* nearest one is 0\.03 s away",
    ),
    (shown(lambda t: f"{1.4e9 + (t - 1.4e9) % 2:.9f}", "truth.txt"),
     r"times decrease from 1400000001\.900 to 1400000000\.000 s; expected one run"),
    (of_text("estimate.txt", "est_err_type,t,x,y,z,pxx,pyy,pzz\ntype3,0,1,1,1,1,1,1\n"),
     r"estimate\.txt: est_err_type is type3; expected one of type1, type2, type5"),
    (of_text("estimate.txt", "#%FORMAT SQUARE/0.3\n#%TIMESTAMP_UNIT weeks\n" + "1 " * 29),
     r"the header TIMESTAMP_UNIT is weeks; expected seconds or milliseconds or"),
    (of_text("estimate.txt", "t,x,y,z,qx,qy,qz,qw,sx,sy,sz\n0,1,1,1,0,0,0,1,1,nan,1\n"),
     r"estimate\.txt, line 2: expected a covariance of finite numbers, or of NaN alone"),
    (of_text("estimate.txt", f"0 1 2 3 0 0 0 1 nan{20 * ' 0'}\n"), "line 1: .* or of NaN alone"),
    (of_text("truth.txt", "0 1 2 0.5\n0 1 2 1e101\n"), r"line 2: expected numbers up to 1e\+100"),
    (of_text("truth.txt", "VERTEX_SE2 0 1 2 1e101\n"), r"line 1: expected numbers up to 1e\+100"),
    (of_text("estimate.txt", "0 1 2 3 4 5\n"), r"line 1: 6 columns are no known format; expected"),
    (of_text("truth.txt", '[{"t": 0.0, "x": 1}]'), r"truth\.txt: is JSON, which is not read"),
    (of_text("estimate.txt", "header:\n  seq: 1\n"), "is YAML, .* .ros2 topic echo --csv does"),
    (of_text("truth.txt", "- t: 0.0\n  x: 1\n"), "is YAML, which is not read; write a table with"),
    (of_text("truth.txt", "$GPGGA,123519,4807.038,N,01131.000,E,1,08\n"), "is NMEA, .* latitude,"),
    (of_text("covariance.txt", "<?xml version='1.0'?>\n<gpx>\n"), "is XML, which is not read"),
    (of_text("truth.txt", "a,t,b\n0,1,2\n"), r"line 2: 3 columns \(a, t, b\) are no known format"),
    (of_text("truth.txt", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"),
     r"has 40 poses and .*truth\.txt 1, and not both have stamps: .*give times"),
    (shown(lambda t: f"{1.4e9 + 10 * (t - 1.4e9) + 0.03:.9f}", "truth.txt"),
     r"known to \d+ of its σ only; log it at the stamps of the truth"),
    (of_text("truth.txt", lambda text: "\n".join(text.splitlines()[:16])),
     r"only 15 can be compared.* half the lines"),
    (frames(",1,,", ",yes,,"), r"frames\.csv, line 2: expected a finite time.* unit_fixed 0 or 1"),
    (frames(",1,,", ",0,,"), "every frame with a pose is lost or has no fixed unit"),
    (frames("\n0,0", "\n0,-9"), r"pose at 0\.000 s; it must list the frames of the trajectory"),
    (frames("tracked,0", "tracked,-1"), "line 2: .* the number of a map"),
]  # fmt: skip


@pytest.mark.parametrize(("read", "message"), OF_FILES + OF_FOLDERS)
def test_a_file_that_makes_no_sense_is_refused_by_name_and_line(read, message, tmp_path):
    told = refused(read, message, tmp_path)
    assert str(tmp_path) in told or "--" in message or "truth_sigma" in message


def test_a_mistake_ends_the_command_with_status_2_and_one_line(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("0,0,1,-1\n")
    np.savez(tmp_path / "a.npz", errors=E, covariances=P)
    (tmp_path / "file").write_text("")
    for source, out, message in (
        ("a.csv", "out", "run 0, step 0 has variance -1"),
        ("a.npz", "file", "cannot write there"),
    ):
        ended(message, ["evaluate", str(tmp_path / source)], tmp_path / out, capsys)


@pytest.mark.parametrize("kind", [99, 1 << 15])
def test_a_mat_file_that_ends_the_process_which_reads_it_is_refused(kind, tmp_path):
    """Of numbers of no known kind, which SciPy looks up beyond the end of a table."""
    path = tmp_path / "a.mat"
    savemat(path, {"nees": np.ones((3, 30)), "dof": 3.0})
    data, of_doubles = path.read_bytes(), np.array([9, 720], np.uint32).tobytes()
    assert data.count(of_doubles) == 1
    path.write_bytes(data.replace(of_doubles, np.array([kind, 720], np.uint32).tobytes()))
    with pytest.raises(ValueError, match=r"a\.mat: cannot be read \(.*\); expected a mat file"):
        evaluate_log(path)
