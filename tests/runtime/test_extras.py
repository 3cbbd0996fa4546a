"""Where an extra is missing, the error names one that there is, for a release and for a clone."""

import ast
import sys
import tomllib
from pathlib import Path

import pytest

import jaxslam
from jaxslam._runtime.progress import bar
from jaxslam.cli import main

PACKAGE = Path(jaxslam.__file__).parent
PROJECT = Path(__file__).parents[2] / "pyproject.toml"


@pytest.mark.parametrize("command", ["track", "calibrate"])
def test_a_command_that_looks_at_pictures_names_the_vision_extra(command, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SystemExit) as ended:
        main([command, "nowhere.mp4"])
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].endswith(
        "ing needs the vision extra (cv2 is missing): pip install 'jaxslam[vision]', "
        "or in a clone pip install '.[vision]'"
    )


def test_a_tracker_without_opencv_names_the_vision_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("tracker", "start", "corners"):  # as before they were first imported
        monkeypatch.delitem(sys.modules, f"jaxslam.tracking.{name}", raising=False)
    with pytest.raises(ValueError, match=r"a Tracker needs the vision extra \(cv2 is missing\)"):
        jaxslam.Tracker  # noqa: B018


@pytest.mark.parametrize("library", ["tyro", "tqdm"])
def test_the_command_line_without_its_libraries_names_the_cli_extra(library, monkeypatch, capsys):
    for module in ("jaxslam.cli.commands", "jaxslam.cli.evaluate"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    main(["--version"])
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "nowhere.npz"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == (
        f"jaxslam: the command line needs the cli extra ({library} is missing): "
        "pip install 'jaxslam[cli]', or in a clone pip install '.[cli]'\n"
    )


def test_a_bar_without_tqdm_names_the_cli_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ValueError, match=r"a progress bar needs the cli extra \(tqdm"):
        bar(3, "run")


def calls():
    """Extras that calls of `missing` name."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "missing":
                yield ast.literal_eval(node.args[1])


def test_every_extra_that_an_error_names_is_one_of_the_projects_and_the_core_brings_few():
    named, project = set(calls()), tomllib.loads(PROJECT.read_text())["project"]
    assert named >= {"cli", "vision", "viewer", "cluster"}
    assert named <= set(project["optional-dependencies"])
    assert {name.partition(">")[0] for name in project["dependencies"]} <= {
        "equinox", "jax", "jaxlie", "jaxtyping", "matplotlib", "numpy", "optimistix", "scipy",
    }  # fmt: skip


def test_how_an_extra_is_installed_is_said_in_one_place():
    saying = [path.name for path in PACKAGE.rglob("*.py") if "'jaxslam[" in path.read_text()]
    assert saying == ["extras.py"]
