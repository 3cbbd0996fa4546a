"""`jaxslam consistency`: many simulated runs of every chosen filter on the same worlds."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from jaxslam._runtime import plotted
from jaxslam._runtime.programs import in_background
from jaxslam.consistency import FolderStore, Study, check_sizes, monte_carlo
from jaxslam.consistency.backends import AUTO, check_backend
from jaxslam.consistency.montecarlo import CHUNK, Interruption
from jaxslam.filters.words import FILTERS, MODIFIERS, make_filters
from jaxslam.landmarks import LANDMARKS
from jaxslam.simulation import BUILT_IN, World, scenario
from jaxslam.simulation.scenario import parse_override


@dataclass(frozen=True)
class ConsistencyOptions:
    """Simulate many runs of filters: are they consistent?"""  # noqa: D400

    scenario: Annotated[
        str,
        tyro.conf.arg(
            metavar="NAME",
            help="A TOML file with the fields of a scenario; handheld-NAME for a trajectory in "
            "$JAXSLAM_DATA/trajectories (or any TUM file with --set "
            f"trajectory=FILE); or one of: {', '.join(BUILT_IN)}.",
        ),
    ] = "circle"
    landmarks: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME …", help=f"Parametrizations: {', '.join(LANDMARKS)}."),
    ] = ("inverse_scaling", "inverse_depth")
    filters: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="NAME …",
            help=f"Filters: {', '.join(FILTERS)}. Modifiers can be added in any order, as in "
            f"scale_gauge+mixture9: {', '.join(MODIFIERS)}, some with a number.",
        ),
    ] = ("robocentric",)
    calibration: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """How filters treat the calibration: white, consider, estimated or known. Default: that of the
    scenario."""
    runs: int = 1000
    """Number of independent runs of every filter."""
    steps: int | None = None
    """Filter steps per run. Default: that of the scenario."""
    seed: int = 0
    """Random seed; run i depends on the seed and i alone."""
    dtype: str = "float64"
    """Precision: float64 or float32."""
    chunk: int | None = None
    """Runs computed and stored together. Memory grows with it; results do not depend on it. By
    default so many that every processor has several chunks, of at most 100."""
    backend: str = AUTO
    """Backend: xla, native (a C++ program, which needs a compiler), or auto: native if the study is
    long enough, and with --resume the backend of the interrupted run."""
    resume: bool = False
    """Continue an interrupted run from what it left in --out."""
    reduce: bool = False
    """Store sums over the runs of each chunk instead of every run, so that files do not grow with
    the number of runs in a chunk. Medians are then those of the first chunk."""
    cluster: str | None = None
    """Address of a running Dask scheduler, such as tcp://127.0.0.1:8786, whose workers compute the
    chunks. Needs the cluster extra."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FIELD=VALUE …")] = field(
        default_factory=tuple
    )
    """Override scenario fields, for example pixel_sigma=1 or velocity=[1.2,0,0]."""
    out: Path = Path("results")
    """Output folder for consistency.json, consistency.png and the records of all runs."""
    pdf: bool = False
    """Also write consistency.pdf, one column (3.4 in) wide for print, with embedded fonts."""

    def run(self) -> None:
        """Run the study, print its table, write its files."""
        in_background(partial(plotted, "plot_consistency"))  # imported while it is computed
        study = self.study()
        study.save(self.out)
        study.plot(self.out / "consistency.png")
        if self.pdf:
            study.plot(self.out / "consistency.pdf", column=True)
        print(study.table())
        print(f"wrote {self.out / 'consistency.json'} and {self.out / 'consistency.png'}")

    def study(self, world: World | None = None) -> Study:
        """Run the study, of another world than the options name where one is given."""
        check_sizes(self.runs, self.seed, self.dtype, CHUNK if self.chunk is None else self.chunk)
        check_backend(self.backend)
        world = self._scenario() if world is None else world
        filters = make_filters(world, self.filters, self.landmarks, self.calibration)
        store = FolderStore(self.out / "runs", resume=self.resume)
        log = logging.getLogger("jaxslam")
        log.setLevel(logging.INFO)
        with logging_redirect_tqdm([log]):
            try:
                return monte_carlo(
                    world, filters, runs=self.runs, seed=self.seed, dtype=self.dtype,
                    chunk=self.chunk, backend=self.backend, store=store, progress=True,
                    cluster=self.cluster, reduced=self.reduce,
                )  # fmt: skip
            except Interruption as end:
                again = "the same command" + ("" if self.resume else " with --resume")
                told = end.told(f"{self.out}", f"{again} goes on from there", "a smaller --chunk")
                raise KeyboardInterrupt(told) from None

    def _scenario(self) -> World:
        overrides: dict[str, object] = dict(parse_override(text) for text in self.set)
        if self.steps is not None:
            overrides["steps"] = self.steps
        return scenario(self.scenario, overrides)
