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
# # The paper's filter in NumPy
#
# *Monocular SLAM with Inverse Scaling Parametrization* (BMVC 2008) is a filter of one page. Here it
# is, in plain NumPy and for the paper's planar world, with its Jacobians derived by hand; the
# numbers (P12) are the paper's. Below, the library's filter, which differentiates the models and
# runs on any of them, goes through the same run beside it: means and covariances are the same,
# frame by frame. [docs/paper.md](../docs/paper.md) says where in the library each equation is.
#
# A planar pose is a 3 × 3 matrix $T = (R, t)$, its error a right one, $T\,\mathrm{Exp}(\delta)$.
# A landmark is $(x, z, \omega)$ in the camera's frame, the point $(x, z)/\omega$. The state and
# its covariance are in the order pose $T_{CB}$, velocity $v$, acceleration $a$, calibration
# $(f, c)$, landmarks.

# %%
import math

import equinox as eqx
import jax
import numpy as np
from IPython.display import display

import jaxslam
from jaxslam.consistency import draw
from jaxslam.plots import COLOURS, new_figure
from jaxslam.simulation import features

# %% tags=["filter"]
POSE, V, A, K = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])  # a quarter turn, from x towards z


def series(M, k=0):
    """Σ Mⁱ/(i + k)!, which is the matrix exponential for k = 0."""
    return sum(np.linalg.matrix_power(M, i) / math.factorial(i + k) for i in range(15))


def rows(turn, column):
    """[turn, column; 0]: an element of the Lie algebra, or an operator on it."""
    return np.vstack([np.column_stack([turn, column]), np.zeros(3)])


class PaperFilter:
    def __init__(self, s):
        self.dt, self.nominal = 1 / s.rate, np.array([*s.focal, *s.centre])
        self.Q, self.D = np.square(s.acceleration_sigma), np.square([s.focal_sigma, s.centre_sigma])
        self.R, self.mean = s.pixel_sigma**2, 1 / (2 * s.nearest_depth)
        self.T, self.v, self.X, self.slots = np.eye(3), np.array(s.velocity), np.zeros((0, 3)), []
        self.P = np.zeros((11, 11))
        self.P[V, V] = np.diag(np.square(s.velocity_sigma))
        self.augment()

    def augment(self):
        """This step's acceleration (P10, P11) and calibration (P15)."""
        self.a, self.k = np.zeros(3), self.nominal
        self.P[A, A], self.P[K, K] = np.diag(self.Q), np.diag(self.D)

    def displacement(self):
        """Exp((v + aΔt)Δt) (P8, P9), its Jacobian by (v, a), and the landmarks seen from there."""
        tau = (self.v + self.a * self.dt) * self.dt
        step = series(rows(tau[2] * QUARTER, tau[:2]))
        right = series(-rows(tau[2] * QUARTER, -QUARTER @ tau[:2]), 1)
        by_X = step[:2, :2].T @ np.column_stack([np.eye(2), -step[:2, 2]])
        seen = self.X @ by_X.T  # (x, z) of Rᵀ(X − ωt)
        by_step = [-np.c_[self.X[i, 2] * np.eye(2), QUARTER @ p] for i, p in enumerate(seen)]
        return step, self.dt * np.hstack([right, self.dt * right]), seen, by_step, by_X

    def update(self, measured):
        """h = proj(K T⁻¹X) (P12, P14), its Jacobian [0 H_v H_a H_M H_Γ] (P17), the EKF (P16)."""
        _, by_va, seen, by_step, by_X = self.displacement()
        used = [(i, u) for i, u in measured if seen[i, 1] > 0]
        H, r = np.zeros((len(used), len(self.P))), np.zeros(len(used))
        for j, (i, u) in enumerate(used):
            bearing = seen[i, 0] / seen[i, 1]
            by_point = self.k[0] / seen[i, 1] * np.array([1, -bearing])
            H[j, 3:9], H[j, K] = by_point @ by_step[i] @ by_va, (bearing, 1)
            H[j, 11 + 3 * i : 14 + 3 * i] = by_point @ by_X
            r[j] = u - (self.k[0] * bearing + self.k[1])
        gain = np.linalg.solve(H @ self.P @ H.T + self.R * np.eye(len(r)), H @ self.P).T
        left, delta = np.eye(len(self.P)) - gain @ H, gain @ r
        self.P = left @ self.P @ left.T + self.R * gain @ gain.T
        self.T = self.T @ series(rows(delta[2] * QUARTER, delta[:2]))
        self.v, self.a, self.k = self.v + delta[V], self.a + delta[A], self.k + delta[K]
        self.X = self.X + delta[11:].reshape(-1, 3)

    def compose(self):
        """Into the new camera, after the update (P18–P21): P ← J P Jᵀ, and a is forgotten."""
        step, by_va, seen, by_step, by_X = self.displacement()
        self.T, self.v = np.linalg.inv(step) @ self.T, self.v + self.a * self.dt
        back, J = np.linalg.inv(self.T), np.eye(len(self.P))
        J[POSE, 3:9] = -(rows(back[:2, :2], -QUARTER @ back[:2, 2]) + np.diag([0, 0, 1])) @ by_va
        J[V, A], J[A, A] = self.dt * np.eye(3), 0
        for i, by in enumerate(by_step):
            own = slice(11 + 3 * i, 13 + 3 * i)
            J[own, 3:9], J[own, 11 + 3 * i : 14 + 3 * i] = by @ by_va, by_X
        self.X[:, :2], self.P = seen, J @ self.P @ J.T

    def initialise(self, measured):
        """(u − c, f, f/d) with the prior on 1/d (P22–P26); then the frame's draws are forgotten."""
        J = np.zeros((3, len(self.P)))
        J[:, K] = [[0, -1], [1, 0], [self.mean, 0]]
        for slot, u in measured:
            self.X = np.vstack([self.X, [u - self.k[1], self.k[0], self.k[0] * self.mean]])
            self.slots.append(slot)
            own, PJ = np.diag([self.R, 0, (self.k[0] * self.mean / 2) ** 2]), self.P @ J.T
            self.P = np.block([[self.P, PJ], [PJ.T, J @ PJ + own]])
            J = np.pad(J, ((0, 0), (0, 3)))
        self.P[A.start : K.stop], self.P[:, A.start : K.stop] = 0, 0


