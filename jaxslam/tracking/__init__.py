"""A camera tracked through a video, and what is written of it; needs the extra `vision`."""

from importlib import import_module
from typing import Any

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
__all__ = [
    "Tracked",
    "Tracker",
    "TrackerSettings",
    "absolute_trajectory_error",
    "describe",
    "read_ply",
    "read_target",
    "relative_pose_error",
    "seen_from",
    "synthetic_source",
    "track",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
