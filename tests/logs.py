"""Logs of filters that tests make up: errors and poses with the covariances that are theirs, and
every format in which they are written."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import verdicts as benchmark
from bags import EPOCH, KINDS, ros_of, write_bag
from cases import quick_jit
from scipy import stats
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam.evaluation import (
    Convention,
    Evaluation,
    evaluate_log,
    evaluate_nees,
    evaluate_poses,
    write_covariances,
)  # fmt: skip
from jaxslam.evaluation.convention import MIXED
from jaxslam.geometry import SPATIAL
from jaxslam.io.tum import quaternions, write_tum

FALSE_ALARM = 1e-4


def drawn(runs=60, steps=7, n=3, factor=1.0, seed=0):
    """Errors, `factor` times as large as the covariances say, correlated axes."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(runs, steps, n, n)) + 2 * np.eye(n)
    noise = factor * rng.normal(size=(runs, steps, n, 1))
    return (root @ noise)[..., 0], root @ np.swapaxes(root, -1, -2)


@cache
def exponential(geometry):
    """Of tangents (k, t) the matrices, compiled."""
    return quick_jit(jax.vmap(lambda x: geometry.group.exp(x).as_matrix()))


def some(geometry, shape, seed=0, spread=1.0):
    """Poses (…, d, d)."""
    rng = np.random.default_rng(seed)
    size = int(np.prod(shape))
    T = exponential(geometry)(spread * rng.normal(size=(size, geometry.tangent_dim)))
    return np.asarray(T).reshape(*shape, *T.shape[1:])


def covariance(t, seed=0, size=0.05):
    root = np.diag(size * 10 ** np.linspace(-1, 0, t)) @ (
        np.eye(t) + 0.3 * np.random.default_rng(seed).normal(size=(t, t))
    )
    return root @ root.T


def logged(convention, geometry=SPATIAL, runs=40, steps=6, seed=0, spread=1.0, factor=1.0):
    """Poses, covariances and truths whose errors in the convention are drawn from them."""
    T, t = some(geometry, (runs, steps), seed, spread), geometry.tangent_dim
    P = np.broadcast_to(covariance(t), (runs, steps, t, t))
    noise = np.random.default_rng(seed + 1).normal(size=(runs, steps, t))
    errors = factor * noise @ np.linalg.cholesky(covariance(t)).T
    return T, P, benchmark.displaced(T, errors, convention)


def consistent(nees, dof):
    """Whether a sum of independent NEES is χ², up to a false alarm in 10 000."""
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], nees.size * dof)
    return low < nees.sum() < high


def planar(runs=50, steps=12, factor=1.0, other=1e-6, vertical=2, seed=0):
    """A robot in a plane as people write it in six axes, and its NEES in three; errors split."""
    rng = np.random.default_rng(seed)
    flat = [axis for axis in range(3) if axis != vertical]
    used = [*flat, 3 + vertical]
    root = np.diag([0.05, 0.03, 0.01]) @ np.array([[1, 0, 0], [0.3, 1, 0], [0.4, -0.3, 1]])
    e = np.zeros((runs, steps, 6))
    e[..., used] = rng.normal(size=(runs, steps, 3)) @ root.T
    P = other * np.eye(6)
    P[np.ix_(used, used)] = factor**2 * root @ root.T
    angle = np.zeros((runs * steps, 3))
    angle[:, vertical] = np.tile(np.linspace(0, 3, steps), runs)
    T = np.tile(np.eye(4), (runs, steps, 1, 1))
    T[..., :3, :3] = Rotation.from_rotvec(angle).as_matrix().reshape(runs, steps, 3, 3)
    T[..., flat, 3] = 5 * np.stack([np.sin(angle[:steps, vertical]), np.linspace(0, 1, steps)], 1)
    truth = benchmark.displaced(T, e, Convention("split"))
    inverse = np.linalg.inv(P[np.ix_(used, used)])
    nees = np.einsum("rki,ij,rkj->rk", e[..., used], inverse, e[..., used])
    return T, np.broadcast_to(P, (runs, steps, 6, 6)), truth, nees


def write_runs(folder, T, P, truth, convention):
    """A sub-folder of files for every run."""
    times = np.arange(T.shape[1]) / 10
    for run in range(len(T)):
        own = folder / f"run{run:02}"
        own.mkdir(parents=True)
        write_tum(own / "estimate.txt", times, T[run])
        write_covariances(own / "covariance.txt", times, P[run], convention)
        write_tum(own / "truth.txt", times + 0.004, truth[run])


def one_run(folder, steps=40, offset=0.0, shown=None):
    """Files of one run of ten poses a second; the truth is later, and times are as they are shown
    in the files that are named."""
    T, P, truth = (x[0] for x in logged(Convention(), runs=1, steps=steps))
    folder.mkdir(parents=True, exist_ok=True)
    times = 1.4e9 + np.arange(steps) / 10
    write_tum(folder / "estimate.txt", times, T)
    write_covariances(folder / "covariance.txt", times, P, Convention())
    write_tum(folder / "truth.txt", times + offset, truth)
    for name, of in (shown or {}).items():
        rows = [line.split(maxsplit=1) for line in (folder / name).read_text().splitlines()[1:]]
        (folder / name).write_text("".join(f"{of(float(t))} {rest}\n" for t, rest in rows))
    return folder


TRACKED = Convention("split", "body", scale="given")
UNFIXED, FIXED, LOST = ("tracked", 0, 1.5), ("tracked", 1, 1.0), ("lost", 1, 4.0)
"""State, unit_fixed, and the length of the unit in which the pose is written."""


