"""Planar and spatial geometry: one code for SE(2) and SE(3), and the manifold ⊞ and ⊟ on pytrees.

Frames: B is the base (world), C the camera. `T_ab` maps coordinates in b to coordinates in a.
Camera axes are x right, y down, z forward; the planar world drops y, so that a planar point is
(x, z) and a planar tangent is (x, z, θ), with θ turning from x towards z.

Perturbations are right perturbations: `T ⊞ δ = T Exp(δ)` and `T_b ⊟ T_a = Log(T_a⁻¹ T_b)`.
"""

from __future__ import annotations

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
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_pose)
    moved, start = [], 0
    for leaf, size in zip(leaves, _sizes(leaves), strict=True):
        part = delta[start : start + size]
        moved.append(leaf @ type(leaf).exp(part) if _is_pose(leaf) else leaf + part)
        start += size
    return jax.tree.unflatten(structure, moved)


def difference(tree: Any, origin: Any) -> Float[Array, " t"]:
    """`tree ⊟ origin`, the inverse of `retract`: `retract(origin, difference(tree, origin))`."""
    leaves = jax.tree.leaves(tree, is_leaf=_is_pose)
    origins = jax.tree.leaves(origin, is_leaf=_is_pose)
    parts = [
        (o.inverse() @ leaf).log() if _is_pose(leaf) else leaf - o
        for leaf, o in zip(leaves, origins, strict=True)
    ]
    return jnp.concatenate(parts)
