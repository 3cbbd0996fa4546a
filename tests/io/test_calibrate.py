"""A camera is calibrated from a rendered video of a board, and says how surely."""

import json

import cv2
import numpy as np
import pytest
from pictures import jpeg
from refusals import ended
from scipy.spatial.transform import Rotation

from jaxslam.cli import main
from jaxslam.io.board import Board, View, sharpness
from jaxslam.io.calibrate import calibrate, covered, different, drawn_coverage
from jaxslam.io.calibration import Calibration
from jaxslam.io.lens_files import read_calibration
from jaxslam.tracking.synthetic import add_noise

CAMERA = Calibration(480, 360, 430.0, 428.0, 233.0, 184.0)
PIXELS = 24
"""Of a square in the drawing."""
BOARDS = [Board("checkerboard", 9, 6, 0.03), Board("charuco", 7, 5, 0.04, "4X4_50")]


def poses(board, count, seed=0):
    """T_camera_board of a board tilted up to 40° that fills a third of the picture or more."""
    draw = np.random.default_rng(seed)
    middle = board.square * np.array([board.columns / 2, board.rows / 2, 0])
    for _ in range(count):
        turn = Rotation.from_rotvec(draw.uniform(-0.7, 0.7, 3) * (1, 1, 0.4)).as_matrix()
        distance = board.square * board.columns * draw.uniform(1.0, 1.7)
        shift = distance * np.array([*draw.uniform(-0.22, 0.22, 2), 1.0]) - turn @ middle
        yield turn, shift


def rendered(board, turn, shift, noise, blur=0.0):
    """The drawing as the camera sees it; a margin of one square is around the board."""
    side = board.square / PIXELS
    offset = -board.square + side / 2  # of the centre of the drawing's first pixel
    to_board = np.array([[side, 0, offset], [0, side, offset], [0, 0, 1]])
    zoom = np.array([[3, 0, 1], [0, 3, 1], [0, 0, 1]])  # three times as fine, then averaged
    H = zoom @ CAMERA.matrix @ np.column_stack([turn[:, :2], shift]) @ to_board
    size = (CAMERA.width, CAMERA.height)
    image = cv2.warpPerspective(board.drawn(PIXELS), H, (3 * size[0], 3 * size[1]), borderValue=90)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
    return add_noise(image, noise, 1.5)


@pytest.fixture(scope="module", params=BOARDS, ids=lambda board: board.kind)
def filmed(request, tmp_path_factory):
    """A folder of pictures of a board, a few of them blurred, one without it."""
    board, path = request.param, tmp_path_factory.mktemp(request.param.kind)
    noise = np.random.default_rng(1)
    for index, (turn, shift) in enumerate(poses(board, 18)):
        image = rendered(board, turn, shift, noise, blur=4.0 * (index in (5, 11)))
        cv2.imwrite(str(path / f"{index:02d}.png"), image)
    cv2.imwrite(str(path / "99.png"), np.full((CAMERA.height, CAMERA.width), 90, np.uint8))
    return board, path


@pytest.fixture(scope="module")
def calibrated(filmed):
    board, path = filmed
    return calibrate(path, board)


def test_the_camera_is_found_within_three_of_its_own_sigma(calibrated):
    found = calibrated.calibration
    for name, sigma in zip(("fx", "fy", "cx", "cy"), found.sigma, strict=True):
        error = getattr(found, name) - getattr(CAMERA, name)
        assert abs(error) < 3 * sigma, name
        # A σ that is true of everything says nothing.
        assert 0 < sigma < 0.01 * CAMERA.fx
    for value, sigma in zip(found.distortion, calibrated.distortion_sigma, strict=True):
        assert abs(value) < 3 * sigma
    assert 0 < calibrated.rms < 0.3
    assert len(calibrated.views) >= 10


@pytest.mark.parametrize("filmed", BOARDS[1:], indirect=True, ids=["charuco"])
def test_photographs_that_are_turned_differently_are_of_one_sensor(filmed, calibrated, tmp_path):
    board, path = filmed
    for index, file in enumerate(sorted(path.iterdir())):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        (tmp_path / f"{file.stem}.jpg").write_bytes(jpeg(image, (1, 3, 6)[index % 3]))
    with pytest.warns(UserWarning, match="all are taken as the sensor saw them"):
        found = calibrate(tmp_path, board).calibration
    assert (found.width, found.height) == (CAMERA.width, CAMERA.height)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(found, name) == pytest.approx(getattr(calibrated.calibration, name), abs=0.5)


def test_blurred_pictures_are_left_out(filmed, calibrated):
    board, path = filmed
    blurred = [board.find(cv2.imread(str(path / f"{i:02d}.png"), 0)) for i in (5, 11)]
    least = min(view.sharpness for view in calibrated.views)
    assert all(view is None or view.sharpness < least for view in blurred)


