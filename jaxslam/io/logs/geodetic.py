"""Positions on the Earth: RTKLIB's solutions, and the truth of inertial-satellite post-processing.

A pose is at its place in the Earth's frame (ECEF, WGS 84), and turned to its east, north and up,
so that errors along the axes of its body are those: `split`, `body`. It has no orientation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxslam.io.logs.log import GPS_EPOCH, WEEK, Log, symmetric
from jaxslam.io.text import Table, table_of
from jaxslam.io.tum import Times, transforms

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563
"""The ellipsoid of WGS 84: its radius at the equator, m, and its flattening."""
SAID = {"error": "split", "axes": "body"}
ENU, GPS_TIME = "x, y, z are east, north and up", "times are those of GPS"
_RTKLIB = {
    "latitude(deg) longitude(deg) height(m)": "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)",
    "x-ecef(m) y-ecef(m) z-ecef(m)": "sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)",
    "e-baseline(m) n-baseline(m) u-baseline(m)": "sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m)",
}
"""The titles of RTKLIB's positions, and those of their σ and signed roots of covariances."""
_LEAPS = (1230768000.0, 1341100800.0, 1435708800.0, 1483228800.0)
"""When GPS has been 15, 16, 17 and 18 s ahead of UTC since, in seconds of UTC."""
_NOVATEL = re.compile(r"UTCTime\s+Week\s+GPSTime\s+Latitude\s+Longitude\s+H-Ell")


def read_rtklib(table: Table) -> Log | None:
    """Lines of a time in two cells, a position, quality, and σ with signed roots of covariances;
    None of another table. Raises ValueError, naming the line.

    Positions are geodetic, of the Earth's frame, or from the base station, as the titles say.
    """
    titles = [re.sub(r"[\s,;]+", " ", line) for line in table.comments]
    found = [(line, places) for line in titles for places in _RTKLIB if f"{places} Q" in line]
    if not found:
        return None
    line, places = found[0]
    expected = f"finite numbers: a time in two cells, and {places} Q ns {_RTKLIB[places]}"
    weeks = table.rows[:, 0].max() < WEEK  # which are in two cells, as dates are not
    told = table.numbers(expected, range(12 + weeks))
    if line.startswith("UTC"):
        told[:, 0] += 14 + np.searchsorted(_LEAPS, told[:, 0])
    times = GPS_EPOCH + WEEK * told[:, 0] + told[:, 1] if weeks else told[:, 0]
    p, roots = told[:, 1 + weeks :][:, :3], told[:, 6 + weeks :]
    geodetic = places.startswith("latitude")
    roots = roots[:, [1, 0, 2, 3, 5, 4]] if geodetic else roots
    P = symmetric(np.sign(roots) * roots**2, [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)])
    if geodetic:
        return on_earth(times, p, P)
    world = "ECEF" if places.startswith("x") else "east, north and up"
    T, notes = transforms(np.tile(np.eye(3), (len(p), 1, 1)), p), (f"x, y, z are {world}", GPS_TIME)
    return Log(times, T, P, SAID | {"axes": "world"}, notes, oriented=False, world=world)


def read_novatel(path: Path, lines: Mapping[int, str]) -> Log | None:
    """Lines of UTC, week, its second, and degrees, minutes, seconds of latitude and longitude,
    under their titles; None of another file. Raises ValueError, naming the line."""
    title = next((number for number, line in lines.items() if _NOVATEL.match(line)), None)
    if title is None:
        return None
    below = ((number, line) for number, line in lines.items() if number > title)
    told = {number: line for number, line in below if line[0] != "("}  # units
    expected = "numbers: UTC, week, second, D M S of latitude and of longitude, height"
    values = table_of(path, told, "positions", expected).numbers(expected, range(10))
    parts = (values[:, k : k + 3].T for k in (3, 6))
    north, east = (np.copysign(np.abs(d) + m / 60 + s / 3600, d) for d, m, s in parts)
    times = GPS_EPOCH + WEEK * values[:, 1] + values[:, 2]
    return on_earth(times, np.column_stack([north, east, values[:, 9]]), np.empty((0, 6, 6)))


def on_earth(times: Times, places: Float[np.ndarray, "n 3"], P: np.ndarray) -> Log:
    """The log of latitudes and longitudes in degrees, and m above the ellipsoid."""
    north, east, height = *np.radians(places[:, :2]).T, places[:, 2]
    square = FLATTENING * (2 - FLATTENING)
    radius = EQUATOR / np.sqrt(1 - square * np.sin(north) ** 2)
    (cn, sn), (ce, se) = ((np.cos(x), np.sin(x)) for x in (north, east))
    zero = np.zeros_like(sn)
    axes = (-se, ce, zero), (-sn * ce, -sn * se, cn), (cn * ce, cn * se, sn)
    along = (radius + height) * cn
    p = np.column_stack([along * ce, along * se, ((1 - square) * radius + height) * sn])
    T = transforms(np.moveaxis(np.array(axes), (0, 1, 2), (2, 1, 0)), p)
    return Log(times, T, P, SAID, (ENU, GPS_TIME), oriented=False, world="ECEF")
