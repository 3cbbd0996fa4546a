"""The threads of BLAS, which wait for one another where matrices are small."""

from __future__ import annotations

import numpy  # noqa: F401  # libraries are limited that are loaded
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

in_one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")
"""A decorator: NumPy's and SciPy's products and factorisations in the function take one thread. On
two processors of which one is busy, two threads for a hundred rows take half as long again."""
