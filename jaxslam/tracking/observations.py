"""The tables of a frame, a row for each landmark: what is expected, and what was seen."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam.tracking.pose_with_covariance import Pixels

Table = TypeVar("Table", bound=tuple[Any, ...])
"""A named tuple of columns, each with as many rows."""
Slots = Int[np.ndarray, " k"]
"""The slots of k landmarks in the filter's map."""


class Lost(StrEnum):
    """The reasons why a camera is lost in a frame (docs/own-video.md)."""

    NOTHING_EXPECTED = "nothing expected"
    """No landmark of the map is expected in the picture, where it would look as it did."""
    FEW_AGREE = "few agree"
    """No more matches agree than would by chance."""
    CONTRADICTED = "contradicted"
    """The proven landmarks that were found do not tell one motion of the camera."""
    REFUSED = "refused"
    """The filter used none of the matches."""
    NOT_POSITIVE = "not positive"
    """The update's covariance was not positive."""
    NOT_FINITE = "not finite"
    """What the filter makes of the frame is no number."""
    REVERSED = "reversed"
    """Most of the map turned out to be behind the camera."""


def only(table: Table, which: np.ndarray) -> Table:
    """Some rows of a table, in the order given."""
    return type(table)(*(column[which] for column in table))


def joined(tables: Sequence[Table]) -> Table:
    """Several tables, at least one, as one."""
    return type(tables[0])(*map(np.concatenate, zip(*tables, strict=True)))


def distances(
    off: Float[np.ndarray, "k 2"], covariances: Float[np.ndarray, "k 2 2"]
) -> Float[np.ndarray, " k"]:
    """Squared distances `νᵀ S⁻¹ ν`."""
    return np.einsum("ki,ki->k", off, np.linalg.solve(covariances, off[..., None])[..., 0])


class Prediction(NamedTuple):
    """The view that the filter expects, a row for each slot of its map."""

    pixels: np.ndarray
    """(n, 2)."""
    covariances: np.ndarray
    """The covariances of the innovations, (n, 2, 2)."""
    usable: np.ndarray
    """Whether the slot holds a landmark in front of the camera, (n,)."""
    T_wc: np.ndarray
    """The predicted pose, (4, 4)."""
    points: np.ndarray
    """Homogeneous points (X, ω) in the predicted camera: X (n, 3)."""
    omegas: np.ndarray
    sides: tuple[int, int] = (0, 0)
    """How many landmarks are surely in front of the camera, and how many behind it."""


class Observations(NamedTuple):
    """The k landmarks that were searched in one frame, a row each."""

    slots: np.ndarray = np.zeros(0, int)
    """Their slots in the filter's map, (k,)."""
    predicted: np.ndarray = np.zeros((0, 2))
    """Pixels where they were expected, (k, 2)."""
    covariances: np.ndarray = np.zeros((0, 2, 2))
    """The covariances of the innovations, (k, 2, 2)."""
    pixels: np.ndarray = np.zeros((0, 2))
    """Where they were found, (k, 2); NaN where they were not."""
    variances: np.ndarray = np.zeros(0)
    """The variances of these pixels' u and v, pixels², (k,); zero where none was found."""
    labels: np.ndarray = np.zeros(0, "U9")
    """`matched`, `unmatched` or `outlier`, (k,): an outlier was found, and is not believed."""

    @property
    def matched(self) -> Bool[np.ndarray, " k"]:
        """Whether each was found and is believed."""
        return self.labels == "matched"

    @property
    def believed(self) -> Pixels:
        """The pixels of what is matched, NaN of the others."""
        return np.where(self.matched[:, None], self.pixels, np.nan)

    @property
    def places(self) -> Pixels:
        """The place of each, as far as is known: where it was matched, or else expected."""
        return np.where(self.matched[:, None], self.pixels, self.predicted)

    def labelled(self, label: str) -> Observations:
        """The rows of one label."""
        return only(self, self.labels == label)

    def with_new(self, pixels: Float[np.ndarray, "j 2"]) -> Observations:
        """The table and below it landmarks that begin at these pixels, `new`: nothing was expected
        there, and they have no slots."""
        count = len(pixels)
        nowhere, nothing = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
        labels = np.full(count, "new")
        new = Observations(np.full(count, -1), nowhere, nothing, pixels, np.zeros(count), labels)
        return joined([self, new])

    def but_for(self, used: Bool[np.ndarray, " k"]) -> Observations:
        """The table in which matches that the filter did not use are outliers."""
        return self._replace(labels=np.where(self.matched & ~used, "outlier", self.labels))


NOTHING = Observations()
"""The observations of a frame that was not searched."""
