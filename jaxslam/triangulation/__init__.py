"""A point seen twice: what each parametrization makes of it, against the truth (Figs 1 and 2).

`compare(TwoViews(depth=15.0))`, then `summarise` and `table`, as `jaxslam triangulate` does.
"""

from jaxslam.triangulation.comparison import Comparison, compare, summarise, table
from jaxslam.triangulation.estimates import ESTIMATES, estimate, push
from jaxslam.triangulation.samples import Samples, distance, marginal, quantiles, shares_up_to
from jaxslam.triangulation.truth import particles
from jaxslam.triangulation.views import CALIBRATIONS, TwoViews, measure

__all__ = [
    "CALIBRATIONS",
    "ESTIMATES",
    "Comparison",
    "Samples",
    "TwoViews",
    "compare",
    "distance",
    "estimate",
    "marginal",
    "measure",
    "particles",
    "push",
    "quantiles",
    "shares_up_to",
    "summarise",
    "table",
]
