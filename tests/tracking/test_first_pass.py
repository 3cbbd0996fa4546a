"""Tests of jaxslam.tracking.first_pass: a lens that is guessed is found by the first frames."""

from dataclasses import replace

import numpy as np
import pytest
from rendered_videos import rendered_source

from jaxslam.io.calibration import from_field_of_view
from jaxslam.io.source import Frame
from jaxslam.tracking.first_pass import combined, finds_lens, with_lens_found
from jaxslam.tracking.focal import BetterLens
from jaxslam.tracking.settings import TrackerSettings

GUESS = from_field_of_view(480, 360)


def test_guess_and_bundle_are_weighed_by_their_sigma():
    here = replace(GUESS, fx=380.0, fy=380.0, distortion=(-0.1, 0.01))
    found = combined(GUESS, here, BetterLens(1.04, 0.02, np.array([1e-3, 1e-3]), 0.8))
    np.testing.assert_allclose([found.fx, found.fy], 380 * 1.04, rtol=1e-3)
    np.testing.assert_allclose(found.distortion[:2], [-0.08, 0.01], atol=1e-4)
    assert found.guessed
    assert found.sigma[2:] == GUESS.sigma[2:]
    # Three times the bundle's, whose errors are not independent.
    np.testing.assert_allclose(found.sigma[:2], 3e-3 * found.fx, rtol=1e-3)
    # σ of 0.15 and of 0.075: a fifth and four fifths of the information.
    wide = combined(GUESS, here, BetterLens(1.04, 0.02, np.array([0.025, 0.05]), 0.8))
    np.testing.assert_allclose(wide.fx, GUESS.fx**0.2 * (380 * 1.04) ** 0.8, rtol=1e-3)
    assert combined(GUESS, here, BetterLens(1.0, 0.0, np.full(2, np.inf), 1.0)) is GUESS


def test_it_is_of_guesses_that_are_estimated_alone():
    source = rendered_source("turn", 0, 1)
    guessed = replace(source, calibration=GUESS)
    assert finds_lens(guessed, TrackerSettings())
    assert not finds_lens(source, TrackerSettings())
    assert not finds_lens(replace(guessed, clock=lambda: 0.0), TrackerSettings())
    assert not finds_lens(guessed, TrackerSettings(calibration="consider"))
    assert not finds_lens(guessed, TrackerSettings(readout=0.02))


def test_a_picture_that_cannot_be_read_is_no_matter_of_the_first_pass(tmp_path):
    def unread():
        raise ValueError("image 0 cannot be read")
        yield Frame

    source = replace(rendered_source("turn", 0, 1), calibration=GUESS, images=unread)
    assert with_lens_found(source, TrackerSettings(), tmp_path).calibration == GUESS


@pytest.mark.slow
def test_the_lens_of_a_walk_with_a_turn_is_found(tmp_path):
    """From a guess 4 % off the filter alone ends 4 % off, and says 0.4 %: what no test of the
    combination alone would see."""
    source = replace(rendered_source("turn+barrel", 3, 100), calibration=GUESS)
    found = with_lens_found(source, TrackerSettings(), tmp_path).calibration
    assert abs(found.fx - 394) < 2 * found.sigma[0] < 24
    assert abs(found.distortion[0] + 0.08) < 0.02
