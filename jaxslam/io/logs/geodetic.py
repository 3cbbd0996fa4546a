"""Positions on the Earth: RTKLIB's solutions, and the truth of inertial-satellite post-processing.

A pose is at its place in the Earth's frame (ECEF, WGS 84), and turned to its east, north and up,
so that errors along the axes of its body are those: `split`, `body`. It has no orientation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam.io.logs.log import Log, symmetric
from jaxslam.io.text import Table, rows_of
from jaxslam.io.tum import Times, transforms

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563
"""The ellipsoid of WGS 84: its radius at the equator, m, and its flattening."""
GPS_EPOCH = 315964800.0
"""Seconds of 1970-01-01 to 1980-01-06, from which GPS counts weeks; both without leap seconds."""
WEEK = 604800.0
SAID = {"error": "split", "axes": "body"}
NOTE = "x, y, z are east, north and up; times are those of GPS"
_RTKLIB = "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)"
_NOVATEL = re.compile(r"UTCTime\s+Week\s+GPSTime\s+Latitude\s+Longitude\s+H-Ell")


def read_rtklib(table: Table) -> Log | None:
    """Lines of a time in two cells, degrees, m, quality, and σ with signed roots of covariances;
    None of another table. Raises ValueError, naming the line."""
    if not any(" ".join(_RTKLIB.split()[:3]) in " ".join(line.split()) for line in table.comments):
        return None
    expected = f"finite numbers: a time of GPS in two cells, and {_RTKLIB}"
    if table.rows.shape[1] < 13:
        raise ValueError(f"{table.place(0)}: expected {expected}")
    times = _week_or_date(table, expected)
    told = table.numbers(expected, range(2, 13))
    latitude, longitude, height = told[:, 0], told[:, 1], told[:, 2]
    n, e, u, ne, eu, un = told[:, 5:].T
    roots = np.column_stack([e, n, u, ne, eu, un])
    places = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    P = symmetric(np.sign(roots) * roots**2, places)
    return _log(times, np.radians(latitude), np.radians(longitude), height, P)


def _week_or_date(table: Table, expected: str) -> Float[np.ndarray, " n"]:
    if 0 not in table.words:
        weeks, seconds = table.numbers(expected, [0, 1]).T
        return GPS_EPOCH + WEEK * weeks + seconds
    clock = table.words.get(1, ())
    try:
        both = zip(table.words[0], clock, strict=True)
        dates = [datetime.strptime(f"{d} {t}", "%Y/%m/%d %H:%M:%S.%f") for d, t in both]
    except ValueError:
        raise ValueError(f"{table.place(0)}: expected {expected}") from None
    return np.array([date.replace(tzinfo=UTC).timestamp() for date in dates])


def read_novatel(path: Path, lines: Mapping[int, str]) -> Log | None:
    """Lines of UTC, week, its second, and degrees, minutes, seconds of latitude and longitude,
    under their titles; None of another file. Raises ValueError, naming the line."""
    title = next((number for number, line in lines.items() if _NOVATEL.match(line)), None)
    if title is None:
        return None
    below = ((number, line) for number, line in lines.items() if number > title)
    told = {number: line.split()[:10] for number, line in below if line[0] not in "(#%"}  # units
    expected = "numbers: UTC, week, second, D M S of latitude and of longitude, height"
    values = rows_of(path, told, 10, expected)
    north, east = (_degrees(values[:, k : k + 3]) for k in (3, 6))
    times = GPS_EPOCH + WEEK * values[:, 1] + values[:, 2]
    found = np.radians(north), np.radians(east), values[:, 9]
    return _log(times, *found, np.empty((0, 6, 6)))


def _degrees(parts: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    whole, minutes, seconds = parts.T
    return np.copysign(np.abs(whole) + minutes / 60 + seconds / 3600, whole)


def _log(times: Times, north: Times, east: Times, height: Times, P: np.ndarray) -> Log:
    """Latitudes and longitudes in radians, and m above the ellipsoid."""
    square = FLATTENING * (2 - FLATTENING)
    radius = EQUATOR / np.sqrt(1 - square * np.sin(north) ** 2)
    (cn, sn), (ce, se) = ((np.cos(x), np.sin(x)) for x in (north, east))
    zero = np.zeros_like(sn)
    axes = (-se, ce, zero), (-sn * ce, -sn * se, cn), (cn * ce, cn * se, sn)
    along = (radius + height) * cn
    p = np.column_stack([along * ce, along * se, ((1 - square) * radius + height) * sn])
    T = transforms(np.moveaxis(np.array(axes), (0, 1, 2), (2, 1, 0)), p)
    return Log(times, T, P, SAID, (NOTE,), oriented=False, world="ECEF")