def tracked_run(folder, maps):
    """Files of a folder as the tracker writes them: of each map its frames. Poses and truths."""
    told = [(number, *frame) for number, frames in enumerate(maps) for frame in frames]
    T, P, truth = (x[0].copy() for x in logged(TRACKED, runs=1, steps=len(told), spread=0.5))
    T[0], truth[0], P[0] = np.eye(4), np.eye(4), 0  # known exactly
    truth[:, :3, 3] *= np.array([unit for *_, unit in told])[:, None]
    times = np.arange(len(told)) / 30
    write_tum(folder / "trajectory.txt", times, T)
    write_covariances(folder / "covariance.txt", times, P, TRACKED)
    write_tum(folder / "groundtruth.txt", times, truth)
    rows = [
        f"{i},{times[i]:.9f},{state},{number},9,1.5,18,0.1,,,{fixed},"
        f"{'few agree' if state == 'lost' else ''},0,0,"
        for i, (number, state, fixed, _) in enumerate(told)
    ]
    header = "frame,time,state,map,matches,nis,nis_dof,sigma_position,log_scale,more,unit_fixed"
    header += ",reason,relocalised,submap,loop"  # the last ones empty, or words with spaces
    (folder / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    return T[None], P[None], truth[None]


# --- formats -----------------------------------------------------------------------------------

STEPS = 24
TIMES = EPOCH + np.arange(STEPS) / 10
UPPER, UPPER3, UPPER4 = (np.triu_indices(n) for n in (6, 3, 4))
RNG = np.random.default_rng(0)
HEADER = "# error=split axes=mixed\n"


def in_space():
    """Estimates, covariances (split, mixed; σ differ by axis, and correlate), truths."""
    truth = np.tile(np.eye(4), (STEPS, 1, 1))
    turned = np.outer(np.arange(STEPS), [0.1, 0.2, -0.05])
    truth[:, :3, :3] = Rotation.from_rotvec(turned).as_matrix()
    truth[:, 0, 3] = np.arange(STEPS)
    root = 0.2 * np.diag([0.1, 0.3, 0.05, 0.01, 0.03, 0.02])
    root[:3, :3] @= np.eye(3) + 0.3 * RNG.normal(size=(3, 3))
    root[3:, 3:] @= np.eye(3) + 0.3 * RNG.normal(size=(3, 3))
    noise = RNG.normal(size=(STEPS, 6)) @ root.T
    estimate = truth.copy()
    estimate[:, :3, 3] -= noise[:, :3]
    turn = Rotation.from_rotvec(-noise[:, 3:]).as_matrix()
    estimate[:, :3, :3] = truth[:, :3, :3] @ turn
    return estimate, np.tile(root @ root.T, (STEPS, 1, 1)), truth


ESTIMATE, P, TRUTH = in_space()
SIGMA = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
R = ESTIMATE[:, :3, :3]
FLAT_TRUTH = np.column_stack([np.arange(STEPS), np.zeros(STEPS), 0.1 * np.arange(STEPS)])
FLAT_SIGMA = np.tile([0.2, 0.1, 0.03], (STEPS, 1))
FLAT = FLAT_TRUTH - FLAT_SIGMA * RNG.normal(size=(STEPS, 3))
FLAT_P = FLAT_SIGMA[:, :, None] * np.eye(3) * FLAT_SIGMA[:, None]
RUNS = (4, 5)
ERRORS = RNG.normal(size=(*RUNS, 4)) @ np.linalg.cholesky(np.eye(4) + 0.5)
COVARIANCES = np.tile(np.eye(4) + 0.5, (*RUNS, 1, 1))
PLACES = np.argwhere(np.ones(RUNS))


def of_sigmas(sigma):
    return sigma[..., None] * np.eye(sigma.shape[-1]) * sigma[..., None, :]


def right(cov):
    """The covariance (split, mixed) of positions and rotations that are independent as right."""
    result = cov.copy()
    result[:, :3, :3] = np.swapaxes(R, 1, 2) @ cov[:, :3, :3] @ R
    return result


def right_rotation_first(cov):
    """The same as GTSAM has it, rotation first."""
    return np.roll(right(cov), 3, axis=(1, 2))


def in_the_world(cov):
    """The covariance (split, mixed) as ROS has it: about the axes of the world."""
    A = np.tile(np.eye(6), (STEPS, 1, 1))
    A[:, 3:, 3:] = R
    return A @ cov @ np.swapaxes(A, 1, 2)


MIXED_BLOCKS = P[:, 3:, 3:][:, *UPPER3], P[:, :3, :3][:, *UPPER3]
SPLIT = Convention("split", "world")
IN_SPACE, OF_SIGMAS = (
    partial(evaluate_poses, ESTIMATE[None], cov[None], TRUTH[None], Convention(**MIXED))
    for cov in (P, of_sigmas(SIGMA))
)
IN_THE_PLANE = partial(evaluate_poses, FLAT[None], FLAT_P[None], FLAT_TRUTH[None], SPLIT)
OF_ERRORS = partial(jaxslam.evaluate, ERRORS, COVARIANCES)
DEVIATIONS = np.sqrt(np.diagonal(COVARIANCES, axis1=2, axis2=3))


def lines(path, *columns, header="", between=" "):
    rows = np.column_stack([np.asarray(x, float).reshape(len(columns[0]), -1) for x in columns])
    text = "\n".join(between.join(f"{x:.17g}" for x in row) for row in rows)
    path.write_text(f"{header}{text}\n")
    return path


def tum(folder, estimate="estimate.txt", covariance="covariance.txt", truth="truth.txt"):
    write_tum(folder / estimate, TIMES, ESTIMATE)
    write_covariances(folder / covariance, TIMES, P, Convention(**MIXED))
    write_tum(folder / truth, TIMES, TRUTH)


def tum_and(values, header=HEADER):
    def write(folder):
        tum(folder)
        lines(folder / "covariance.txt", TIMES, values, header=header)

    return write


def states(cameras, imu=(0, 0)):
    """OpenVINS's `t q p v bg ba dt cameras …`, and so many numbers and σ of the `imu`."""

    def write(folder):
        more = np.zeros((STEPS, 9 + 1 + 1 + 15 * cameras + imu[0]))
        more[:, 10] = cameras
        header = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot ...\n"
        for name, T in (("estimate", ESTIMATE), ("groundtruth", TRUTH)):
            state = TIMES, quaternions(T[:, :3, :3]), T[:, :3, 3], more
            lines(folder / f"state_{name}.txt", *state, header=header)
        spread = np.zeros((STEPS, 9 + 1 + 1 + 14 * cameras + imu[1]))
        spread[:, 10] = cameras
        sigma = SIGMA[:, 3:], SIGMA[:, :3], spread
        lines(folder / "state_deviation.txt", TIMES, *sigma, header="# timestamp(s) q p v …\n")

    return write


def poses_with_covariances(folder):
    """OpenVINS's `pose_to_file`."""
    write_tum(folder / "truth.txt", TIMES, TRUTH)
    lines(folder / "estimate.txt", TIMES, ESTIMATE[:, :3, 3], quaternions(R), *MIXED_BLOCKS)


def kitti(timed):
    """Times are beside the poses, or are the numbers of their lines."""

    def write(folder):
        times = TIMES - TIMES[0] if timed else np.arange(STEPS)
        if timed:
            lines(folder / "times.txt", times)
        lines(folder / "estimate.txt", ESTIMATE[:, :3])
        lines(folder / "truth.txt", TRUTH[:, :3])
        lines(folder / "covariance.txt", times, P[:, *UPPER], header=HEADER)

    return write


def matrices(columns):
    """A time and all of T_wc, by rows or by columns; covariances by their stamps."""

    def write(folder):
        tum(folder)
        for name, T in (("estimate", ESTIMATE), ("truth", TRUTH)):
            lines(folder / f"{name}.txt", TIMES, np.swapaxes(T, 1, 2) if columns else T)

    return write


def of_planes(values):
    def write(folder):
        lines(folder / "estimate.txt", TIMES, FLAT)
        lines(folder / "truth.txt", TIMES, FLAT_TRUTH)
        lines(folder / "covariance.txt", TIMES, values, header="# error=split axes=world\n")

    return write


def columns(T):
    """The numbers of TUM's lines, by their titles."""
    numbers = TIMES, *T[:, :3, 3].T, *quaternions(T[:, :3, :3]).T
    return dict(zip(("t", "x", "y", "z", "qx", "qy", "qz", "qw"), numbers, strict=True))


def rewritten(line, encoding="utf-8", title=None):
    """TUM's files, each line of numbers as `line` makes it of its place and its words; before the
    first one what `title` makes of the count of its words."""

    def write(folder):
        tum(folder)
        for path in folder.iterdir():
            told, *rows = path.read_text().splitlines()
            words = [row.split() for row in rows]
            above = [] if title is None else [title(len(words[0]))]
            written = (line(i, row) for i, row in enumerate(words))
            path.write_text("\n".join([told, *above, *written]) + "\n", encoding=encoding)

    return write


def trajectories(titles, said="", between=",", nanoseconds=False, ending="csv"):
    """Estimate and truth with these of TUM's columns, or numbers, and a line above them."""

    def write(folder):
        tum(folder)
        for name, T in (("estimate", ESTIMATE), ("truth", TRUTH)):
            (folder / f"{name}.txt").unlink()
            held = columns(T)
            held["t"] = 1e9 * TIMES if nanoseconds else TIMES
            told = (held.get(x, np.full(STEPS, 0.25)) for x in titles.split())
            lines(folder / f"{name}.{ending}", *told, header=said, between=between)

    return write


def titled(titles, *columns, between=","):
    """One file with covariances, and the truth; titles with a number in braces stand for 36."""
    told = ",".join(
        ",".join(x.format(i) for i in range(36 if "{" in x else 1)) for x in titles.split()
    )

    def write(folder):
        write_tum(folder / "truth.txt", TIMES, TRUTH)
        lines(
            folder / "estimate.csv", *columns, header=f"{told}\n" if told else "", between=between
        )

    return write


def dated(i, row):
    """A line whose time is a date."""
    date = datetime.fromtimestamp(float(row[0]), UTC)
    forms = (
        "%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%fZ", "%Y%m%dT%H%M%S.%f",
        "%Y/%m/%d_%H-%M-%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%d-%b-%Y %H:%M:%S.%f",
    )  # fmt: skip
    return " ".join([date.strftime(forms[i % len(forms)]), *row[1:]])


def in_weeks(_, row):
    """A line whose time is a week of GPS and its seconds."""
    week, seconds = divmod(float(row[0]) - 315964800, 604800)
    return " ".join([f"{week:.0f} {seconds:.6f}", *row[1:]])


def in_days(_, row):
    """A line whose time is a datenum of MATLAB."""
    return " ".join([f"{float(row[0]) / 86400 + 719529:.12f}", *row[1:]])


def of_cnspy(kind, blocks):
    """One file with the kind of its errors in every line, and the truth."""

    def write(folder):
        pairs = ("xx", "xy", "xz", "yy", "yz", "zz"), ("rr", "rp", "ry", "pp", "py", "yy")
        axes = ",".join([f"p{x}" for x in pairs[0]] + [f"q{x}" for x in pairs[1]])
        told = np.column_stack([*columns(ESTIMATE).values(), *(x[:, *UPPER3] for x in blocks)])
        rows = [",".join([kind, *(f"{x:.17g}" for x in row)]) for row in told]
        titles = f"est_err_type,t,tx,ty,tz,qx,qy,qz,qw,{axes}"
        (folder / "estimate.csv").write_text("\n".join([titles, *rows]) + "\n")
        write_tum(folder / "truth.txt", TIMES, TRUTH)

    return write


def square(folder):
    """SQUARE's headers, poses and lower triangles; of errors along the body, rotation first."""
    write_tum(folder / "reference.tum", TIMES, TRUTH)
    headers = {
        "FORMAT": "SQUARE/0.3", "TIMESTAMP_UNIT": "milliseconds",
        "TANGENT_CONVENTION": "right_perturbation", "TANGENT_ORDER": "rotation_translation",
    }  # fmt: skip
    above = "".join(f"#%{key} {value}\n" for key, value in headers.items())
    _, *pose = columns(ESTIMATE).values()
    lower = right_rotation_first(P)[:, *np.tril_indices(6)]
    lines(folder / "estimate.smfeval", 1e3 * TIMES, *pose, lower, header=above)


ENU_SIGMA = np.array([0.3, 0.2, 0.5])
ENU_CORRELATION = np.array([[1, 0.4, -0.2], [0.4, 1, 0.3], [-0.2, 0.3, 1]])
ENU_P = ENU_CORRELATION * np.outer(ENU_SIGMA, ENU_SIGMA)
ENU_ERRORS = RNG.normal(size=(STEPS, 3)) @ np.linalg.cholesky(ENU_P).T


def rtklib(folder, name, titles, numbers, spread):
    """A solution of RTKLIB with dates of UTC, between commas."""
    dates = [datetime.fromtimestamp(1.6e9 + i, UTC) for i in range(STEPS)]
    zero = np.zeros((STEPS, 2))
    rows = np.column_stack([numbers, zero, np.tile(spread, (STEPS, 1)), zero])
    told = [f"{x:%Y/%m/%d %H:%M:%S.000},{','.join(map(repr, row))}" for x, row in
            zip(dates, rows.tolist(), strict=True)]  # fmt: skip
    (folder / name).write_text("\n".join([f"%  UTC,{titles},Q,ns,age(s),ratio", *told]) + "\n")


def from_base(titles):
    """RTKLIB's positions along such axes, and their truth."""

    def write(folder):
        truth = np.column_stack([np.linspace(0, 50, STEPS), *np.full((2, STEPS), 5e6)])
        places = [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)]
        roots = [np.sign(ENU_P[x]) * np.sqrt(abs(ENU_P[x])) for x in places]
        rtklib(folder, "estimate.pos", titles, truth - ENU_ERRORS, roots)
        rtklib(folder, "truth.pos", titles, truth, roots)

    return write


