"""A filter that believes only what agrees: for measurements of which some are wrong."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from jaxslam._runtime.lookup import lookup
from jaxslam.filters.association import ASSOCIATIONS, TOLERANCE, candidates
from jaxslam.filters.ekf import ekf_inside
from jaxslam.filters.protocol import AbstractStaged, Belief, Corrected
from jaxslam.filters.wrappers.wrapper import AbstractWrapper
from jaxslam.models.motion import Control
from jaxslam.models.observations import Features


class Gated(AbstractWrapper):
    """`base`, whose updates are by the features that an `Association` believes; its state."""

    base: AbstractStaged
    association: str = eqx.field(static=True, default="sequential")
    """A name of ASSOCIATIONS."""
    tolerance: float = eqx.field(static=True, default=TOLERANCE)
    """σ by which a match may be off beyond its noise, in that."""

    def __check_init__(self) -> None:
        lookup("association", [self.association], ASSOCIATIONS)
        ekf_inside(self.base, "features are checked")

    def update(self, state: Belief, control: Control, seen: Features) -> Corrected:
        """Correct by what agrees; the others count as not seen."""
        one, gaussian = self.base.gaussian(state, control)
        noise = ekf_inside(self.base, "features are checked").sensor.noise
        tolerance = self.tolerance * jnp.sqrt(noise[0, 0])
        found = candidates(one, gaussian, control, seen, tolerance)
        agreed = ASSOCIATIONS[self.association](found)
        return self.base.update(state, control, replace(seen, valid=agreed))
