"""Planar and spatial geometry: one code for SE(2) and SE(3), and the manifold ⊞ and ⊟ on pytrees.

Frames: B is the base (world), C the camera. `T_ab` maps coordinates in b to coordinates in a.
Camera axes are x right, y down, z forward; the planar world drops y, so that a planar point is
(x, z) and a planar tangent is (x, z, θ), with θ turning from x towards z.

Perturbations are right perturbations: `T ⊞ δ = T Exp(δ)` and `T_b ⊟ T_a = Log(T_a⁻¹ T_b)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

Pose = jaxlie.SE2 | jaxlie.SE3


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
    def pixel_dim(self) -> int:
        """Coordinates of a pixel: u, or (u, v)."""
        return self.point_dim - 1

    @property
    def rotation_dim(self) -> int:
        """Degrees of freedom of an orientation: 1 or 3."""
        return self.tangent_dim - self.point_dim


PLANAR = Geometry("planar", jaxlie.SE2, 2)
SPATIAL = Geometry("spatial", jaxlie.SE3, 3)
GEOMETRIES = {geometry.name: geometry for geometry in (PLANAR, SPATIAL)}


def _is_pose(leaf: Any) -> bool:
    return isinstance(leaf, jaxlie.MatrixLieGroup)


def _sizes(leaves: list[Any]) -> list[int]:
    return [leaf.tangent_dim if _is_pose(leaf) else leaf.size for leaf in leaves]


def tangent_dim(tree: Any) -> int:
    """Size of the tangent of a pytree of poses and vectors, in the order of its leaves."""
    return sum(_sizes(jax.tree.leaves(tree, is_leaf=_is_pose)))


def retract(tree: Any, delta: Float[Array, " t"]) -> Any:
    """`tree ⊞ δ`: poses by `T Exp(δ)`, vectors by addition, δ split in the order of the leaves."""
    return _moved(tree, delta, lambda T, part: T @ type(T).exp(part))


def difference(tree: Any, origin: Any) -> Float[Array, " t"]:
    """`tree ⊟ origin`, the inverse of `retract`: `retract(origin, difference(tree, origin))`."""
    return _compared(tree, origin, lambda step: step.log())


def jacobian(function: Callable[[Any], Any], tree: Any) -> Float[Array, "k t"]:
    """Jacobian of `δ ↦ f(x ⊞ δ) ⊟ f(x)` at δ = 0, by `jax.jacfwd`."""
    value = function(tree)

    def error(delta):
        return _compared(function(nudge(tree, delta)), value, _first_order_log)

    return jax.jacfwd(error)(zero_tangent(tree))


def nudge(tree: Any, delta: Float[Array, " t"]) -> Any:
    """`retract` to first order, `T (I + δ^)`: the same derivative at δ = 0, and only there.

    Jacobians are taken through it: without the trigonometry of Exp and its guards they compile
    and run in less than half the time, and no division by |δ| can make a NaN.
    """
    return _moved(tree, delta, lambda T, part: T @ _first_order_exp(type(T), part))


def zero_tangent(tree: Any) -> Float[Array, " t"]:
    """δ = 0, in the dtype of the tree."""
    return jnp.zeros(tangent_dim(tree), jnp.result_type(*jax.tree.leaves(tree)))


def _first_order_exp(group: type[Pose], delta: Float[Array, " t"]) -> Pose:
    one = jnp.ones(1, delta.dtype)
    if group is jaxlie.SE2:
        rotation = jaxlie.SO2(jnp.concatenate([one, delta[2:]]))
        return jaxlie.SE2.from_rotation_and_translation(rotation, delta[:2])
    rotation = jaxlie.SO3(jnp.concatenate([one, delta[3:] / 2]))
    return jaxlie.SE3.from_rotation_and_translation(rotation, delta[:3])


def _first_order_log(step: Pose) -> Float[Array, " t"]:
    rotation = step.rotation()
    if isinstance(rotation, jaxlie.SO2):
        return jnp.concatenate([step.translation(), rotation.unit_complex[1:]])
    return jnp.concatenate([step.translation(), 2 * rotation.wxyz[1:]])


def _moved(tree: Any, delta: Float[Array, " t"], move: Callable[[Pose, Array], Pose]) -> Any:
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_pose)
    moved, start = [], 0
    for leaf, size in zip(leaves, _sizes(leaves), strict=True):
        part = delta[start : start + size]
        moved.append(move(leaf, part) if _is_pose(leaf) else leaf + part)
        start += size
    return jax.tree.unflatten(structure, moved)


def _compared(tree: Any, origin: Any, log: Callable[[Pose], Array]) -> Float[Array, " t"]:
    leaves = jax.tree.leaves(tree, is_leaf=_is_pose)
    origins = jax.tree.leaves(origin, is_leaf=_is_pose)
    parts = [
        log(o.inverse() @ leaf) if _is_pose(leaf) else leaf - o
        for leaf, o in zip(leaves, origins, strict=True)
    ]
    return jnp.concatenate(parts)