def on_earth(folder, utc=False, fixes=""):
    """RTKLIB's solution at 22° south, or NavSatFix of ROS, echoed or under titles; and NovAtel's
    truth in degrees, minutes and seconds."""
    seconds = 455342.0 + np.arange(STEPS)
    zero = np.zeros(STEPS)
    latitude, longitude, height = -22.3 - 1e-4 * np.arange(STEPS), zero + 114.2, zero + 5
    square, of_pole = 0.00669437999014, np.sin(np.radians(latitude)) ** 2
    across = 6378137.0 / np.sqrt(1 - square * of_pole)
    along = across * (1 - square) / (1 - square * of_pole)
    east, north, up = -ENU_ERRORS.T
    own = [
        latitude + np.degrees(north / (along + height)),
        longitude + np.degrees(east / (across + height) / np.cos(np.radians(latitude))),
        height + up,
    ]
    order = [(1, 1), (0, 0), (2, 2), (0, 1), (0, 2), (1, 2)]
    roots = [np.sign(ENU_P[x]) * np.sqrt(abs(ENU_P[x])) + zero for x in order]
    titles = "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m)"
    week = zero + 2158
    if fixes:
        stamps = 315964800 + 604800 * week + seconds, zero
        cov = np.tile(ENU_P.ravel(), (STEPS, 1))
        rows = np.column_stack([*stamps, zero, zero, *own, cov, zero]).tolist()
        told = [",".join([*map(repr, x[:2]), "gps", *map(repr, x[2:])]) for x in rows]
        (folder / "estimate.pos").write_text(fixes.strip() + "\n" + "\n".join(told) + "\n")
    elif utc:
        week, seconds = zero + 2123, 1.6e9 + 18 - 315964800 - 2123 * 604800 + np.arange(STEPS)
        told = titles.partition(" Q")[0].replace(" ", ",")
        rtklib(folder, "estimate.pos", told, np.column_stack(own), [x[0] for x in roots])
    else:
        lines(
            folder / "estimate.pos",
            *(week, seconds, *own, zero, zero, *roots),
            header=f"% program : RTKPOST\n% GPST {titles} sdun(m)\n",
        )
    parts = []
    for angle in (latitude, longitude):
        whole, minutes = np.trunc(angle), 60 * np.abs(angle - np.trunc(angle))
        parts += [whole, np.trunc(minutes), 60 * (minutes - np.trunc(minutes))]
    titles = "UTCTime Week GPSTime Latitude Longitude H-Ell\n"
    lines(folder / "truth.txt", seconds, week, seconds, *parts, height, header=titles)


