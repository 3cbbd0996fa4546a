"""What is refused: by one line that says what was wrong, in Python and by a command."""

import pytest

from jaxslam.cli import main


def refused(call, message, *given, **more):
    """The text of a ValueError, which is one line."""
    with pytest.raises(ValueError, match=message) as caught:
        call(*given, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def ended(message, words, out, capsys):
    """A command ends with status 2 and one line, in which this is, and writes nothing."""
    with pytest.raises(SystemExit) as stop:
        main([*words, "--out", str(out)])
    error = capsys.readouterr().err
    assert (stop.value.code, error.count("\n")) == (2, 1)
    assert message in error
    assert not out.is_dir()
