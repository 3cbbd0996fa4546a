"""A camera tracked through a video, and what is written of it; needs the extra `vision`."""

from jaxslam._runtime import exported

_MODULES = {
    "Tracked": "report",
    "Tracker": "tracker",
    "TrackerSettings": "settings",
    "track": "video",
    "describe": "summary",
    "synthetic_source": "synthetic",
    "read_ply": "pointcloud",
    "read_target": "target",
    "seen_from": "pointcloud",
    "absolute_trajectory_error": "trajectory",
    "relative_pose_error": "trajectory",
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [*_MODULES]
__getattr__ = exported(__name__, _MODULES)
