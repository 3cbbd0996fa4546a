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
# # What one loop tells a map of submaps
#
# A camera with odometry goes round a circle of 4 m and comes back to where it began. Its filter
# keeps only what is in view: whenever the scene has changed, the joint Gaussian of everything is
# frozen as a *submap*, and the filter goes on from there. When the camera is back, some landmarks
# in view are the very first ones. That is one loop, and here is what it does to every earlier
# camera and to its covariance. [The page on submaps](../docs/submaps.md) has the equations.

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import display

import jaxslam
from jaxslam.consistency import run_through
from jaxslam.filters import Loops, agreeing, base_poses, chain, close
from jaxslam.plots import COLOURS, new_figure
from jaxslam.simulation import Room, simulate
from jaxslam.statistics import chi2_quantile

jax.config.update("jax_enable_x64", True)
LAP = 218  # frames at 10 Hz, a little more than once round
VIEW = 20
LARGER = 15  # times as large as they are, errors and ellipses are drawn on the map
scenario = jaxslam.scenario("laps-6dof", steps=LAP)
(base,) = jaxslam.make_filters(scenario, "robocentric+oc", "inverse_scaling").values()
slam = replace(base, frame=jaxslam.Submaps(history=32))
run = simulate(scenario, jax.random.key(3))


def seen(state, *_):
    """The filter's number of the landmark in every slot, and how many submaps have ended."""
    return jnp.append(state.numbers, -1)[state.slots], state.count


state, (numbers, ended) = jax.jit(
    lambda run: run_through(slam, Room(VIEW, VIEW, VIEW, VIEW), run, seen)
)(run)
submaps = chain(slam, state, int(state.count))
frames = np.append(np.flatnonzero(np.diff(np.append(0, ended))) + 1, LAP)  # their last ones
print(f"{len(frames)} submaps of {VIEW} landmarks in view, {int(numbers.max()) + 1} in all")

# %% [markdown]
# ## Which landmarks are seen again
#
# The filter counts a landmark that comes back as a new one. In the simulation we know which point
# each is: a pair is a landmark of the last frame, and the first one that was the same point.

# %%
numbers, points = np.asarray(numbers), np.asarray(run.identity)[1:]
first: dict[int, int] = {}
for number, point in sorted(set(zip(numbers[numbers >= 0], points[numbers >= 0], strict=True))):
    first.setdefault(point, number)
place = {}  # the last submap that has a landmark, and its slot there
for submap, slots in enumerate(np.asarray(submaps.links.numbers)):
    place.update({number: (submap, slot) for slot, number in enumerate(slots) if number >= 0})
pairs = [
    (place[first[point]], place[number])
    for number, point in zip(numbers[-1], points[-1], strict=True)
    if number >= 0 and first[point] != number
]
both = jnp.asarray(pairs)
loops = Loops(both[:, :, 0], both[:, :, 1], jnp.ones(len(both), bool))
before = close(submaps, Loops(loops.submaps, loops.slots, ~loops.valid))  # no pair is believed
believed = agreeing(before, loops)
after = close(submaps, believed)
print(f"{len(pairs)} pairs, of which {int(believed.valid.sum())} are jointly compatible")


# %% [markdown]
# ## Every earlier camera, before and after
#
# From above: the true path, and where the camera is at the end of each submap, with its 95 %
# ellipse. Errors and ellipses are drawn 15 times as large as they are. Before the loop the
# ellipses grow all the way round. After it the last ones are as small as the first, and the
# largest are half-way: what is far from the start both ways is known least.
# %%
def cameras(posterior):
    """Positions x, z with their covariances, and NEES by its degrees of freedom."""
    poses, P = posterior.marginal(lambda states: base_poses(submaps, states))
    truth = jax.tree.map(lambda x: x[frames], run.poses)
    P = P.reshape(len(frames), 6, len(frames), 6)[np.arange(len(frames)), :, np.arange(len(frames))]
    error = jax.vmap(jaxslam.geometry.difference)(truth, poses)
    nees = jnp.einsum("ni,nij,nj->n", error, jnp.linalg.inv(P), error) / 6
    R = poses.rotation().as_matrix()
    P = R @ P[:, :3, :3] @ jnp.swapaxes(R, 1, 2)
    flat = np.array([0, 2])
    return jax.device_get((poses.translation()[:, flat], P[:, flat][:, :, flat], nees))


def ellipse(covariance):
    """The 95 % ellipse about the origin."""
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = np.sqrt(chi2_quantile(0.95, 2)) * np.stack([np.cos(angle), np.sin(angle)])
    return np.linalg.cholesky(covariance) @ circle


path = np.asarray(run.poses.translation())[:, [0, 2]]
told = {"before the loop": cameras(before), "after the loop": cameras(after)}
figure = new_figure(12, 6)
for axes, colour, (name, (centres, covariances, _)) in zip(
    figure.subplots(1, 2, sharex=True, sharey=True), COLOURS[1::-1], told.items(), strict=True
):
    axes.plot(*path.T, "k", lw=1, label="true path")
    axes.plot(*path[frames].T, "k.", ms=5, label="true camera")
    drawn = path[frames] + LARGER * (centres - path[frames])
    axes.plot(*drawn.T, "+", color=colour, ms=9, label=f"estimate, error × {LARGER}")
    for i, (centre, covariance) in enumerate(zip(drawn, covariances, strict=True)):
        outline = centre[:, None] + LARGER * ellipse(covariance)
        axes.plot(*outline, color=colour, lw=1, label=None if i else f"95 % ellipse × {LARGER}")
    axes.set(aspect="equal", xlabel="x, m", ylabel="z, m", title=name)
    within = {"bbox_to_anchor": (-4.0, 0.4), "bbox_transform": axes.transData}
    axes.legend(fontsize=8, loc="center", **within)
    axes.grid(alpha=0.25)
display(figure)

# %% [markdown]
# ## Is it believable?
#
# The error of each of these cameras beside the σ that the chain claims of it. A loop makes both
# smaller, and NEES per degree of freedom, which is 1 for a right covariance, says whether both by
# the same factor.

# %%
figure = new_figure(10, 4)
axes = figure.subplots()
time = frames / scenario.rate
for colour, (name, (centres, covariances, _)) in zip(COLOURS[1::-1], told.items(), strict=True):
    error = np.linalg.norm(centres - path[frames], axis=1)
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    axes.plot(time, error, "o-", color=colour, ms=4, label=f"error, {name}")
    axes.plot(time, sigma, "--", color=colour, label=f"σ, {name}")
axes.set(xlabel="time at which the submap ended, s", ylabel="position in the plane, m")
axes.set_ylim(bottom=0)
axes.legend(fontsize=8)
axes.grid(alpha=0.25)
display(figure)
for name, (centres, _, nees) in told.items():
    rms = np.sqrt(np.mean(np.sum((centres - path[frames]) ** 2, axis=1)))
    print(f"{name}: RMS error {rms:.3f} m, mean NEES per degree of freedom {nees.mean():.2f}")

# %% [markdown]
# One run shows what happens. Whether the covariances hold is a matter of many:
# `python benchmarks/submaps.py` simulates five laps, with loops at the end of each and some of them
# wrong.