def test_the_corners_are_where_the_camera_sees_them():
    noise = np.random.default_rng(2)
    for board in BOARDS:
        turn, shift = next(poses(board, 1, seed=4))
        view = board.find(rendered(board, turn, shift, noise))
        assert view is not None
        seen = (CAMERA.matrix @ (turn @ view.points.T + shift[:, None])).T
        # A checkerboard may be read from its other end.
        errors = min(
            (pixels - seen[:, :2] / seen[:, 2:] for pixels in (view.pixels, view.pixels[::-1])),
            key=lambda errors: np.abs(errors).max(),
        )
        # Half a pixel of the drawing or of the picture would be seen; not refined, it is 0.1.
        assert np.abs(errors.mean(axis=0)).max() < 0.03
        assert np.sqrt(np.mean(errors**2)) < 0.06


def view_at(x, sharp):
    outline = np.array([(x, 0.0), (x + 50, 0), (x + 50, 50), (x, 50)])
    nothing = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)
    return View(*nothing, outline, sharp)


def test_views_are_sharp_and_as_different_as_can_be():
    views = [view_at(x, s) for x, s in ((0, 0.4), (1, 0.45), (100, 0.4), (40, 0.4), (60, 0.1))]
    chosen = different(views, (300, 400), count=2)
    # The sharpest first, then the farthest from it; the blurred one never.
    assert [view.outline[0, 0] for view in chosen] == [1, 100]
    chosen = different(views, (300, 400))
    assert [view.outline[0, 0] for view in chosen] == [1, 100, 40]
    assert different([], (300, 400)) == []


def test_sharpness_does_not_depend_on_the_contrast():
    image = np.zeros((60, 60), np.uint8)
    image[:, 30:] = 200
    corner = np.array([[29.5, 30.0]], np.float32)
    assert sharpness(image, corner) == pytest.approx(0.5, abs=0.01)
    assert sharpness(image // 2, corner) == pytest.approx(0.5, abs=0.01)
    blurred = sharpness(cv2.GaussianBlur(image, (0, 0), 2.0), corner)
    # The slope of a blurred edge is 1/(σ √(2π)).
    assert blurred == pytest.approx(1 / (2 * np.sqrt(2 * np.pi)), rel=0.1)


def test_coverage_is_the_share_of_cells_with_a_corner(calibrated):
    cells = covered(calibrated.views, CAMERA)
    assert calibrated.coverage == cells.mean()
    assert 0.5 < calibrated.coverage <= 1
    image = drawn_coverage(calibrated)
    assert image.shape == (CAMERA.height, CAMERA.width, 3)
    u, v = np.rint(calibrated.views[0].pixels[0]).astype(int)
    assert np.ptp(image[v, u].astype(int)) > 100  # a colour
    one = calibrated.views[0]._replace(pixels=np.array([[479.4, -0.4]], np.float32))
    assert np.argwhere(covered([one], CAMERA)).tolist() == [[0, 9]]


@pytest.mark.parametrize("filmed", BOARDS[1:], indirect=True, ids=["charuco"])
def test_the_command_writes_what_the_tracker_reads(filmed, calibrated, tmp_path, capsys):
    board, path = filmed
    size = ["--columns", str(board.columns), "--rows", str(board.rows)]
    kind = ["--board", board.kind, "--dictionary", board.dictionary]
    main(["calibrate", str(path), *kind, *size, "--out", str(tmp_path)])
    assert read_calibration(tmp_path / "calibration.json").fx == pytest.approx(
        calibrated.calibration.fx, rel=1e-3
    )
    written = json.loads((tmp_path / "calibration.json").read_text())
    assert written["views"] == len(calibrated.views)
    assert written["reprojection_rms"] == pytest.approx(calibrated.rms, rel=1e-3)
    assert len(written["sigma"]["distortion"]) == 5
    assert (tmp_path / "coverage.png").read_bytes().startswith(b"\x89PNG")
    assert f"{len(calibrated.views)} views, reprojection error" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["checkerboard", "charuco"])
def test_without_a_video_the_board_is_drawn_to_be_printed(kind, tmp_path):
    main(["calibrate", "--board", kind, "--out", str(tmp_path)])
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    view = Board(kind).find(image)
    assert view is not None
    # Squares of 100 pixels after a margin of one; a pixel's centre is at a whole number.
    expected = np.sort(view.points[:, :2] / 0.025 * 100 + 99.5, axis=0)
    np.testing.assert_allclose(np.sort(view.pixels, axis=0), expected, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--board", "dots"], "unknown board 'dots'; known: checkerboard, charuco"),
        (["--columns", "3"], "at least 4x4 squares, not 3x7"),
        (["--square", "0"], "square must be a positive length, not 0.0 m"),
        (["--dictionary", "7Y7"], "unknown dictionary '7Y7'"),
        (["--columns", "13"], "0 pictures show the whole board of 13x7 squares"),
    ],
)
def test_a_mistake_ends_with_status_2_and_one_line(options, message, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((CAMERA.height, CAMERA.width), np.uint8))
    ended(message, ["calibrate", str(tmp_path), *options], tmp_path / "out", capsys)
