"""Figures, drawn by matplotlib without its global state."""

from itertools import chain

from jaxslam._runtime import exported

_NAMES = {
    "consistency": ("plot_consistency",),
    "evaluation": ("plot_evaluation",),
    "triangulation": ("plot_triangulation",),
    "world": ("plot_world",),
    "landmarks": ("draw_ellipses",),
    "style": ("COLOURS", "GREY", "line_style", "new_figure"),
}
"""Where each name is that is imported only when it is asked for."""
__all__ = [*chain(*_NAMES.values())]
__getattr__ = exported(__name__, _NAMES)
