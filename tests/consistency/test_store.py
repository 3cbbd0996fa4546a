"""Tests of what is kept of studies: never two mixed, and nobody else's files touched."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from cases import FourFunctions

import jaxslam
from jaxslam.consistency import FolderStore, MemoryStore, manifest, simulator
from jaxslam.consistency.manifest import described, difference
from jaxslam.consistency.store import NATIVE
from jaxslam.io.tum import write_tum

SCENARIO = jaxslam.scenario("matched-tight", steps=2, landmarks=3)
SLAM: Any
(SLAM,) = jaxslam.make_filters(SCENARIO, "robocentric", "inverse_scaling").values()
RECORDS = {"nees": np.arange(4.0).reshape(2, 2), NATIVE: np.array(False)}
CHUNK = range(2)


def study(store, name="mine", slam=SLAM, scenario=SCENARIO, **given):
    sizes: dict[str, Any] = {"runs": 2, "chunk": 2, **given}
    return jaxslam.monte_carlo(scenario, {name: slam}, store=store, **sizes)


class Begun(Exception):
    """Where a study would be computed."""


def begin(store, monkeypatch, **given):
    """A study that ends where its first run would be drawn, and what is kept of it by hand."""
    with monkeypatch.context() as context:
        context.setattr(simulator.Simulator, "room", raised)
        with pytest.raises(Begun):
            study(store, **given)
    store.save(given.get("name", "mine"), CHUNK, RECORDS)


def raised(*_):
    raise Begun


def stores(kind, folder):
    """One after another, of the same place."""
    kept = MemoryStore()
    return lambda: kept if kind == "memory" else FolderStore(folder / "runs", resume=True)


@pytest.mark.parametrize("kind", ["memory", "folder"])
def test_a_store_of_another_study_is_refused(kind, tmp_path, monkeypatch):
    """Without a run: it is before the first that is computed."""
    store = stores(kind, tmp_path)
    begin(store(), monkeypatch)
    noisy = eqx.tree_at(lambda slam: slam.sensor.sigma, SLAM, np.float64(0.7))
    for message, changed in (
        (r"another seed \(0, now 1\)", {"seed": 1}),
        (r"another dtype \('float64', now 'float32'\)", {"dtype": "float32"}),
        (r"another chunk \(2, now 1\)", {"chunk": 1}),
        (r"another scenario\.steps \(2, now 3\)", {"scenario": replace(SCENARIO, steps=3)}),
        (r"another reduced \(False, now True\)", {"reduced": True}),
        (r"another backend \('xla', now 'native'\)", {"backend": "native"}),
        (r"another filter mine: sensor\.sigma \(.*, now 0\.7\)", {"slam": noisy}),
        (
            r"another scenario\.motion\.noise_sigma",
            {"motion": replace(SLAM.motion, noise_sigma=np.ones(3))},
        ),
    ):
        with pytest.raises(ValueError, match=message):
            study(store(), **changed)
    for package in ("jaxslam", "jax", "jaxlib"):
        newer = {**manifest.versions(), package: "99"}
        monkeypatch.setattr(simulator, "versions", lambda told=newer: told)
        with pytest.raises(ValueError, match=rf"another version\.{package} \(.*, now '99'\)"):
            study(store())
    monkeypatch.undo()
    again = study(store())
    assert again.seconds["mine"].run == 0
    np.testing.assert_array_equal(again.store.load("mine", CHUNK)["nees"], RECORDS["nees"])


def test_another_file_of_the_same_trajectory_is_refused(tmp_path, monkeypatch):
    def written(speed):
        poses = np.tile(np.eye(4), (12, 1, 1))
        poses[:, 0, 3] = speed * np.arange(12)
        path = tmp_path / "path.txt"
        write_tum(path, np.arange(12) / 10, poses)
        few = {"steps": 3, "rate": 10.0, "landmarks": 3}
        return jaxslam.scenario("matched-6dof", few, trajectory=str(path))

    store = MemoryStore()
    begin(store, monkeypatch, scenario=written(1.0))
    with pytest.raises(ValueError, match=r"another scenario\.trajectory\.poses"):
        study(store, scenario=written(1.1))
    study(store, scenario=written(1.0))


def test_every_name_has_a_folder_of_its_own(tmp_path):
    store = FolderStore(tmp_path)
    names = ["mine/a", "mine-a", "mine%2Da", "mine.a", "MINE/a", "é", "", "-", "/", ".", ".."]
    for i, name in enumerate(names):
        assert not store.has(name, CHUNK)
        store.save(name, CHUNK, {"nees": RECORDS["nees"] + i})
    for i, name in enumerate(names):
        np.testing.assert_array_equal(store.load(name, CHUNK)["nees"], RECORDS["nees"] + i)
    folders = [path.parent for path in tmp_path.rglob("*.npz")]
    assert len({str(path).lower() for path in folders}) == len(names)
    assert all(path.parent == tmp_path for path in folders)


def test_only_chunks_that_the_manifest_names_are_deleted(tmp_path):
    FolderStore(tmp_path).save("mine", CHUNK, RECORDS)
    own = tmp_path / "mine" / "0000000-0000001.npz"
    begun = tmp_path / "mine" / ".123.0000002-0000003.npz"
    others = [
        tmp_path / "mine" / "notes.npz",
        tmp_path / "data" / "flight.npz",
        tmp_path / "data" / "0000000-0000001.npz",
        tmp_path / "data" / ".123.0000000-0000001.npz",
    ]
    for path in (*others, begun):
        path.parent.mkdir(exist_ok=True)
        path.write_text("somebody's")
    FolderStore(tmp_path, resume=True)
    assert own.exists()
    assert not begun.exists()
    FolderStore(tmp_path)
    assert not own.exists()
    assert [path.read_text() for path in others] == ["somebody's"] * 4


def test_nobody_elses_file_is_written_over_or_read(tmp_path):
    path = tmp_path / "mine" / "0000000-0000001.npz"
    path.parent.mkdir()
    np.savez(path, nees=RECORDS["nees"])
    before, store = path.read_bytes(), FolderStore(tmp_path)
    assert not store.has("mine", CHUNK)
    for written in (lambda: study(store), lambda: store.save("mine", CHUNK, RECORDS)):
        with pytest.raises(ValueError, match=r"0000000-0000001.npz is of no study that is kept"):
            written()
    assert path.read_bytes() == before


@pytest.mark.parametrize("text", ['{"name": "my app"}', '{"layout": 5, "seed": 0}', "[]"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_manifest_of_something_else_is_left_alone(text, resume, tmp_path):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=r"manifest\.json: is no manifest of this version"):
        FolderStore(tmp_path, resume=resume)
    assert (tmp_path / "manifest.json").read_text() == text


def test_more_runs_and_more_filters_go_on_in_the_same_folder(tmp_path, monkeypatch):
    begin(FolderStore(tmp_path), monkeypatch)
    begin(FolderStore(tmp_path, resume=True), monkeypatch, name="other", runs=4)
    store = FolderStore(tmp_path, resume=True)
    found = [store.has(n, c) for n in ("mine", "other") for c in (CHUNK, range(2, 4))]
    assert found == [True, False, True, False]
    with pytest.raises(ValueError, match=r"cannot resume: .* another seed"):
        study(store, name="third", seed=5)
    with pytest.raises(ValueError, match=r"cannot resume: .* another of_mine"):
        FolderStore(tmp_path, {"of_mine": 1}, resume=True)


def adds(n):
    return lambda x: x + n


def test_a_description_is_the_same_in_every_process_and_tells_functions_apart():
    program = (
        "import json, jaxslam; from jaxslam.consistency.manifest import described;"
        "made = jaxslam.make_filters('standstill-6dof', 'recommended', 'inverse_depth');"
        "print(json.dumps(described(made)))"
    )
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    made = jaxslam.make_filters("standstill-6dof", "recommended", "inverse_depth")
    assert difference(json.loads(told.stdout), json.loads(json.dumps(described(made)))) is None
    told_apart: list[Any] = [lambda x: x + 1, lambda x: x - 1, adds(1), adds(2)]
    told_apart += [np.zeros(100), np.zeros((10, 10)), np.ones(100), np.array([1.0]), 1, (1, 2)]
    texts = {json.dumps(described(x)) for x in told_apart}
    assert len(texts) == len(told_apart)
    assert difference({"a": float("nan")}, {"a": float("nan")}) is None


USERS = """
import math
import equinox as eqx
import helper
FACTOR = 2
def bent(x):
    return math.sin(x) + FACTOR
