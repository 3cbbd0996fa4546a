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
# # How to estimate noise levels by gradients
#
# A filter is a pytree of its numbers, and a run of it is a differentiable function. Here the σ of
# the accelerations and of the pixels of a simulated camera are found from what the camera measured,
# by climbing the likelihood of the filter's innovations (Schweppe 1965).

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxslam
from jaxslam.consistency import draw, log_likelihood

jax.config.update("jax_enable_x64", True)
REDUCED = bool(os.environ.get("JAXSLAM_REDUCED"))
RUNS, STEPS, GRID = (16, 10, 5) if REDUCED else (128, 60, 21)

# %% [markdown]
# ## A filter of two numbers
#
# The paper's filter on `matched-loose` with depths that are known to 6 %, so that it is nearly
# linear; its σ are multiplied by two factors, of which the truth is (1, 1).

# %%
scenario = jaxslam.scenario("matched-loose", steps=STEPS, inverse_depth=(1 / 6, 0.01))
room, runs = draw(scenario, RUNS)
(paper,) = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"]).values()
paper = jaxslam.cast(paper, jnp.float64)


def filter_of(log_factors):
    acceleration, pixel = jnp.exp(log_factors)
    return jaxslam.Slam(
        motion=jaxslam.ConstantVelocity(
            paper.motion.noise_sigma * acceleration,
            paper.motion.velocity,
            paper.motion.velocity_sigma,
        ),
        sensor=jaxslam.Pinhole(paper.sensor.camera, paper.sensor.sigma * pixel),
        depth=paper.depth,
    )


# %% [markdown]
# ## The way up
#
# Newton's method with the observed information, which is the central difference of the gradient,
# from (3, 0.5), far off. Runs are independent: the scatter of what each of them asks for gives the
# standard errors, which hold for a wrong model too (White 1982).

# %%
STEP = 1e-4  # of the central differences, in the logarithm of a factor
MOST = 0.7  # of one step: far from the maximum its curvature misleads


@jax.jit
def scores(log_factors, runs):
    """The gradient of the log likelihood of every run."""
    slope = jax.jacfwd(lambda theta, run: log_likelihood(filter_of(theta), room, run))
    return jax.vmap(slope, in_axes=(None, 0))(log_factors, runs)


def newton(log_factors):
    """One step, and the standard errors of where it leads."""

    def slope(theta):
        return np.asarray(scores(theta, runs)).sum(axis=0)

    fall = [slope(log_factors - h) - slope(log_factors + h) for h in STEP * np.eye(2)]
    information = np.array(fall) / (2 * STEP)
    curvature, axes = np.linalg.eigh((information + information.T) / 2)
    # Uphill even where the surface is not yet concave.
    curvature = np.maximum(np.abs(curvature), 1e-6 * np.abs(curvature).max())
    by_run = (np.asarray(scores(log_factors, runs)) @ axes) / curvature @ axes.T
    errors = np.sqrt(np.sum((by_run - by_run.mean(axis=0)) ** 2, axis=0))
    return np.clip(by_run.sum(axis=0), -MOST, MOST), errors


path, converged = [np.log([3.0, 0.5])], False
while not converged and len(path) < 9:
    change, errors = newton(path[-1])
    path.append(path[-1] + change)
    converged = bool(np.all(np.abs(change) < 0.05 * errors))
path = np.exp(np.array(path))
factors = path[-1]
for name, factor, error in zip(("acceleration", "pixel"), factors, errors, strict=True):
    print(f"σ of the {name}: {factor:.3f} × the truth, standard error {error:.1%}")


# %% [markdown]
# ## The surface
#
# The mean log likelihood of a run over both factors.


# %%
@jax.jit
def surface(log_factors, runs):
    def one(theta):
        of_runs = jax.vmap(lambda run: log_likelihood(filter_of(theta), room, run))(runs)
        return jnp.mean(of_runs)

    return jax.lax.map(one, log_factors)


accelerations, pixels = np.geomspace(0.3, 4, GRID), np.geomspace(0.4, 1.6, GRID)
grid = np.stack(np.meshgrid(np.log(accelerations), np.log(pixels)), axis=-1)
values = np.asarray(surface(jnp.asarray(grid.reshape(-1, 2)), runs)).reshape(GRID, GRID)

figure, axes = plt.subplots(figsize=(6, 4.2), layout="constrained")
levels = values.max() - np.array([300, 100, 30, 10, 3, 1, 0.3])
contours = axes.contour(
    accelerations, pixels, values, levels, colors="0.6", linewidths=0.8, linestyles="solid"
)
below = {level: f"−{values.max() - level:.3g}" for level in contours.levels}
axes.clabel(contours, contours.levels[:-2], fmt=below, fontsize=8)
axes.plot(*path.T, "o-", color="#0072B2", ms=4, label="Newton's method")
axes.plot(1, 1, "*", color="#D55E00", ms=12, label="the truth")
axes.set(
    xscale="log", yscale="log", xlabel="σ of the acceleration / truth",
    ylabel="σ of a pixel / truth",
    title="Mean log likelihood of a run, below its maximum",
)  # fmt: skip
for axis, ticks in ((axes.xaxis, (0.3, 0.5, 1, 2, 4)), (axes.yaxis, (0.4, 0.6, 1, 1.6))):
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)
axes.legend(loc="lower left")
plt.show()

# %%
assert converged
assert np.all(np.abs(np.log(factors)) < 4 * errors)

# %% [markdown]
# The pixel's σ is found to a fraction of a percent, as tens of thousands of pixels tell of it; the
# acceleration's by how the velocity wanders, which is much less. The contours are longer that way.
