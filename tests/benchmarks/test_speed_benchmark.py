"""Tests of benchmarks/speed: all who are compared compute the same."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import pytest

from benchmarks.speed.__main__ import AGREEMENT, difference, without_pose
from benchmarks.speed.dynamax_ekf import TOLERANCE, by_dynamax, missing
from benchmarks.speed.eigen import build, by_hand
from benchmarks.speed.loop import by_loop
from benchmarks.speed.study import study_of
from benchmarks.speed.workload import WORKLOADS, filters_of, ours, prepared, scenario_of


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The program in C++, or why there is none."""
    return build(tmp_path_factory.mktemp("eigen"))


@pytest.mark.parametrize("name", ["A", pytest.param("B", marks=pytest.mark.slow)])
def test_everybody_computes_the_same_filter(name, library):
    """And a covariance or NEES that is off by a millionth is a difference."""
    work = dataclasses.replace(WORKLOADS[name].reduced(2, 3), landmarks=5)
    with jax.enable_x64(True):
        inputs = prepared(work)
        wanted = nees, P = ours(inputs)()
        for wrong in ((nees, P * (1 + 1e-6)), (nees * (1 + 1e-6), P)):
            assert difference(wrong, wanted) > AGREEMENT
        assert difference(by_loop(inputs)(), wanted) < AGREEMENT
        if isinstance(library, str):
            pytest.skip(library)
        assert difference(by_hand(library, inputs)(), wanted) < AGREEMENT


def test_dynamax_computes_the_same_but_for_the_pose():
    pytest.importorskip("dynamax")
    with jax.enable_x64(True):
        inputs = prepared(dataclasses.replace(WORKLOADS["A"].reduced(2, 3), landmarks=5))
        assert missing(inputs) is None
        both = map(without_pose, (by_dynamax(inputs)(), ours(inputs)()))
        assert difference(*both) < TOLERANCE


def test_it_is_said_why_dynamax_is_not_measured(monkeypatch):
    (slam,) = filters_of(scenario_of(WORKLOADS["B"])).values()
    inputs: Any = SimpleNamespace(slam=slam)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert missing(inputs) == "dynamax is not installed"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    assert missing(inputs) == "only planar"


@pytest.mark.slow
def test_a_study_of_the_workload_is_whole(monkeypatch):
    """One that ran fewer runs or steps would seem fast."""
    asked = []
    monkeypatch.setattr("jaxslam.summarise", lambda study: asked.append(study) or {"filters": {}})
    study_of(dataclasses.replace(WORKLOADS["A"].reduced(4, 2), landmarks=3), "xla", chunk=3)()
    (study,) = asked
    assert (study.runs, study.scenario.steps, study.scenario.landmarks) == (4, 2, 3)
    assert [len(chunk) for chunk in study.chunks] == [3, 1]
