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
# # Why an unknown velocity allows two worlds (a Necker cube)
#
# A wire cube on paper turns over while one looks at it: the near corner becomes the far one. A
# camera that starts from rest sees the same. Its first pixels fit two worlds, one in which it
# went left and one in which it went right, and for some time nothing but the noise tells them
# apart. A filter that holds one Gaussian holds one of the two worlds, and never learns that there
# was another.
#
# One planar camera, twelve landmarks, thirty frames a second. The velocity has mean zero and σ 0.5
# m/s, and nothing else is known of it.

# %%
import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import display
from scipy.optimize import least_squares

import jaxslam
from jaxslam.consistency import draw
from jaxslam.statistics import lost_threshold

sys.path.append("../benchmarks")  # of the repository, beside this folder
from modes import followed, modes_of_run, plot_modes, worlds_of

jax.config.update("jax_enable_x64", True)
REDUCED = bool(os.environ.get("JAXSLAM_REDUCED"))
STEPS, RUNS, SUM = (8, 6, "mixture5+rest8") if REDUCED else (40, 40, "mixture5+rest")
TOLD = 35  # the run that is looked at: one of many, with worlds that live long

scenario = jaxslam.scenario("standstill", steps=STEPS)
room, runs = draw(scenario, max(RUNS, TOLD + 1))
run = jax.tree.map(lambda x: x[TOLD], runs)
made = jaxslam.make_filters(scenario, ["robocentric", f"scale_gauge+{SUM}"], ["inverse_scaling"])
ekf, rest = (jaxslam.cast(slam, jnp.float64) for slam in made.values())

# %% [markdown]
# ## What the pixels tell, and what they do not
#
# **Everything reversed.** Put the camera where it did not go, and the world behind it:
# $(t, X) \to -(t, X)$, with the same orientations. No pixel changes.

# %%
sensor = scenario.sensor
translations = np.asarray(run.poses.translation())
rotations = np.asarray(run.poses.rotation().as_matrix())
points = np.asarray(run.points)


@jax.jit
@jax.vmap
def pixels(rotation, translation, points):
    """Of all points in a frame, without noise."""
    measure = jax.vmap(lambda X: sensor.measure(X, jnp.ones(())))
    return measure((points - translation) @ rotation)[:, 0]


every = np.broadcast_to(points, (STEPS + 1, *points.shape))
seen = np.asarray(pixels(rotations, translations, every))
behind = np.asarray(pixels(rotations, -translations, -every))
print(f"largest change of a pixel: {np.abs(behind - seen).max():.1e} px")

# %% [markdown]
# Only a prior speaks against that world: things that are seen are in front.
#
# **The Necker cube.** Now the camera goes the other way, what is nearer than the middle becomes as
# much farther (its inverse depth is reflected at the prior's mean), and the camera turns by what
# the flow of all landmarks has in common. This world is in front, and as likely by the prior. Its
# pixels are not the same, but how different are they, with the pose of every frame that fits best?


# %%
inverse = 1 / points[:, 1]
mirrored = points * inverse[:, None] / (1 / scenario.nearest_depth - inverse)[:, None]


def necker(frame):
    """The root mean square change of the pixels of a frame."""

    def change(pose):
        x, z, angle = pose
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        new = pixels((rotations[frame] @ turn)[None], np.array([[x, z]]), mirrored[None])
        return np.asarray(new[0] - seen[frame])

    left = least_squares(change, [*-translations[frame], 0.0], diff_step=1e-6).fun
    return np.sqrt(np.mean(left**2))


FRAMES = [frame for frame in (1, 3, 6, 8, 10, 20, 30, 40) if frame <= STEPS]
print("frame   flow so far   left of it in the Necker world (σ of a pixel: 0.3)")
flows = {frame: np.sqrt(np.mean((seen[frame] - seen[0]) ** 2)) for frame in FRAMES}
changes = {frame: necker(frame) for frame in FRAMES}
for frame in FRAMES:
    print(f"{frame:5d}   {flows[frame]:8.2f} px   {changes[frame]:8.2f} px")

