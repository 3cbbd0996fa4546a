"""Figures, drawn by matplotlib without its global state."""

from jaxslam._runtime import exported

_MODULES = {
    "plot_consistency": "consistency",
    "plot_evaluation": "evaluation",
    "plot_triangulation": "triangulation",
    "plot_world": "world",
    "draw_ellipses": "landmarks",
    "COLOURS": "style",
    "GREY": "style",
    "line_style": "style",
    "new_figure": "style",
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [*_MODULES]
__getattr__ = exported(__name__, _MODULES)
