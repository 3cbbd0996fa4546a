"""SQUARE, the format of smfeval: `#%KEY value` headers, a pose and a lower triangle a line."""

from __future__ import annotations

import numpy as np

from jaxslam.io.logs.log import NAMES, Log, log, symmetric_or_none
from jaxslam.io.text import Table

_KNOWN = {
    "TANGENT_CONVENTION": {"right_perturbation": "right", "left_perturbation": "left"},
    "TANGENT_ORDER": {
        "translation_rotation": "position-first", "rotation_translation": "rotation-first",
    },
    "ROTATION_PARAM": {"axis_angle": "axis_angle"},
    "TIMESTAMP_UNIT": {name: unit for unit, name in reversed(NAMES.items())},
}  # fmt: skip
"""The values of its headers that are read, and what they are here; the first is the default."""


def read(table: Table) -> Log | None:
    """The poses and covariances of a table with such headers; None of another. Raises ValueError,
    naming the header, for a value that is not known."""
    pairs = (line.split(maxsplit=1) for line in table.comments if line)
    headers = {pair[0].lstrip("%"): pair[-1].strip() for pair in pairs}
    if not headers.get("FORMAT", "").startswith("SQUARE"):
        return None
    if table.rows.shape[1] != 29:
        raise ValueError(f"{table.place(0)}: expected 29 numbers, t, p, q and a lower triangle")
    said = {}
    for key, values in _KNOWN.items():
        value = headers.get(key, next(iter(values)))
        if value not in values:
            raise ValueError(
                f"{table.path}: the header {key} is {value}; expected {' or '.join(values)}"
            )
        said[key] = values[value]
    P = symmetric_or_none(table, table.rows[:, 8:], np.argwhere(np.tri(6)))
    convention = {"error": said["TANGENT_CONVENTION"], "order": said["TANGENT_ORDER"]}
    result = log(table, table.rows[:, :8], P, convention, said["TIMESTAMP_UNIT"])
    world, body = (headers.get(f"{x}_FRAME", "") for x in ("POSE", "BODY"))
    return result._replace(world=world, body=body)
