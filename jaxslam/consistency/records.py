"""A Parquet file with every step of every run as a row, for tools that read tables.

    filter, run, step, time, nees, beyond_scale, …, error_x, …, variance_x, …

The rows of a chunk are a row group, so that a study of any size is written within the memory of
one. What made the file (scenario, seed, precision, version) is the metadata `jaxslam`, in JSON.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam._runtime.extras import missing
from jaxslam._runtime.files import write_atomically
from jaxslam.consistency.store import Records
from jaxslam.consistency.summary import Study

AXES = {
    "planar": ("x", "z", "rotation"),
    "spatial": ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z"),
}
"""The axes of `error` and `variance`: the camera's position in its axes, m; orientation, rad."""


def write_records(study: Study, path: str | Path) -> None:
    """Write the records of `filter_run`, one row for every step of every run.

    The columns are the filter's name, the run, the step (from 1), its time in s, and one for every
    number. Raises ValueError for a name that does not end in .parquet, without the parquet extra,
    and for a reduced study, which has no such records.
    """
    path = check_records(path)
    if study.reduced:
        raise ValueError("a reduced study keeps sums, no records of every run to write")
    import pyarrow as pa
    import pyarrow.parquet as parquet

    made_by = {b"jaxslam": json.dumps(_made_by(study)).encode()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as temporary:
        writer = None
        for columns in _row_groups(study):
            group = pa.table(columns)
            if writer is None:
                schema = group.schema.with_metadata(made_by)
                writer = parquet.ParquetWriter(temporary, schema, compression="zstd")
            writer.write_table(group)
        assert writer is not None, "a study has a filter and a run"
        writer.close()


def check_records(path: str | Path) -> Path:
    """Return the path, if it can be written. Raises ValueError."""
    path = Path(path)
    if path.suffix != ".parquet":
        raise ValueError(f"records are written as Parquet, FILE.parquet, not as {path.name}")
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise missing("records need", "parquet", error) from None
    return path


def _made_by(study: Study) -> dict[str, Any]:
    from jaxslam._version import __version__

    scenario = dataclasses.asdict(study.scenario)
    return {
        "version": __version__,
        "scenario": scenario,
        "runs": study.runs,
        "seed": study.seed,
        "dtype": study.dtype,
    }


def _row_groups(study: Study) -> Iterator[dict[str, Any]]:
    import pyarrow as pa

    names = list(study.filters)
    for number, name in enumerate(names):
        for chunk in study.chunks:
            columns = _columns(study, chunk, study.store.load(name, chunk))
            which = pa.array(np.full(len(columns["run"]), number, np.int32))
            yield {"filter": pa.DictionaryArray.from_arrays(which, names), **columns}


def _columns(study: Study, chunk: range, records: Records) -> dict[str, np.ndarray]:
    steps = np.arange(1, study.scenario.steps + 1, dtype=np.int32)
    columns = {
        "run": np.repeat(np.asarray(chunk, np.int64), steps.size),
        "step": np.tile(steps, len(chunk)),
        "time": np.tile(steps / study.scenario.rate, len(chunk)),
    }
    for name, values in records.items():
        if name.startswith("sample_"):
            continue
        if values.ndim == 2:
            columns[name] = values.ravel()
            continue
        axes = AXES[study.scenario.world.name]
        for axis, of_axis in zip(axes, np.moveaxis(values, -1, 0), strict=True):
            columns[f"{name}_{axis}"] = of_axis.ravel()
    return columns
