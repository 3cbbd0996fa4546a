"""Planar and spatial geometry: one code for SE(2) and SE(3), and the manifold ⊞ and ⊟ on pytrees.

Frames: B is the base (world), C the camera. `T_ab` maps coordinates in b to coordinates in a.
Camera axes are x right, y down, z forward; the planar world drops y, so that a planar point is
(x, z) and a planar tangent is (x, z, θ), with θ turning from x towards z.

Perturbations are right perturbations: `T ⊞ δ = T Exp(δ)` and `T_b ⊟ T_a = Log(T_a⁻¹ T_b)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, PyTree

Pose = jaxlie.SE2 | jaxlie.SE3
Rotation = jaxlie.SO2 | jaxlie.SO3
Point = Float[Array, " n"]
Scalar = Float[Array, ""]
Homogeneous = tuple[Point, Scalar]
"""(X, ω), the point X/ω; at infinity where ω is 0."""
Tree = TypeVar("Tree")
"""A pytree of poses and arrays."""


@dataclass(frozen=True)
class Geometry:
    """The dimensions of a world: its group of poses, its points and its pictures."""

    name: str
    group: type[jaxlie.SE2] | type[jaxlie.SE3]
    point_dim: int
    """Coordinates of a point: (x, z) or (x, y, z)."""

    @property
    def tangent_dim(self) -> int:
        """Degrees of freedom of a pose, which is also the size of a velocity: 3 or 6."""
        return self.group.tangent_dim

    @property
    def rotation_group(self) -> type[jaxlie.SO2] | type[jaxlie.SO3]:
        """SO(2) or SO(3)."""
        return jaxlie.SO2 if self.group is jaxlie.SE2 else jaxlie.SO3

    @property
    def pixel_dim(self) -> int:
        """Coordinates of a pixel: u, or (u, v)."""
        return self.point_dim - 1


PLANAR = Geometry("planar", jaxlie.SE2, 2)
SPATIAL = Geometry("spatial", jaxlie.SE3, 3)
GEOMETRIES = {geometry.name: geometry for geometry in (PLANAR, SPATIAL)}


def identity(geometry: Geometry, dtype) -> Pose:
    """The identity pose in a dtype; jaxlie's own has the default one."""
    return jax.tree.map(lambda x: x.astype(dtype), geometry.group.identity())


def _is_pose(leaf: PyTree) -> bool:
    return isinstance(leaf, jaxlie.MatrixLieGroup)


def _sizes(leaves: list[PyTree]) -> list[int]:
    """A pose may be a batch of poses, whose tangents follow one another."""
    return [
        x.tangent_dim * math.prod(x.get_batch_axes()) if _is_pose(x) else x.size for x in leaves
    ]


def tangent_dim(tree: PyTree) -> int:
    """Size of the tangent of a pytree of poses and arrays, in the order of its leaves."""
    return sum(_sizes(jax.tree.leaves(tree, is_leaf=_is_pose)))


class SplitPose(eqx.Module):
    """A pose whose position and orientation are perturbed separately: `t + δt`, `R Exp(δθ)`.

    The error state of the classical EKF-SLAM: the position's error is along the axes of the
    frame that the pose maps to, not turned with the estimated orientation.
    """

    translation: Float[Array, " n"]
    rotation: Rotation

    @staticmethod
    def of(pose: Pose) -> SplitPose:
        return SplitPose(pose.translation(), pose.rotation())

    def joined(self) -> Pose:
        return joined(self.rotation, self.translation)


def joined(rotation: Rotation, translation: Float[Array, " n"]) -> Pose:
    """The pose (R, t)."""
    if isinstance(rotation, jaxlie.SO2):
        return jaxlie.SE2.from_rotation_and_translation(rotation, translation)
    return jaxlie.SE3.from_rotation_and_translation(rotation, translation)


def step_tangents(batch: PyTree) -> Float[Array, "k t"]:
    """`T_{k+1} ⊟ T_k` of every pose, or rotation, of a batch and the next one."""
    before, after = jax.tree.map(lambda x: x[:-1], batch), jax.tree.map(lambda x: x[1:], batch)
    return jax.vmap(log)(jax.vmap(lambda a, b: a.inverse() @ b)(before, after))


def scaled(tree: Tree, scale: Scalar) -> Tree:
    """A pytree of poses, the lengths in them times `scale`."""

    def one(pose):
        if isinstance(pose, SplitPose):
            return SplitPose(scale * pose.translation, pose.rotation)
        return joined(pose.rotation(), scale * pose.translation())

    def is_leaf(node):
        return isinstance(node, SplitPose) or _is_pose(node)

    return jax.tree.map(one, tree, is_leaf=is_leaf)


