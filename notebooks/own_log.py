# ---
# jupyter:
#   jupytext:
#     formats: py:percent,ipynb
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A robot among beacons: from its log to a verdict
#
# A robot with wheels measures range and bearing of 15 posts whose places were surveyed, and motion
# capture says where it really was: the MRCLAM data set 6 of the University of Toronto (Leung et
# al., IJRR 2011). The filter gets odometry and measurements. The truth only judges it.
#
# The data are read from `$JAXSLAM_DATA/logs/mrclam6`. Without them a robot with the same faults is
# simulated, so that the notebook runs anywhere.

# %%
import os
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

import jaxslam
from jaxslam.consistency import fit_of
from jaxslam.models import AnyArray, number_field
from jaxslam.plots import COLOURS

jax.config.update("jax_enable_x64", True)
FOLDER = Path(os.environ.get("JAXSLAM_DATA", "../../shared/data")) / "logs" / "mrclam6"
RATE = 5.0
ROBOTS = (3,) if os.environ.get("JAXSLAM_REDUCED") else (1, 2, 3)
print("MRCLAM 6" if FOLDER.is_dir() else "simulated")

# %% [markdown]
# ## The log
#
# One frame is a fifth of a second. The control is what the wheels say of it, in the axes of
# `jaxslam`: to the right, ahead, and the turn to the left. A bearing is positive to the right. The
# base frame is the first pose, so the surveyed posts are written in that.


# %%
def recorded(robot, seconds):
    """Times, odometry, truth (x, y, heading), measurements (time, post, range, bearing), posts."""
    names = (f"Robot{robot}_Odometry", f"Robot{robot}_Groundtruth", f"Robot{robot}_Measurement")
    odometry, truth, measured = (np.loadtxt(FOLDER / f"{name}.dat") for name in names)
    codes, posts = (np.loadtxt(FOLDER / f"{x}.dat") for x in ("Barcodes", "Landmark_Groundtruth"))
    post = np.array([dict(codes[:, ::-1]).get(code, 0) for code in measured[:, 1]])
    measured[:, 1] = post
    start = max(odometry[0, 0], truth[0, 0])
    times = np.arange(start, min(start + seconds, truth[-1, 0]), 1 / RATE)
    return times, odometry, truth, measured[post > 5], posts[:, :3]


def simulated(robot, seconds):
    """The same of a robot whose wheels slip, and whose ranges have errors that last."""
    draw, times = np.random.default_rng(robot), np.arange(0, seconds, 1 / RATE)
    speed, turn = 0.12 + 0.05 * np.sin(times / 9), 0.3 * np.sin(times / 13 + robot)
    heading = np.cumsum(turn) / RATE
    x, y = (np.cumsum(speed * f(heading)) / RATE for f in (np.cos, np.sin))
    slips = np.stack([1.06 * speed, 1.1 * turn], 1) + draw.normal(size=(len(times), 2)) * [
        0.03,
        0.08,
    ]
    posts = np.column_stack([np.arange(6, 21), draw.uniform(-5, 5, (15, 2))])
    lasts, rows = 0.1 * draw.normal(size=15), []
    for i in range(0, len(times), 2):
        lasts = 0.98 * lasts + 0.02 * draw.normal(size=15)
        for j in draw.choice(15, 3, replace=False):
            dx, dy = posts[j, 1:] - [x[i], y[i]]
            away = np.hypot(dx, dy)
            reading = away + lasts[j] + (0.03 + 0.012 * away) * draw.normal()
            bearing = np.arctan2(dy, dx) - heading[i] + 0.01 * draw.normal()
            taken_for = posts[draw.integers(15), 0] if draw.random() < 0.01 else posts[j, 0]
            rows.append((times[i], taken_for, reading, bearing))
    truth = np.column_stack([times, x, y, heading])
    return times, np.column_stack([times, slips]), truth, np.array(rows), posts


