"""That types and shapes are checked in every kind of a call, whatever was called before."""

import sys
from importlib import import_module

import jaxtyping
import numpy as np
import pytest

MODULE = '''
from __future__ import annotations

from jaxtyping import Float
import numpy as np


def cut(x: Float[np.ndarray, " n"], y: list[str], *, named: int = 1) -> Float[np.ndarray, " n"]:
    """What it returns may have another shape, by the values."""
    called.append(1)
    return x if x[0] > 0 else x[1:]


def many(x: Float[np.ndarray, " n"]) -> list[int]:
    return int(x[0]) * [1] if x[0] < 100 else 40 * ["1"]


def both(two: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]):
    return two[0] + two[1]


def within(x: Float[np.ndarray, " n"], count: int) -> Float[np.ndarray, " n"]:
    def added(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return a + b

    return added(x, x[:count])


called = []
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "some_checked_module.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    with jaxtyping.install_import_hook("some_checked_module", "beartype.beartype"):
        module = import_module("some_checked_module")
    del sys.modules["some_checked_module"]
    return module


def refused(function, *args, **named):
    """Each time, whatever was remembered the first time."""
    for _ in range(2):
        with pytest.raises(jaxtyping.TypeCheckError):
            function(*args, **named)


def test_arguments_and_results_of_other_kinds_are_checked(module):
    x = np.ones(3)
    for number in (1, 2, 3):
        assert module.cut(x, ["a"]) is x
        assert len(module.called) == number  # not by its check as well
    refused(module.cut, x[None], ["a"])
    refused(module.cut, x.astype(int), ["a"])
    refused(module.cut, x, ["a"], named="1")
    refused(module.cut, x, [1])
    refused(module.cut, x, 50 * [1])
    refused(module.cut, -x, ["a"])
    assert module.cut(x, 50 * ["a"]) is x
    assert module.cut(x, ["a"], named=2) is x
    module.both((x, x))
    refused(module.both, (x, x[:2]))
    refused(module.both, (x, x, x))
    for count in (40, 1, 2, 50):
        assert len(module.many(count * x)) == count
    refused(module.many, 100 * x)
    np.testing.assert_array_equal(module.within(x, 3), 2 * x)
    refused(module.within, x, 1)


def test_unchecked_nothing_is_checked_or_remembered(module, unchecked):
    assert len(module.cut(-np.ones(3), "a")) == 2
    jaxtyping.config.update("jaxtyping_disable", False)
    refused(module.cut, -np.ones(3), "a")