# %% [markdown]
# ## Beside the library
#
# `circle` is the paper's kind of world: landmarks enter and leave, and the calibration errs
# independently in every frame. `matched-loose` is noisier: there the filter breaks, and the
# two break alike. A difference of means counts in σ, one of covariances in products of σ.


# %%
def listed(frame, number=lambda slot: slot):
    """The valid features of a frame."""
    valid = np.asarray(frame.valid)
    return [
        (number(int(slot)), float(u))
        for slot, u in zip(frame.slots[valid], frame.measured[valid, 0], strict=True)
    ]


def numbers(state, slots):
    """The library's pose as a matrix, its other numbers, and its covariance, in the order above."""
    index = [*range(11), *(11 + 3 * slot + i for slot in slots for i in range(3))]
    core, landmarks = state.core, np.asarray(state.landmarks)[slots]
    vector = np.concatenate([core.motion, landmarks.ravel()])
    return core.pose.as_matrix(), vector, np.asarray(state.covariance)[np.ix_(index, index)]


def apart(paper, state):
    """How far the two are from one another: of the means in σ, of the covariances in σσ."""
    T, vector, P = numbers(state, paper.slots)
    sigma = np.sqrt(np.diagonal(P))
    known = sigma == 0
    sigma = np.where(known, 1.0, sigma)
    kept = np.r_[3:6, 11 : len(P)]
    error = np.linalg.inv(T) @ paper.T
    pose = np.array([error[0, 2], error[1, 2], error[1, 0]])
    others = np.concatenate([paper.v, paper.X.ravel()]) - vector
    mean = np.abs(np.concatenate([pose / sigma[:3], others / sigma[kept]]))
    return mean.max(), np.max(np.abs(paper.P - P) / np.outer(sigma, sigma))


def side_by_side(name, seed=0, **fields):
    """Differences after every frame, and the last filter of ours."""
    with jax.enable_x64(True):
        scenario = jaxslam.scenario(name, **fields)
        filters = jaxslam.make_filters(scenario, ["robocentric"], ["inverse_scaling"], "white")
        slam = filters["robocentric/inverse_scaling"]
        room, runs = draw(scenario, 1, seed=seed)
        run = jax.tree.map(lambda x: x[0], runs)
        first, seen, new = jax.device_get(features(run, room))
        step, state = eqx.filter_jit(slam.step), slam.init(room.capacity, first)
        paper = PaperFilter(scenario)
        paper.initialise(listed(first))
        differences, poses = [apart(paper, state)], []
        for k in range(scenario.steps):
            frame_seen, frame_new = jax.tree.map(lambda x, k=k: x[k], (seen, new))
            state, _ = step(state, run.controls[k], frame_seen, frame_new)
            paper.augment()
            paper.update(listed(frame_seen, paper.slots.index))
            paper.compose()
            paper.initialise(listed(frame_new))
            differences.append(apart(paper, state))
            error = paper.T @ np.asarray(run.poses.as_matrix()[k + 1])
            poses.append((error[0, 2], np.sqrt(paper.P[0, 0])))
    return np.array(differences), np.array(poses)


results = {name: side_by_side(name) for name in ("circle", "matched-loose")}
for name, (differences, _) in results.items():
    mean, covariance = differences.max(axis=0)
    print(f"{name}: {len(differences) - 1} frames; means {mean:.1e}, covariances {covariance:.1e}")

# %%
figure = new_figure(11, 3.6)
left, right = figure.subplots(1, 2)
for colour, (name, (differences, _)) in zip(COLOURS, results.items(), strict=False):
    left.semilogy(differences.max(axis=1) + 1e-17, color=colour, label=name)
left.axhline(1e-9, color="k", lw=0.8, ls="--", label="largest that is allowed below")
left.set(xlabel="frame", ylabel="largest difference, σ", title="NumPy beside the library")
left.legend(fontsize=8)
error, sigma = results["circle"][1].T
right.plot(error, color=COLOURS[0])
right.plot(3 * sigma, "k--", -3 * sigma, "k--", lw=0.8)
right.set(xlabel="frame", ylabel="error, m", title="circle: position in x with ±3σ (dashed)")
display(figure)

# %%
for name, (differences, _) in results.items():
    assert differences.max() < 1e-9, name
