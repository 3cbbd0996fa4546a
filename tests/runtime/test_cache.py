"""Commands keep their programs, the library does not, and what JAX was told comes first."""

from pathlib import Path

import jax
import pytest

import jaxslam.cli
from jaxslam._runtime import programs
from jaxslam.cli.cache import keep_programs

FOLDER, ENABLED = "jax_compilation_cache_dir", "jax_enable_compilation_cache"
LEAST = "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture
def told(monkeypatch, tmp_path):
    """JAX's configuration, of which nothing is set; it is put back as it was."""
    before = {name: getattr(jax.config, name) for name in (FOLDER, ENABLED, LEAST)}
    kept_in = programs._kept_in
    programs.keep_in(None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", raising=False)
    jax.config.update(FOLDER, None)
    jax.config.update(ENABLED, True)
    yield jax.config
    for name, value in before.items():
        jax.config.update(name, value)
    programs.keep_in(kept_in)


def test_programs_are_kept_in_the_users_cache_or_below_her_home(told, tmp_path, monkeypatch):
    keep_programs()
    assert getattr(told, FOLDER) == str(tmp_path / "cache" / "jaxslam")
    assert (tmp_path / "cache" / "jaxslam").is_dir()
    assert programs._kept_in == tmp_path / "cache" / "jaxslam"
    assert 0 < getattr(told, LEAST) < 1
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    told.update(FOLDER, None)
    keep_programs()
    assert getattr(told, FOLDER) == str(tmp_path / ".cache" / "jaxslam")


@pytest.mark.parametrize(
    ("setting", "kept_in"),
    [
        ((FOLDER, "/elsewhere"), Path("/elsewhere")),
        ((FOLDER, "gs://bucket/elsewhere"), None),
        ((ENABLED, False), None),
    ],
)
def test_what_jax_was_told_stays(told, tmp_path, setting, kept_in):
    told.update(*setting)
    keep_programs()
    assert getattr(told, setting[0]) == setting[1]
    assert programs._kept_in == kept_in
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_cannot_be_made_is_done_without(told, tmp_path):
    (tmp_path / "cache").write_text("a file")
    keep_programs()
    assert getattr(told, FOLDER) is programs._kept_in is None


def test_commands_keep_programs(monkeypatch, tmp_path):
    """An import sets nothing, as tests of the commands have it."""
    called = []
    monkeypatch.setattr("jaxslam.cli.cache.keep_programs", lambda: called.append(1))
    with pytest.raises(SystemExit):
        jaxslam.cli.main(["consistency", "--runs", "0", "--out", str(tmp_path)])
    assert called == [1]
