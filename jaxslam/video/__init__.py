"""Videos: where they come from, what camera filmed them, and how one is calibrated."""

from jaxslam.video.opening import open_source
from jaxslam.video.source import Frame, Image, Source, Trajectory

__all__ = ["Frame", "Image", "Source", "Trajectory", "open_source"]