def homogeneous_apply(
    T_ab: Pose, point: Float[Array, " n"], omega: Float[Array, ""]
) -> Float[Array, " n"]:
    """`X' = R X + ω t`: the homogeneous point (X, ω) in frame a; ω stays."""
    return T_ab.rotation() @ point + omega * T_ab.translation()


def exp(group: type[jaxlie.MatrixLieGroup], delta: Float[Array, " t"]) -> PyTree:
    """`Exp(δ)` of SO(n) or SE(n), with derivatives that are exact at and near zero rotation.

    SE(3): `t = v + B ω×v + C ω×(ω×v)`, B = (1 − cos θ)/θ², C = (θ − sin θ)/θ³ (Barfoot, State
    Estimation for Robotics, §7.1). jaxlie's own takes V = R at small angles, whose derivative by
    ω is twice the true one.
    """
    if group is jaxlie.SO2:
        return jaxlie.SO2.from_radians(delta[0])
    if group is jaxlie.SO3:
        return _turn(delta)
    if group is jaxlie.SE2:
        v, theta = delta[:2], delta[2]
        half = theta / 2
        # V = sinc(θ/2) R(θ/2).
        chord = _sinc(half**2) * (jaxlie.SO2.from_radians(half) @ v)
        return jaxlie.SE2.from_rotation_and_translation(jaxlie.SO2.from_radians(theta), chord)
    v, omega = delta[:3], delta[3:]
    s = omega @ omega
    turned = jnp.cross(omega, v)
    translation = v + _sinc(s / 4) ** 2 / 2 * turned + _third(s) * jnp.cross(omega, turned)
    return jaxlie.SE3.from_rotation_and_translation(_turn(omega), translation)


def _turn(omega: Float[Array, " 3"]) -> jaxlie.SO3:
    s = omega @ omega
    return jaxlie.SO3(jnp.concatenate([_cos(s / 4)[None], _sinc(s / 4) * omega / 2]))


def log(pose: Pose | Rotation) -> Float[Array, " t"]:
    """`Log(T)`, the inverse of `exp`: exact to rounding at small angles, for θ below π."""
    if isinstance(pose, jaxlie.SO2):
        return pose.as_radians()[None]
    if isinstance(pose, jaxlie.SO3):
        sign = jnp.where(pose.wxyz[0] < 0, -1.0, 1.0)
        w, xyz = sign * pose.wxyz[0], sign * pose.wxyz[1:]
        return 2 * _angle_by_sine(xyz @ xyz, w) * xyz
    rotation, t = pose.rotation(), pose.translation()
    if isinstance(rotation, jaxlie.SO2):
        half = rotation.as_radians() / 2
        v = (jaxlie.SO2.from_radians(-half) @ t) / _sinc(half**2)
        return jnp.append(v, 2 * half)
    omega = log(rotation)
    turned = jnp.cross(omega, t)
    v = t - turned / 2 + _inverse_third(omega @ omega) * jnp.cross(omega, turned)
    return jnp.concatenate([v, omega])


# Even functions of an angle, as functions of its square s: a series below _SMALL, where the closed
# form or its derivative would divide by nearly zero, and above it the closed form.
_SMALL = 0.25


def _even(s, series, closed):
    small = s < _SMALL
    value = jnp.zeros_like(s)
    for coefficient in reversed(series):
        value = value * s + coefficient
    return jnp.where(small, value, closed(jnp.where(small, 1.0, s)))


def _sinc(s):
    """sin(x)/x at x² = s."""
    series = [(-1) ** k / math.factorial(2 * k + 1) for k in range(7)]
    return _even(s, series, lambda s: jnp.sin(jnp.sqrt(s)) / jnp.sqrt(s))


def _cos(s):
    """cos(x) at x² = s."""
    series = [(-1) ** k / math.factorial(2 * k) for k in range(7)]
    return _even(s, series, lambda s: jnp.cos(jnp.sqrt(s)))


def _third(s):
    """(x − sin x)/x³ at x² = s."""
    series = [(-1) ** k / math.factorial(2 * k + 3) for k in range(7)]
    return _even(s, series, lambda s: (1 - jnp.sin(jnp.sqrt(s)) / jnp.sqrt(s)) / s)