class Sonar(eqx.Module):
    sigma: float = 0.1
    def measure(self, x):
        return [bent(y) + helper.offset(y) for y in x]
"""
TOLD = "import json, mine; from jaxslam.consistency.manifest import described; "
TOLD += "print(json.dumps([described(x()) for x in (Sonar, mine.Sonar)]))"


def test_a_piece_of_the_users_is_the_same_wherever_it_is_written(tmp_path):
    """In a script, in a module, and in a notebook."""
    (tmp_path / "helper.py").write_text("def offset(x):\n    return x\n")
    (tmp_path / "mine.py").write_text(USERS)
    (tmp_path / "script.py").write_text(f"{USERS}\n{TOLD}\n")
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}

    def described_by(*words):
        told = subprocess.run(
            [sys.executable, "-B", *words, "script.py"], check=True, capture_output=True, text=True,
            cwd=tmp_path, env=env,
        )  # fmt: skip
        return json.loads(told.stdout.splitlines()[-1])

    script, module = described_by()
    assert difference(script, module) is None
    pytest.importorskip("IPython")
    assert difference(script, described_by("-m", "IPython", "--no-banner", "--quick")[0]) is None


def of_source(source):
    space: dict[str, Any] = {"__name__": "users"}
    exec(source, space)
    return space["f"]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("def f(x): return g(x)\ndef g(x): return x", "def f(x): return g(x)\ndef g(x): return -x"),
        ("a = 1\nf = lambda x: x + a", "a = 2\nf = lambda x: x + a"),
        ("def f(x, y=1): return y", "def f(x, y=2): return y"),
        ("import jax\ng = jax.jit(lambda x: x)\ndef f(x): return [g(y) for y in x]",
         "import jax\ng = jax.jit(lambda x: -x)\ndef f(x): return [g(y) for y in x]"),
        ("class A:\n  def g(self): return 1\na = A()\ndef f(x): return a.g()",
         "class A:\n  def g(self): return 2\na = A()\ndef f(x): return a.g()"),
        ("def f(x): return f(x - 1)", "def f(x): return f(x - 2)"),
    ],
)  # fmt: skip
def test_what_a_function_calls_is_a_part_of_it(before, after):
    assert described(of_source(before)) == described(of_source(before))
    assert difference(*map(described, map(of_source, (before, after))))


def test_code_that_cannot_be_seen_is_named(tmp_path, monkeypatch):
    source = "import ctypes\nfast = ctypes.CDLL(None).abs\ndef f(x): return fast(getattr(x, 'y'))"
    function: Any = of_source(source)
    assert manifest.unseen(described(function)) == {"abs(…)", "getattr(…) in f"}
    assert not manifest.unseen(described(SLAM))

    with pytest.warns(UserWarning, match=r"not seen: abs\(…\), getattr\(…\) in f; .* resumed"):
        begin(FolderStore(tmp_path), monkeypatch, slam=FourFunctions(SLAM, function))
