"""What a tracker makes of the calibration that it is given, and what it says of it."""

import numpy as np
import pytest

from jaxslam._runtime.programs import _Call, exactly
from jaxslam.io.calibration import LENS_SIGMA, Calibration, from_field_of_view
from jaxslam.models.calibration import Estimated, Known, White
from jaxslam.tracking import summary
from jaxslam.tracking.landmarks import Points
from jaxslam.tracking.settings import TrackerSettings
from jaxslam.tracking.tracker import Tracker

STATED = Calibration(640, 480, 500.0, 500.0, 320.0, 240.0, sigma=(4.0, 3.0, 2.0, 1.0))
PLAIN = Calibration(640, 480, 500.0, 500.0, 320.0, 240.0)
GUESSED = from_field_of_view(640, 480)
NO_POINTS = Points(*[np.zeros(0, int)] * 3, np.zeros((0, 3)), *[np.zeros((0, 3, 3))] * 2)


@pytest.mark.parametrize(
    ("name", "calibration", "kind", "sigma"),
    [
        (None, PLAIN, Estimated, (1.5, 0.96, 0.96)),
        (None, STATED, Estimated, (4.0, 3.0, 2.0, 1.0)),
        (None, GUESSED, Estimated, (GUESSED.sigma[0], 12.8, 12.8, *LENS_SIGMA)),
        ("known", GUESSED, Known, ()),
        ("white", PLAIN, White, (0.7, 0.7, 0.6, 0.6)),
        ("white", GUESSED, White, (GUESSED.sigma[0], 12.8, 12.8, *LENS_SIGMA)),
    ],
)
def test_a_calibration_is_estimated_and_stated_sigmas_are_used(name, calibration, kind, sigma):
    settings = TrackerSettings(filter="world", calibration=name, focal_sigma=0.7, centre_sigma=0.6)
    treatment = settings.treatment(calibration)
    assert type(treatment) is kind
    np.testing.assert_allclose(treatment.sigma, sigma, rtol=1e-12)
    assert TrackerSettings(filter="recommended") == TrackerSettings()


def test_all_guesses_have_one_set_of_programs_and_so_have_all_lenses_without_sigma():
    """What is told of a lens is data: another size, field of view or σ compiles nothing anew."""

    def programs(*calibrations):
        filters = [TrackerSettings().make_filter(calibration) for calibration in calibrations]
        return {exactly(_Call.of((slam,)).key) for slam in filters}

    guesses = programs(GUESSED, from_field_of_view(640, 480, 50.0), from_field_of_view(1280, 720))
    given = programs(PLAIN, Calibration(320, 240, 250.0, 260.0, 160.0, 120.0))
    assert len(guesses) == len(given) == 1
    # One state has two numbers more than the other, k1 and k2.
    assert guesses != given


def of_camera(calibration, treatment):
    settings = TrackerSettings(filter="world", wanted=10, calibration=treatment)
    return Tracker(calibration, settings)


def test_an_estimated_or_considered_lens_is_told_with_its_sigma(monkeypatch):
    """Of one that was guessed no better one is looked for."""
    monkeypatch.setattr(summary, "better_lens", None)
    for treatment in ("consider", "estimated"):
        tracker = of_camera(GUESSED, treatment)
        lens = summary._lens(tracker)
        told = summary._calibration(tracker, lens, [], NO_POINTS)
        assert (told["treatment"], told["estimated"]["fx"]) == (treatment, GUESSED.fx)
        assert told["sigma"]["fx"] == pytest.approx(GUESSED.sigma[0])
        assert ("caveat" in told) == (treatment == "estimated")
    assert list(lens) == ["fx", "fy", "cx", "cy", "k1", "k2"]
    assert lens["k1"] == {"value": 0.0, "sigma": pytest.approx(0.15)}
