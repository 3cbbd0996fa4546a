"""Where a video comes from: a camera, a file, or a data set; one file of this room a layout."""

from jaxslam.vision.sources.opening import open_source
from jaxslam.vision.sources.source import Frame, Image, Source, Trajectory

__all__ = ["Frame", "Image", "Source", "Trajectory", "open_source"]