def _angle_by_sine(s, cosine):
    """Return x / sin(x) for x in [0, π/2] with sin² x = s and the given cosine, not negative."""
    small = s < _SMALL * 0.04
    ratio = s / jnp.where(small, cosine, 1.0) ** 2
    series = jnp.zeros_like(s)
    for k in reversed(range(8)):
        series = series * ratio + (-1) ** k / (2 * k + 1)
    sine = jnp.sqrt(jnp.where(small, 1.0, s))
    return jnp.where(small, series / jnp.where(small, cosine, 1.0), jnp.atan2(sine, cosine) / sine)


def _inverse_third(s):
    """(1 − (x/2) cot(x/2))/x² at x² = s."""
    series = [
        1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160,
        691 / 1307674368000, 1 / 74724249600,
    ]  # fmt: skip
    return _even(s, series, lambda s: (1 - jnp.sqrt(s) / 2 / jnp.tan(jnp.sqrt(s) / 2)) / s)


def retract(tree: Tree, delta: Float[Array, " t"]) -> Tree:
    """`tree ⊞ δ`: poses by `T Exp(δ)`, vectors by addition, δ split in the order of the leaves."""
    return _moved(tree, delta, lambda T, part: T @ exp(type(T), part))


def difference(tree: PyTree, origin: PyTree) -> Float[Array, " t"]:
    """Return `tree ⊟ origin`, the inverse of `retract`: `tree = origin ⊞ (tree ⊟ origin)`."""
    return _compared(tree, origin, log)


def jacobian(function: Callable[[PyTree], PyTree], tree: PyTree) -> Float[Array, "k t"]:
    """Jacobian of `δ ↦ f(x ⊞ δ) ⊟ f(x)` at δ = 0, by `jax.jacfwd`."""
    value = function(tree)

    def error(delta):
        return _compared(function(nudge(tree, delta)), value, _first_order_log)

    return jax.jacfwd(error)(zero_tangent(tree))


def nudge(tree: Tree, delta: Float[Array, " t"]) -> Tree:
    """`retract` to first order, `T (I + δ^)`: the same derivative at δ = 0, and only there.

    Jacobians are taken through it: without the trigonometry of Exp and its guards they compile
    and run in less than half the time, and no division by |δ| can make a NaN.
    """
    return _moved(tree, delta, lambda T, part: T @ _first_order_exp(type(T), part))


def zero_tangent(tree: PyTree) -> Float[Array, " t"]:
    """δ = 0, in the dtype of the tree."""
    return jnp.zeros(tangent_dim(tree), jnp.result_type(*jax.tree.leaves(tree)))


def _first_order_exp(group: type[jaxlie.MatrixLieGroup], delta: Float[Array, " t"]) -> PyTree:
    if group is jaxlie.SO2:
        return jaxlie.SO2(jnp.concatenate([jnp.ones(1, delta.dtype), delta]))
    if group is jaxlie.SO3:
        return jaxlie.SO3(jnp.concatenate([jnp.ones(1, delta.dtype), delta / 2]))
    n, turn = (2, jaxlie.SO2) if group is jaxlie.SE2 else (3, jaxlie.SO3)
    return joined(_first_order_exp(turn, delta[n:]), delta[:n])


def _first_order_log(step: Pose | Rotation) -> Float[Array, " t"]:
    if isinstance(step, jaxlie.SO2):
        return step.unit_complex[1:]
    if isinstance(step, jaxlie.SO3):
        return jnp.asarray(step.wxyz[1:]) * 2
    return jnp.concatenate([step.translation(), _first_order_log(step.rotation())])


def _moved(tree: Tree, delta: Float[Array, " t"], move: Callable[[PyTree, Array], PyTree]) -> Tree:
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_pose)
    moved, start = [], 0
    for leaf, size in zip(leaves, _sizes(leaves), strict=True):
        part = delta[start : start + size]
        if not _is_pose(leaf):
            moved.append(leaf + part.reshape(leaf.shape))
        elif leaf.get_batch_axes():
            moved.append(jax.vmap(move)(leaf, part.reshape(-1, leaf.tangent_dim)))
        else:
            moved.append(move(leaf, part))
        start += size
    return jax.tree.unflatten(structure, moved)


def _compared(tree: PyTree, origin: PyTree, log: Callable[[PyTree], Array]) -> Float[Array, " t"]:
    leaves = jax.tree.leaves(tree, is_leaf=_is_pose)
    origins = jax.tree.leaves(origin, is_leaf=_is_pose)

    def compared(leaf, origin):
        if not _is_pose(leaf):
            return (leaf - origin).ravel()
        if leaf.get_batch_axes():
            return jax.vmap(lambda a, b: log(b.inverse() @ a))(leaf, origin).ravel()
        return log(origin.inverse() @ leaf)

    return jnp.concatenate([compared(*pair) for pair in zip(leaves, origins, strict=True)])
