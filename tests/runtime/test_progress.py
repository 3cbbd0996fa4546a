"""What moves while one waits: bars for people, lines for files, nothing for what is short."""

import io
import sys
import time

from jaxslam._runtime import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def written(monkeypatch, file, patience=0.0):
    """What 20 steps write."""
    monkeypatch.setattr(sys, "stderr", file)
    monkeypatch.setattr(progress, "LINE_SECONDS", patience)
    with progress.bar(20, "run", "waiting") as shown:
        for _ in range(20):
            shown.update(1)
    return file.getvalue()


def test_a_terminal_has_a_bar_and_a_log_has_lines_unless_it_is_short(monkeypatch):
    text = written(monkeypatch, Terminal())
    assert "\r" in text
    assert "20/20" in text
    lines = written(monkeypatch, io.StringIO()).splitlines()
    assert "waiting" in lines[0]
    assert "20/20" in lines[-1]
    assert all(line.isprintable() and len(line) <= 80 for line in lines)
    assert written(monkeypatch, io.StringIO(), patience=10.0) == ""


def test_a_study_that_is_short_leaves_no_line_in_a_log(monkeypatch):
    """Nor does what is compiled in it."""
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    with progress.StudyBar(200) as move:
        for name, runs in (("a", 0), ("a", 0), ("a", 100), ("b", 0), ("b", 0), ("b", 100)):
            move(name, runs)
    with progress.warming_bar(3, "frame", "compiling", 2, "tracking") as update:
        update(3)
    with progress.bar(None, "frame") as shown:  # which needs no total
        shown.update(1)
        assert shown.n == 1
    assert log.getvalue() == ""


def test_what_is_long_has_a_line_in_a_log_while_it_is_compiled(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.2)
    with progress.StudyBar(200) as move:
        move("a", 0)
        patience = time.monotonic() + 60
        while not log.getvalue() and time.monotonic() < patience:
            time.sleep(0.05)
        (line,) = log.getvalue().splitlines()
        assert line.startswith("a, compiling: 0/200")
        move("a", 0)
        move("a", 200)
    assert "200/200" in log.getvalue().splitlines()[-1]


def test_no_time_is_left_to_tell_before_it_is_warm(monkeypatch):
    """A step of an hour, which compiles, says nothing of those that come after it."""
    now = [0.0]
    monkeypatch.setattr("time.time", lambda: now[0])
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.warming_bar(10, "frame", "compiling", 2, "tracking") as update:
        for seconds in (3600, 3600, 1, 1):
            now[0] += seconds
            update(1)
    cold, warm = terminal.getvalue().split("tracking", 1)
    assert "compiling: 1/10 [1:00:00]" in cold
    assert "<" not in cold.replace("0/10 [00:00<?", "")
    assert "4/10 [00:02<00:06" in warm


def test_a_study_says_what_is_compiled_and_where_it_goes_on(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.StudyBar(10, done=4) as move:
        move("a", 0)
        assert "a, compiling: 4/10" in terminal.getvalue()
        move("a", 0)
        move("a", 6)
    last = terminal.getvalue().split("\r")[-1]
    assert last.startswith("a: 100%")
    assert "10/10" in last
    assert last.endswith("\n")  # closed
    move = progress.StudyBar(4)
    for name, runs in (("a", 2), ("b", 2)):  # on a cluster
        move(name, runs)
    assert "b: 100%" in terminal.getvalue()


def test_the_time_left_of_a_study_is_that_of_its_runs(monkeypatch):
    """Neither an hour of compiling nor the runs of another filter are in it."""
    now = [0.0]
    monkeypatch.setattr("time.time", lambda: now[0])
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.StudyBar(40) as move:
        for seconds, name, runs in (
            (0, "a", 0), (3600, "a", 0), (5, "a", 10), (5, "a", 10),
            (1, "b", 0), (3600, "b", 0), (2, "b", 10), (0, "b", 5),
        ):  # fmt: skip
            now[0] += seconds
            move(name, runs)
    told = terminal.getvalue().split("\r")
    cold = [line.split("[")[1].strip() for line in told if "compiling" in line]
    assert cold == ["00:00]", "00:11]"]
    assert "a:  50%|#####     | 20/40 [00:10<00:10" in terminal.getvalue().replace("█", "#")
    assert "30/40 [00:02<00:02" in terminal.getvalue()
    assert not [line for line in told if "1:00:" in line]