def echoed(folder):
    """What `ros2 topic echo --csv` prints of poses with covariances."""
    write_tum(folder / "truth.txt", TIMES, TRUTH)
    stamps = zip(TIMES // 1, np.round(1e9 * (TIMES % 1)), strict=True)
    numbers = np.hstack([ESTIMATE[:, :3, 3], quaternions(R), in_the_world(P).reshape(-1, 36)])
    rows = [
        f"{s:.0f},{ns:.0f},map,{','.join(map(repr, row))}"
        for (s, ns), row in zip(stamps, numbers.tolist(), strict=True)
    ]
    (folder / "estimate.csv").write_text("\n".join(rows) + "\n")


def nclt(folder, degrees=False, angles_first=False):
    """Microseconds, positions, and roll, pitch and yaw; FAST-LIO has these first."""
    tum(folder)
    for name, T in (("estimate", ESTIMATE), ("truth", TRUTH)):
        (folder / f"{name}.txt").unlink()
        angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=degrees)
        parts = (T[:, :3, 3], angles)[:: -1 if angles_first else 1]
        lines(folder / f"{name}.csv", np.round(1e6 * TIMES), *parts, between=",")


def in_degrees(*names, graph=False):
    """Robots in a plane, without titles or of g2o; angles of these files are in degrees."""

    def write(folder):
        spread = lines(folder / "covariance.txt", TIMES, FLAT_SIGMA, header="# error=split\n")
        for name, flat in (("estimate", FLAT), ("truth", FLAT_TRUTH)):
            rows = np.column_stack([TIMES, flat])
            rows[:, 3] *= 180 / np.pi if name in names else 1.0
            if graph:
                rows[:, 0] = np.arange(STEPS)
                told = "".join(
                    f"VERTEX_SE2 {i:.0f} {x!r} {y!r} {a!r}\n" for i, x, y, a in rows.tolist()
                )
                (folder / f"{name}.g2o").write_text(told)
                lines(spread, rows[:, 0], FLAT_SIGMA, header="# error=split\n")
            else:
                lines(folder / f"{name}.txt", rows)

    return write


