"""A filter that believes only what agrees: for measurements of which some are wrong."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from jaxslam._runtime.lookup import lookup
from jaxslam.filters.association import ASSOCIATIONS, TOLERANCE, candidates
from jaxslam.filters.layer import AbstractLayer
from jaxslam.models.sensors import noises


class Gate(AbstractLayer):
    """A gate: updates are by the features that an `Association` believes; others count as not
    seen."""

    association: str = eqx.field(static=True, default="sequential")
    """A name of ASSOCIATIONS."""
    tolerance: float = eqx.field(static=True, default=TOLERANCE)
    """σ by which a match may be off beyond its noise, in σ of each of its numbers."""

    def __check_init__(self) -> None:
        lookup("association", [self.association], ASSOCIATIONS)

    def update(self, slam, state, control, seen):
        one, gaussian = slam.inner.gaussian(state, control)
        R = noises(slam.sensor, seen.measured)
        sigmas = jnp.sqrt(jnp.diagonal(R, axis1=-2, axis2=-1))
        found = candidates(one, gaussian, control, seen, self.tolerance * sigmas)
        agreed = ASSOCIATIONS[self.association](found)
        return slam.inner.update(state, control, replace(seen, valid=agreed))
