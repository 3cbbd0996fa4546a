"""`jaxslam track`: a camera through a video."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackOptions:
    """Options of the command."""

    def run(self) -> None:
        """Track."""
