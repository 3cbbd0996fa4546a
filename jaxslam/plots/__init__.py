"""Figures, drawn by matplotlib without its global state."""

from importlib import import_module
from typing import Any

_MODULES = {
    "plot_consistency": "consistency",
    "plot_evaluation": "evaluation",
    "plot_triangulation": "triangulation",
    "plot_landmark_clouds": "landmarks",
    "Laid": "frames",
    "plot_frames": "frames",
    "COLOURS": "style",
    "GREY": "style",
    "line_style": "style",
    "new_figure": "style",
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [
    "COLOURS",
    "GREY",
    "Laid",
    "line_style",
    "new_figure",
    "plot_consistency",
    "plot_evaluation",
    "plot_frames",
    "plot_landmark_clouds",
    "plot_triangulation",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