def packed(times, odometry, truth, measured, posts):
    """What a filter is given of the log."""
    elapsed = np.diff(odometry[:, 0], prepend=odometry[0, 0])
    way, turn = (np.interp(times, odometry[:, 0], np.cumsum(elapsed * x)) for x in odometry.T[1:])
    control = np.stack([0 * times[1:], np.diff(way), np.diff(turn)], 1)
    heading = np.interp(times, truth[:, 0], np.unwrap(truth[:, 3]))
    place = np.stack([np.interp(times, truth[:, 0], x) for x in truth.T[1:3]], 1)
    c, s = np.cos(heading[0]), np.sin(heading[0])

    def in_base(points):
        return (points - place[0]) @ np.array([[s, c], [-c, s]])

    frame = np.rint((measured[:, 0] - times[0]) * RATE).astype(int)
    there = (frame >= 0) & (frame < len(times))
    true = jax.vmap(jaxlie.SE2.from_xy_theta)(*in_base(place[1:]).T, heading[1:] - heading[0])
    known = jaxslam.PriorMap(
        posts[:, 0].astype(int), jnp.asarray(in_base(posts[:, 1:])), 1e-6 * jnp.eye(30)
    )
    return jaxslam.measured_run(
        jnp.asarray(control),
        frame[there],
        measured[there, 1],
        measured[there, 2:] * [1, -1],
        known=known,
        truth=true,
    )


read = recorded if FOLDER.is_dir() else simulated
logs = {robot: packed(*read(robot, 300)) for robot in ROBOTS}

# %% [markdown]
# ## The first filter
#
# σ of a reading of the odometry, and of range and bearing, as one would guess. `judged` runs the
# filter, compares its poses with the truth, and says how its innovations look without any truth.


# %%
def judged(slam, log):
    """NIS over its degrees of freedom, and the verdict on the poses."""
    _, found = eqx.filter_jit(jaxslam.run)(slam, log.frames, log.start(slam))
    poses = jaxslam.evaluate_poses(
        np.asarray(found.pose.as_matrix())[None],
        np.asarray(found.covariance)[None],
        np.asarray(log.truth.as_matrix())[None],
    )
    return float(found.nis.sum() / found.nis_dof.sum()), poses


def table(filters, logs=logs):
    """One row a filter: by how much σ should be larger, and NIS, of every robot."""
    rows = {}
    for name, slam in filters.items():
        found = [judged(slam, log) for log in logs.values()]
        rows[name] = [np.sqrt(np.mean(x.nees[x.logged]) / 3) for _, x in found]
        told = "   ".join(
            f"{k:5.2f} ({nis:5.2f})" for k, (nis, _) in zip(rows[name], found, strict=True)
        )
        print(f"{name:42} {told}")
    return rows


print(f"{'σ should be × (NIS)':42} robot 1         robot 2         robot 3")
plain = {"motion": jaxslam.Odometry([0.003, 0.01, 0.02]), "landmark": jaxslam.Cartesian()}
plain["sensor"] = jaxslam.RangeBearing([0.1, 0.015])
rows = table(
    {
        "as guessed": jaxslam.make_filter("world", **plain),
        "with a gate": jaxslam.make_filter("world+checked", **plain),
    }
)

# %% [markdown]
# One robot of the three takes posts for others: without a gate it is lost. The gate saves it, and
# throws away few percent of what it measures.

# %%
gated = jaxslam.make_filter("world+checked", **plain)
for robot, log in logs.items():
    print(f"robot {robot}: {fit_of(gated, [log]).left_out:.1%} left out")

# %% [markdown]
# σ is still too small. NIS does not show that: on MRCLAM 6 it is 0.9 for robot 3, whose σ is too
# small by a factor of 3.7.
#
# ## What the model lacks
#
# - **The noise of a range grows with the range.** A sensor may say it for each measurement, by
#   `noise_at`.
# - **Errors of a range last**: they are those of the picture of a post, and stay as long as the
#   robot sees it from there. The places of posts then seem to drift: `+drift20`, beside a prior σ
#   of 10 cm for surveyed places that are right to a millimetre.


# %%
class Sighting(jaxslam.RangeBearing):
    growth: AnyArray = number_field(default=0.0)  # of σ of a range, m a metre

    def noise_at(self, measured):
        of_range, of_bearing = self.sigma
        return jnp.diag(jnp.stack([of_range + self.growth * measured[0], of_bearing]) ** 2)


grown = plain | {"sensor": Sighting([0.03, 0.015], 0.012)}
rows |= table({"noise of a range that grows": jaxslam.make_filter("world+checked", **grown)})


def with_prior(log, sigma):
    """The log with a survey of that σ, m."""
    return eqx.tree_at(lambda log: log.known.covariance, log, sigma**2 * jnp.eye(30))


lasting = jaxslam.make_filter("world+checked+drift20", **plain)
surveyed = {robot: with_prior(log, 0.1) for robot, log in logs.items()}
rows |= table({"errors that last": lasting}, surveyed)