def graph(folder):
    """Vertices of g2o, in any order, among other lines."""
    tum(folder)
    for name, T in (("estimate", ESTIMATE), ("truth", TRUTH)):
        (folder / f"{name}.txt").unlink()
        _, *pose = columns(T).values()
        rows = [" ".join(f"{x:.17g}" for x in row) for row in np.column_stack(pose)]
        vertices = [f"VERTEX_SE3:QUAT {i} {row}" for i, row in enumerate(rows)]
        told = ["FIX 0", "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1", *vertices[9:], *vertices[:9]]
        (folder / f"{name}.g2o").write_text("\n".join(told) + "\n")
    upper = P[:, *UPPER]
    lines(folder / "covariance.txt", np.arange(STEPS), upper, header=HEADER)


OTHER = TRUTH @ np.linalg.inv(ESTIMATE) @ TRUTH


def two_beside_one_truth(folder):
    """Runs that are files of their own covariances, of one flight."""
    write_tum(folder / "ref.txt", TIMES, TRUTH)
    for name, T in (("a", ESTIMATE), ("b", OTHER)):
        pose = T[:, :3, 3], quaternions(T[:, :3, :3])
        lines(folder / f"{name}.txt", TIMES, *pose, *MIXED_BLOCKS)


def mat(**arrays: Any):
    return lambda folder: savemat(folder / "runs.mat", arrays)


def npz(**arrays: Any):
    def write(folder):
        np.savez(folder / "runs.npz", **arrays)

    return write


def csv(*columns, header="", between=","):
    def write(folder):
        lines(folder / "runs.csv", *columns, header=header, between=between)

    return write


def bag(name, estimate="odometry", truth="pose_stamped"):
    """The estimate among other topics, in messages of these kinds."""

    def write(folder):
        r, covariances = ros_of(name), in_the_world(P)
        told = [getattr(r, estimate)(*x) for x in zip(TIMES, ESTIMATE, covariances, strict=True)]
        if truth == "path":  # published as it grows: the last one is the whole
            true = {"/mocap": [r.path(TIMES[:n], TRUTH[:n]) for n in (1, 10, STEPS)]}
        elif truth == "transforms":
            true = joined(r)
        else:
            zero = [np.zeros((6, 6))] * (truth not in ("pose_stamped", "transform_stamped"))
            told_true = zip(TIMES, TRUTH, strict=True)
            true = {"/mocap": [getattr(r, truth)(*x, *zero) for x in told_true]}
        write_bag(folder / name, {"/filter/pose": told, **true})

    return write


def joined(r):
    """The truth as transforms of a tree: a body that moves, and where on it the sensor is fixed."""
    fixed = np.linalg.inv(TRUTH[3])
    moving = [r.transform_stamped(t, T @ fixed) for t, T in zip(TIMES, TRUTH, strict=True)]
    sensor = r.transform_stamped(0.0, TRUTH[3], "base_link", "imu")
    return {"/tf": [r.transforms(x) for x in moving], "/tf_static": [r.transforms(sensor)]}


class Log(NamedTuple):
    """How a log is written into a folder, and the verdict of its arrays."""

    write: Callable[[Path], object]
    wanted: Callable[[], Evaluation] = IN_SPACE
    source: str = ""
    beside: Mapping[str, str] = {}
    """Files and topics (/…) that are named with it."""
    rtol: float = 1e-4
    convention: Convention | None = None
    """Where it is not that of the arrays."""
    spare: bool = False
    """Whether the last numbers of lines are not read."""

    def evaluated(self, folder: Path, *_) -> Evaluation:
        options: dict[str, Any] = {
            name: value if value.startswith("/") else str(folder / value)
            for name, value in self.beside.items()
        }
        return evaluate_log(folder / self.source, **options)


def npz_log(wanted, **arrays: Any):
    return Log(npz(**arrays), wanted, "runs.npz")


def csv_log(wanted, *columns, header="", between=","):
    return Log(csv(*columns, header=header, between=between), wanted, "runs.csv")


