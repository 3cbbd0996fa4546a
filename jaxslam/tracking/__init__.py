"""A camera tracked through a video, and what is written of it; needs the extra `vision`."""

from itertools import chain

from jaxslam._runtime import exported

_NAMES = {
    "report": ("Tracked",),
    "tracker": ("Tracker",),
    "settings": ("TrackerSettings",),
    "video": ("track",),
    "summary": ("describe",),
    "synthetic": ("synthetic_source",),
    "pointcloud": ("read_ply", "seen_from"),
    "target": ("read_target",),
    "trajectory": ("absolute_trajectory_error", "relative_pose_error"),
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [*chain(*_NAMES.values())]
__getattr__ = exported(__name__, _NAMES)