# %%
figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
for i, robot in enumerate(logs):
    axes.barh(
        np.arange(len(rows)) + (robot - 2) / 4, [row[i] - 1 for row in rows.values()], 0.22,
        left=1, color=COLOURS[robot - 1], label=f"robot {robot}",
    )  # fmt: skip
axes.axvline(1, color="0.3", linewidth=0.8)
axes.set(xscale="log", xlabel="σ should be × (1 is right)", yticks=range(len(rows)))
axes.set_yticklabels(rows)
axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
axes.minorticks_off()
axes.invert_yaxis()
axes.legend()
display(figure)
plt.close(figure)

# %% [markdown]
# ## Noise from the innovations
#
# `jaxslam.tune` finds the σ that make the innovations of robot 1 the likeliest, without any truth;
# robot 2 is held out. It has no gate here, since what a gate leaves out makes small σ look likely.

# %%
ungated = jaxslam.make_filter("world+drift20", **plain)
first, second = (with_prior(packed(*read(robot, 100)), 0.1) for robot in (1, 2))
tuning = jaxslam.tune(ungated, [first], ["sensor.sigma"], held_out=[second])
print(tuning)

# %% [markdown]
# ## What remains
#
# On MRCLAM 6 the last row of the table is over-confident by a factor of 1.2 to 1.7, from up to 19.
# A noise that grows with the range does not help by itself: with it all three robots are more
# over-confident. None is right: how long an error of a range lasts is not known, nor whether one
# drift serves all posts.
#
# Tuning refutes itself there. With σ of a half and a fifth the innovations of robot 1 are white
# enough, and both its own poses and the innovations of robot 2 are worse: NIS goes from 1.2 to 4.4.
# The likelihood takes errors for independent from frame to frame. So judge by a log that was held
# out, and by the truth where there is any.

# %%
best, worst = rows["errors that last"], rows["as guessed"]
assert max(best) < 2
assert max(best) < max(worst) / 2

# %% [markdown]
# ## Trees in a park, without a truth
#
# A car with a laser scanner drives among trees (Victoria Park, E. Nebot; here with the matches and
# the σ of gtsam's file). Without any truth the innovations judge: NIS, whether they are white, and
# what a gate leaves out. These are the first 2000 poses.

# %%
PARK = FOLDER.parent / "victoria_park" / "victoria_park.txt"


def park(frames):
    """Odometry and the places of trees in the axes of the car, both to the right and ahead."""
    rows = [line.split() for line in PARK.read_text().splitlines()]
    moves = [row for row in rows if row[0] == "ODOMETRY"]
    frame = {"0": 0} | {row[2]: i + 1 for i, row in enumerate(moves)}
    trees = np.array(
        [
            (frame[pose], tree, -float(y), float(x))
            for kind, pose, tree, x, y, *_ in rows
            if kind == "LANDMARK" and frame[pose] <= frames
        ],
        float,
    )
    control = np.array([(-float(y), float(x), float(a)) for _, _, _, x, y, a, *_ in moves])
    return jaxslam.measured_run(
        jnp.asarray(control[:frames]),
        trees[:, 0].astype(int),
        trees[:, 1].astype(int),
        trees[:, 2:],
    )


trees = {}
if PARK.is_file():
    for factor in (1, 10):
        for name in ("world", "world+checked"):
            slam = jaxslam.make_filter(
                name,
                motion=jaxslam.Odometry([0.002, 0.01, 0.002 * factor]),
                sensor=jaxslam.Position(np.sqrt(0.4), 2),
                landmark=jaxslam.Cartesian(),
            )
            trees[factor, name] = fit_of(slam, [park(2000)])
            print(f"{name}, σ of a turn × {factor}: {trees[factor, name]}")
else:
    print("without the data of the park")

# %% [markdown]
# The same gate that saved a robot ruins this map, where every match is right: with the σ of the
# file it leaves out most of them. The odometry turns worse than it says, so that after some frames
# without a tree right matches look wrong, and what is left out cannot correct the heading.
#
# One rule serves both: **look at what the gate leaves out.** A few percent are wrong identities.
# Much more is a wrong noise or a wrong model, which a gate hides: mend that first, without a gate.
# With a larger σ of turns it leaves out next to nothing, and changes nothing.
#
# The honest end: with neither noise are these innovations white. They are correlated from frame to
# frame, as a car that skids errs in one way for seconds. NIS near 1 is no proof.

# %%
if trees:
    assert trees[1, "world+checked"].left_out > 0.3
    assert trees[10, "world+checked"].left_out < 0.03
    assert min(fit.correlation for fit in trees.values()) > 0.1