def of_n(n, header=""):
    """A table of errors of n axes, and of the upper triangles of their covariances."""
    rng = np.random.default_rng(n)
    root = rng.normal(size=(*RUNS, n, n)) + 2 * np.eye(n)
    e, cov = rng.normal(size=(*RUNS, n)), root @ np.swapaxes(root, -1, -2)
    triangles = cov[..., *np.triu_indices(n)].reshape(len(PLACES), -1)
    names = [f"e{i}" for i in range(n)] if header else ()
    wanted = partial(jaxslam.evaluate, e, cov, names=names)
    return csv_log(wanted, PLACES, e.reshape(len(PLACES), -1), triangles, header=header)


def of_bag(name, *kinds, topic="/mocap", **truth):
    topics = {"estimate": "/filter/pose", "truth": topic}
    write = bag(name, *kinds, **truth)
    return Log(write, source=name, beside=topics, rtol=1e-9, convention=SPLIT)


FLAT_ERRORS = ERRORS.reshape(-1, 4)
TRIANGLES = COVARIANCES[..., *UPPER4].reshape(-1, 10)
NAMED = "run,step,e0,e1,P0,P1,P2\n"
SIGMAS_NAMED = "run,step,a,b,c,d,sigma_a,sigma_b,sigma_c,sigma_d\n"
ONE_RUN = "step,a,b,c,d,aa,ab,ac,ad,bb,bc,bd,cc,cd,dd\n"
NEES = RNG.chisquare(4, RUNS)
NEES_ALONE = NEES.reshape(-1, 1), np.full(NEES.size, 4)
OF_DEVIATIONS = partial(jaxslam.evaluate, ERRORS, of_sigmas(DEVIATIONS))
OF_ENU = partial(jaxslam.evaluate, ENU_ERRORS[None], np.tile(ENU_P, (1, STEPS, 1, 1)), names="xyz")
OF_ONE = partial(jaxslam.evaluate, ERRORS[:1], COVARIANCES[:1])
NEES_OF, NIS_OF = (partial(evaluate_nees, NEES, 4, quantity=x) for x in ("NEES", "NIS"))
MARGINALS: dict[str, Any] = {
    "estimates": ESTIMATE[None], "covariances": right_rotation_first(P)[None],
    "truths": TRUTH[None], "error": "right", "order": "rotation-first",
}  # fmt: skip
POSES: dict[str, Any] = {**MARGINALS, "covariances": P[None], **MIXED}
POSES["order"] = "position-first"
LOGS = {
    "TUM": Log(tum),
    "TUM, of the tracker": Log(lambda x: tum(x, "trajectory.txt", truth="groundtruth.txt")),
    "TUM, named by options": Log(
        lambda x: tum(x, "mine.csv", "sigma.txt", "mocap.csv"), source="mine.csv",
        beside={"covariance": "sigma.txt", "truth": "mocap.csv"},
    ),
    "TUM, all of a covariance": Log(tum_and(P)),
    "TUM, σ": Log(tum_and(SIGMA), OF_SIGMAS),
    **{f"states of OpenVINS, {n} cameras": Log(states(n), OF_SIGMAS) for n in (1, 2)},
    "poses of OpenVINS": Log(poses_with_covariances),
    "states of OpenVINS with an IMU's intrinsics": Log(states(1, imu=(30, 28)), OF_SIGMAS),
    **{
        f"TUM, {encoding}": Log(rewritten(lambda _, row: " ".join(row), encoding))
        for encoding in ("utf-8-sig", "utf-16")
    },
    "TUM, decimal commas": Log(rewritten(lambda _, row: ";".join(row).replace(".", ","))),
    "TUM, tabs": Log(rewritten(lambda _, row: "\t".join(row))),
    "TUM, quotes": Log(rewritten(lambda _, row: ",".join(f'"{x}"' for x in row))),
    "TUM, a comma at the end": Log(rewritten(lambda _, row: ",".join(row) + ",")),
    "TUM, an index of pandas": Log(rewritten(
        lambda i, row: ",".join([str(i), *row]),
        title=lambda count: "".join(f",{i}" for i in "abcdefghijklmnopqrstuv"[:count]),
    )),
    "TUM, w first and nanoseconds": Log(trajectories("t x y z qw qx qy qz", nanoseconds=True)),
    "titles in another order": Log(trajectories(
        "qw qz qx qy z status y x t",
        "q_w,q_z,q_x,q_y,pos_z [m],status,pos_y [m],pos_x [m],timestamp [s]\n",
    )),
    "titles of a rotation, with w": Log(
        trajectories("t qw qx qy qz x y z", "t,rw,rx,ry,rz,tx,ty,tz\n")),
    "titles of ROS' CSV": Log(trajectories(
        "seq x y z qx qy qz qw t",
        "%seq,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,"
        "field.pose.orientation.w,field.header.stamp\n", nanoseconds=True,
    )),
    "titles of EuRoC": Log(trajectories(
        "t x y z qw qx qy qz v v v",
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
        "q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]\n",
        nanoseconds=True,
    ), spare=True),
    "w first, 17 numbers": Log(
        trajectories("t x y z qw qx qy qz" + 9 * " v", between=" "), spare=True),
    "TUM, dates": Log(rewritten(dated)),
    "TUM, weeks of GPS": Log(rewritten(in_weeks)),
    "datenum of MATLAB": Log(rewritten(in_days)),
    "TUM, nanoseconds of ORB-SLAM3": Log(
        trajectories("t x y z qx qy qz qw", between=" ", nanoseconds=True, ending="txt")),
    "TUM, variances by titles": Log(tum_and(
        SIGMA[:, ::-1] ** 2, "# t var_rz var_ry var_rx pos_var_z pos_var_y pos_var_x\n"
    ), OF_SIGMAS),
    "TUM and a triangle": Log(
        titled("", TIMES, ESTIMATE[:, :3, 3], quaternions(R), right(P)[:, *UPPER], between=" "),
        rtol=0.02, convention=Convention("right"),
    ),
    "titles of ROS' CSV with covariances": Log(titled(
        "%time field.header.stamp field.pose.pose.position.x field.pose.pose.position.y "
        "field.pose.pose.position.z field.pose.pose.orientation.x field.pose.pose.orientation.y "
        "field.pose.pose.orientation.z field.pose.pose.orientation.w field.pose.covariance{} "
        "field.twist.twist.linear.x field.twist.covariance{}",
        1e9 * (TIMES + 0.03), 1e9 * TIMES, ESTIMATE[:, :3, 3], quaternions(R), in_the_world(P),
        np.ones((STEPS, 37)),
    ), convention=SPLIT, spare=True),
    "titles of PlotJuggler and ROS 2": Log(titled(
        "/o/header/stamp/sec /o/header/stamp/nanosec /o/pose/pose/position/x "
        "/o/pose/pose/position/y /o/pose/pose/position/z /o/pose/pose/orientation/w "
        "/o/pose/pose/orientation/x /o/pose/pose/orientation/y /o/pose/pose/orientation/z "
        + " ".join(f"/o/pose/covariance[{i};{j}]" for i, j in zip(*UPPER, strict=True)),
        TIMES // 1, 1e9 * (TIMES % 1), ESTIMATE[:, :3, 3], np.roll(quaternions(R), 1, axis=1),
        in_the_world(P)[:, *UPPER],
    ), convention=SPLIT),
    "titles of angles in degrees, and σ": Log(titled(
        "time pos_x pos_y pos_z roll_deg pitch_deg yaw_deg rot_std_x rot_std_y rot_std_z "
        "std_pos_x std_pos_y std_pos_z",
        TIMES, ESTIMATE[:, :3, 3],
        Rotation.from_matrix(R).as_euler("ZYX", degrees=True)[:, ::-1], SIGMA[:, 3:], SIGMA[:, :3],
    ), OF_SIGMAS),
    "titles in a plane, with a covariance": Log(lambda x: (
        lines(x / "truth.txt", TIMES, FLAT_TRUTH),
        lines(x / "estimate.csv", TIMES, FLAT, FLAT_P[:, *UPPER3],
              header="t,x,y,yaw,pxx,pxy,pxh,pyy,pyh,phh\n", between=","),
    ), IN_THE_PLANE),
    "cnspy, split": Log(of_cnspy("type5", (P[:, :3, :3], P[:, 3:, 3:]))),
    # To the first order of the errors.
    "cnspy, right": Log(
        of_cnspy("type1", (right_rotation_first(P)[:, 3:, 3:], right_rotation_first(P)[:, :3, :3])),
        rtol=0.02, convention=Convention("right"),
    ),
    "SQUARE": Log(square, rtol=0.02, convention=Convention("right", order="rotation-first")),
    "RTKLIB and NovAtel": Log(on_earth, OF_ENU, convention=Convention("split", "body")),
    "RTKLIB in UTC and NovAtel": Log(lambda x: on_earth(x, utc=True), OF_ENU, rtol=2e-3,
                                     convention=Convention("split", "body"), spare=True),
    **{
        f"NavSatFix, {name}": Log(partial(on_earth, fixes=titles), OF_ENU, rtol=1e-3,
                                  convention=Convention("split", "body"), spare=True)
        for name, titles in (("echo of ROS 2", " "), ("titles", (
            "header.stamp.secs,header.stamp.nsecs,header.frame_id,status.status,status.service,"
            "latitude,longitude,altitude,"
            + "".join(f"position_covariance_{i}," for i in range(9)) + "position_covariance_type"
        )))
    },
    "RTKLIB, ECEF": Log(from_base(
        "x-ecef(m),y-ecef(m),z-ecef(m)"), OF_ENU, convention=SPLIT, spare=True),
    "RTKLIB, from its base": Log(from_base(
        "e-baseline(m),n-baseline(m),u-baseline(m)"), OF_ENU, convention=SPLIT, spare=True),
    "g2o": Log(graph),
    "NCLT": Log(nclt),
    "NCLT in degrees": Log(partial(nclt, degrees=True)),
    "FAST-LIO": Log(partial(nclt, angles_first=True)),
    "titles of deviations": Log(titled(
        "t x y z qx qy qz qw x_sig sigY z_sd unc_rx ry_std dev_rz", TIMES, ESTIMATE[:, :3, 3],
        quaternions(R), SIGMA,
    ), OF_SIGMAS),
    "titles of an information matrix": Log(titled(
        "t x y z qx qy qz qw inf_{}", TIMES, ESTIMATE[:, :3, 3], quaternions(R), np.linalg.inv(P)
    )),
    **{
        f"plane, degrees in {' and '.join(names)}": Log(in_degrees(*names), IN_THE_PLANE)
        for names in (("estimate",), ("truth",), ("estimate", "truth"))
    },
    "g2o in a plane, degrees": Log(in_degrees("estimate", "truth", graph=True), IN_THE_PLANE),
    "TUM, names of rpg_trajectory_evaluation": Log(
        lambda x: tum(x, "stamped_traj_estimate.txt", truth="stamped_groundtruth.txt")),
    "TUM, seconds and nanoseconds": Log(rewritten(
        lambda _, row: " ".join([*row[0].split("."), *row[1:]]) if len(row) == 8 else " ".join(row)
    )),
    "echo of ROS 2": Log(echoed, convention=SPLIT),
    "titles of PX4": Log(titled(
        "timestamp timestamp_sample position[0] position[1] position[2] q[0] q[1] q[2] q[3] "
        + " ".join(f"{x}_variance[{i}]" for x in ("position", "orientation") for i in range(3)),
        1e6 * (TIMES + 0.2), 1e6 * TIMES, ESTIMATE[:, :3, 3], np.roll(quaternions(R), 1, axis=1),
        SIGMA**2,
    ), OF_SIGMAS),
    "TUM, column by column": Log(tum_and(P[:, *np.tril_indices(6)])),
    "runs beside one truth": Log(two_beside_one_truth, partial(
        evaluate_poses, *(np.array(x) for x in ([ESTIMATE, OTHER], [P, P], [TRUTH, TRUTH])),
        Convention(**MIXED),
    )),
    "matrices of ARKit": Log(matrices(columns=True)),
    "matrices with a time": Log(matrices(columns=False)),
    "KITTI": Log(kitti(timed=False)),
    "KITTI, timed": Log(kitti(timed=True)),
    "plane, triangle": Log(of_planes(FLAT_P[:, *UPPER3]), IN_THE_PLANE),
    "plane, all of a covariance": Log(of_planes(FLAT_P), IN_THE_PLANE),
    "plane, σ": Log(of_planes(FLAT_SIGMA), IN_THE_PLANE),
    "npz of poses": npz_log(IN_SPACE, **POSES),
    # To the first order of the errors.
    "npz of GTSAM's marginals": npz_log(IN_SPACE, **MARGINALS)._replace(
        rtol=0.02, convention=Convention("right", order="rotation-first")),
    "mat of poses": Log(mat(**POSES), IN_SPACE, "runs.mat"),
    "mat of errors, cells of names": Log(
        mat(errors=ERRORS, covariances=COVARIANCES, names=np.array([*"abcd"], object)),
        partial(OF_ERRORS, names="abcd"), "runs.mat",
    ),
    "mat of NEES": Log(mat(nees=NEES, dof=4), NEES_OF, "runs.mat"),
    "npz of errors": npz_log(OF_ERRORS, errors=ERRORS, covariances=COVARIANCES),
    "npz of one run": npz_log(OF_ONE, errors=ERRORS[0], covariances=COVARIANCES[0]),
    "npz of one run of NEES": npz_log(
        partial(evaluate_nees, NEES[:1], 4), nees=NEES[0], dof=np.full(5, 4)),
    "npz of one run of σ": npz_log(
        partial(jaxslam.evaluate, ERRORS[:1], of_sigmas(DEVIATIONS[:1])),
        errors=ERRORS[0], sigmas=DEVIATIONS[0]),
    "mat of one run, steps last": Log(
        mat(errors=ERRORS[0].T, covariances=np.moveaxis(COVARIANCES[0], 0, -1)), OF_ONE,
        "runs.mat"),
    "mat, runs last": Log(
        mat(errors=ERRORS.T, covariances=COVARIANCES.T), OF_ERRORS, "runs.mat"),
    "npz of σ": npz_log(OF_DEVIATIONS, errors=ERRORS, sigmas=DEVIATIONS),
    "npz of innovations": npz_log(
        partial(OF_ERRORS, quantity="NIS"), innovations=ERRORS, covariances=COVARIANCES),
    "npz of NEES": npz_log(NEES_OF, nees=NEES, dof=4),
    "npz of NIS": npz_log(NIS_OF, nis=NEES, dof=4),
    **{f"CSV, n = {n}": of_n(n) for n in (1, 6)},
    "CSV, n = 2, with names": of_n(2, NAMED),
    # Of n = 4 a full covariance is as many numbers as of n = 5 and a triangle.
    "CSV, n = 4": csv_log(OF_ERRORS, PLACES, FLAT_ERRORS, TRIANGLES),
    "CSV, all of a covariance": csv_log(
        OF_ERRORS, PLACES, FLAT_ERRORS, COVARIANCES.reshape(-1, 16)),
    "CSV, semicolons": csv_log(OF_ERRORS, PLACES, FLAT_ERRORS, TRIANGLES, between=";"),
    "CSV, σ": csv_log(
        partial(OF_DEVIATIONS, names="abcd"), PLACES, FLAT_ERRORS, DEVIATIONS.reshape(-1, 4),
        header=SIGMAS_NAMED,
    ),
    "CSV, each σ beside its error": csv_log(
        partial(OF_DEVIATIONS, names="abcd"), PLACES,
        np.stack([FLAT_ERRORS, DEVIATIONS.reshape(-1, 4)], axis=2).reshape(-1, 8),
        header="run,step,a,sigma_a,b,sigma_b,c,sigma_c,d,sigma_d\n",
    ),
    "CSV, one run": csv_log(
        partial(jaxslam.evaluate, ERRORS[:1], COVARIANCES[:1], names="abcd"),
        np.arange(5), ERRORS[0], TRIANGLES[:5], header=ONE_RUN,
    ),
    "CSV of NEES": csv_log(NEES_OF, PLACES, *NEES_ALONE, header="run,step,nees,dof\n"),
    "CSV of NIS": csv_log(NIS_OF, PLACES, *NEES_ALONE, header="run,step,nis,dof\n"),
    **{f"bag {name}": of_bag(name) for name in KINDS},
    **{f"bag: {', '.join(kinds)}": of_bag(name, *kinds) for name, *kinds in (
        ("run.bag", "pose_with_covariance_stamped", "path"),
        ("run.mcap", "pose_with_covariance_stamped", "odometry"),
        ("run.bag", "odometry", "transform_stamped"),
        ("run.mcap", "odometry", "path"),
    )},
    **{
        f"bag: transforms of {name}": of_bag(name, truth="transforms", topic="/tf:map.imu")
        for name in ("run.bag", "run.mcap")
    },
}  # fmt: skip
