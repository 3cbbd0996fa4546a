"""The part of a world that is measured: what a sensor sees, up to a limit."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxslam.models.sensors import AbstractSensor, Pinhole
from jaxslam.simulation.scenario import Scenario


def in_image(scenario: Scenario, points, pixels) -> Bool[Array, " l"]:
    """Whether a point is in front of the camera and inside the picture."""
    inside = jnp.all((pixels >= 0) & (pixels < jnp.stack(scenario.image)), axis=-1)
    return inside & (points[:, -1] > scenario.visible_depth)


def visible(s: Scenario, sensor: AbstractSensor, points, measured) -> Bool[Array, " l"]:
    """A camera sees what is in its picture; another sensor what is in its range."""
    if isinstance(sensor, Pinhole):
        return in_image(s, points, measured)
    (least, greatest), distance = s.range, jnp.linalg.norm(points, axis=-1)
    in_range = (distance >= least) & (distance <= greatest)
    return in_range & jax.vmap(sensor.possible)(points)


def limited(scenario: Scenario, key: Array, visible: Bool[Array, "frames l"]):
    """No more landmarks in a frame than the scenario allows, drawn at random."""
    frames, count = visible.shape
    first, new = scenario.first_landmarks or count, scenario.new_landmarks or count
    known = scenario.known_landmarks or count
    if min(first, new, known) >= count:
        return visible

    def frame(before, data):
        visible, order, most_new = data
        again = _at_most(visible & before, order, known)
        fresh = _at_most(visible & ~before, order, most_new)
        return before | fresh, again | fresh

    orders = jax.random.uniform(key, (frames, count))
    most_new = jnp.full(frames, new).at[0].set(first)
    return jax.lax.scan(frame, jnp.zeros(count, bool), (visible, orders, most_new))[1]


def _at_most(mask, order, count) -> Bool[Array, " l"]:
    """The `count` of the mask that come first in the order."""
    rank = jnp.argsort(jnp.argsort(jnp.where(mask, order, jnp.inf)))
    return mask & (rank < count)