# %% [markdown]
# What tells the two worlds apart is perspective: a fiftieth of the flow. And here the depths are
# only mirrored; where they may bend a little, and the accelerations too, they take up most of that.
#
# ## One camera, two worlds
#
# The Gaussian sum that starts from rest keeps all frames, looks for minima in all directions, and
# keeps the distinct ones with their weights (`jaxslam/filters/window`; in the filter's state they
# are `state.modes`). Beside it an EKF, the paper's filter, on the same pixels.

# %%
study = jaxslam.monte_carlo(scenario, {"EKF": ekf}, runs=max(RUNS, TOLD + 1), chunk=1)
of_ekf = [study.store.load("EKF", chunk) for chunk in study.chunks]
path = of_ekf[TOLD]["sample_path"][:, :-1, -1]

modes = modes_of_run(rest, room, run)
worlds = worlds_of(run, modes, path, "the EKF", scenario.rate)
display(plot_modes(worlds, (1, 4, 7) if REDUCED else (1, 10, 20, 27, 40)))

# %% [markdown]
# Blue and orange are the two worlds; black is the truth. Look at the farthest landmark, in the
# middle: in the orange world it is the nearest. Bars are one σ, given the scale. The EKF went to
# one of them with the first frames, and stays there after the sum has dropped it.
#
# How well does each world explain the pixels that it has seen?

# %%
numbers = followed(modes)
print("frame   world: weight, residual in σ of a pixel, camera at (x, z) m")
for frame in (frame for frame in FRAMES if frame <= len(modes.weights)):
    alive = np.flatnonzero(modes.weights[frame - 1] > 0.01)
    said = [
        f"{numbers[frame - 1, i]}: {modes.weights[frame - 1, i]:4.0%} "
        f"{modes.misfits[frame - 1, i]:.3f} {np.round(modes.paths[frame - 1, i, frame], 2)}"
        for i in alive
    ]
    print(f"{frame:5d}   {'   '.join(said)}")
print(f"truth at frame {STEPS}: {np.round(translations[-1], 2)}, EKF: {np.round(path[-1], 2)}")

# %% [markdown]
# From the third frame on the residuals are alike to a percent: how well a world explains its pixels
# does not tell that it is the wrong one.
#
# ## Many cameras
#
# The mean NEES (ideal 3), and how many runs are lost (NEES above the 99.99 % quantile of χ²₃): of
# the EKF, and of the sum.

# %%
bound = lost_threshold(3)
nees = {
    "EKF": np.stack([records["nees"][0] for records in of_ekf[:RUNS]]),
    "sum": np.stack(
        [
            modes_of_run(rest, room, jax.tree.map(lambda x, i=i: x[i], runs)).nees
            for i in range(RUNS)
        ]
    ),
}
low, high = jaxslam.mean_band(3, RUNS)
print(f"{RUNS} runs; a consistent filter's mean is inside {low:.2f}–{high:.2f} with 95 %")
print("frame   EKF: lost, mean of the others    sum: lost, mean of the others")
for frame in FRAMES:
    said = []
    for values in nees.values():
        now = values[:, frame - 1]
        kept = now[now <= bound]
        said.append(f"{np.mean(now > bound):6.1%} {kept.mean():8.2f}")
    print(f"{frame:5d}   {'                '.join(said)}")

# %% [markdown]
# The EKF loses most of its runs, most of these in the first frames, by a coin that it never knew it
# tossed. The sum says "left or right" while the pixels do not decide. Larger studies, planar and
# in 6-DoF, and what still fails are in [docs/from-rest.md](../docs/from-rest.md).

# %%
assert np.abs(behind - seen).max() < 1e-9
assert changes[6] < 0.03 * flows[6]
shares = worlds.shares()
both = np.argsort(-shares.sum(axis=0))[:2]
assert shares[5, both].min() > 0.1, "two worlds live at frame 6"
first = [worlds.mode(6, int(number)) for number in both]
assert abs(modes.misfits[5, first[0]] / modes.misfits[5, first[1]] - 1) < 0.05
assert path[-1] @ translations[-1] < 0, "the EKF is in the wrong world"
lost = {name: np.mean(values[:, 5] > bound) for name, values in nees.items()}
assert lost["sum"] < 0.1 < lost["EKF"]
