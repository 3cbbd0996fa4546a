"""Covariances of poses as text: a time and the upper triangle a line (docs/covariance-format.md).

Comments say of which error they are, in words `key=value` on any line of them: `error`, `axes`,
`order` and `scale` of a `Convention`, `angle=rad` or `deg`, `length` with the unit's name.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxslam._runtime.lookup import lookup, suggestion
from jaxslam.evaluation.convention import CHOICES, Convention
from jaxslam.geometry import SPATIAL
from jaxslam.io.tum import read_table, write_table

ANGLES = {"rad": 1.0, "deg": np.pi / 180}
"""Units of angles, in radians."""
_KEYS = (*CHOICES, "angle", "length")
_ROWS, _COLUMNS = np.triu_indices(6)


class CovarianceText(NamedTuple):
    """What a file says: angles in radians, lengths in the file's own unit."""

    times: Float[np.ndarray, " n"]
    covariances: Float[np.ndarray, "n 6 6"]
    said: dict[str, str]
    """The words of its header that are of a `Convention`."""

    @property
    def convention(self) -> Convention:
        """What the header says, and where it says nothing the default."""
        return Convention(**self.said)


def write_covariances(
    path: str | Path,
    times: ArrayLike,
    covariances: ArrayLike,
    convention: Convention,
    *,
    length: str = "m",
    remark: str = "",
) -> None:
    """Write times (n,) in seconds and covariances (n, 6, 6), of m and rad, whole or not at all.

    `length` names another unit of length, in one word; the `remark` is for people.
    """
    table = np.asarray(covariances, dtype=float).reshape(-1, 6, 6)[:, _ROWS, _COLUMNS]
    names = convention.names(SPATIAL)
    pairs = " ".join(f"{names[i]}{names[j]}" for i, j in zip(_ROWS, _COLUMNS, strict=True))
    remark = f"; {remark}" if remark else ""
    header = f"{pairs} ({convention} angle=rad length={length}{remark})"
    write_table(path, header, times, table, "covariances", ".9e")


def read_covariances(path: str | Path) -> CovarianceText:
    """What `write_covariances` wrote, or somebody else.

    Raises `ValueError`, naming the file, for a line that is not 22 finite numbers, or a word of the
    header that is not known.
    """
    row = "22 finite numbers, the time and the upper triangle row by row,"
    comments, rows, _ = read_table(path, "covariances", "covariances", row, 1 + len(_ROWS))
    try:
        said = _said(" ".join(comments))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    covariances = np.zeros((len(rows), 6, 6))
    covariances[:, _ROWS, _COLUMNS] = covariances[:, _COLUMNS, _ROWS] = rows[:, 1:]
    unit, said = ANGLES[said.pop("angle", "rad")], {k: v for k, v in said.items() if k in CHOICES}
    scale = np.array([unit if name.startswith("r") else 1.0 for name in _names(said)])
    return CovarianceText(rows[:, 0], scale[:, None] * covariances * scale, said)


def _names(said: dict[str, str]) -> tuple[str, ...]:
    return Convention(**said).names(SPATIAL)


def _said(comments: str) -> dict[str, str]:
    """The words `key=value` of a header. Raises ValueError for those that nobody understands."""
    said = dict(re.findall(r"\b([a-z]+)=([^\s,;()]+)", comments))
    for key in said:
        if meant := suggestion(key, _KEYS) if key not in _KEYS else "":
            raise ValueError(f"unknown key {key!r} in the header{meant}; known: {', '.join(_KEYS)}")
    known = {**CHOICES, "angle": tuple(ANGLES)}
    for key in known.keys() & said.keys():
        lookup(key, [said[key]], dict.fromkeys(known[key]))
    return {key: value for key, value in said.items() if key in _KEYS}
