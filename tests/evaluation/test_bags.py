"""A bag of ROS is evaluated as the arrays in it are; what it lacks is said in one line."""

import sys

import numpy as np
import pytest
from bags import EPOCH, KINDS, ros_of, write_bag
from recordings import path_at
from recordings import write as write_path
from scipy.spatial.transform import Rotation

import jaxslam
from jaxslam import Convention
from jaxslam.evaluation import write_covariances
from jaxslam.io import write_tum

STEPS = 30
TIMES = np.arange(STEPS) / 10
STAMPS = EPOCH + TIMES
SIGMA = np.array([0.1, 0.02, 0.05, 0.01, 0.03, 0.002])
SPLIT = Convention("split", "world")
IDENTITY = np.eye(4)


def run(seed=0, factor=1.0):
    """Estimates with covariances in ROS' convention, and truths."""
    position, turn = path_at(TIMES)
    truth = np.tile(np.eye(4), (STEPS, 1, 1))
    truth[:, :3, :3], truth[:, :3, 3] = turn.as_matrix(), 20 * position
    draw = np.random.default_rng(seed)
    mixed = np.eye(6) + 0.2 * draw.normal(size=(6, 6))
    root = factor * SIGMA[:, None] * mixed
    noise = draw.normal(size=(STEPS, 6)) @ root.T / factor
    estimate = truth.copy()
    estimate[:, :3, 3] -= noise[:, :3]
    back = Rotation.from_rotvec(-noise[:, 3:]).as_matrix()
    estimate[:, :3, :3] = back @ truth[:, :3, :3]
    return estimate, np.tile(root @ root.T, (STEPS, 1, 1)), truth


ESTIMATE, P, TRUTH = run()


def odometry(r, poses=ESTIMATE, covariances=P, stamps=STAMPS):
    told = zip(stamps, poses, covariances, strict=True)
    return [r.odometry(t, T, cov) for t, T, cov in told]


def poses(r, T=TRUTH, stamps=STAMPS):
    return [r.pose_stamped(t, pose) for t, pose in zip(stamps, T, strict=True)]


def whole(path, **more):
    r = ros_of(path)
    return write_bag(path, {"/odometry": odometry(r), "/ground_truth": poses(r), **more})


def expected(estimate=ESTIMATE, covariance=P, truth=TRUTH, **how):
    return jaxslam.evaluate_poses(estimate[None], covariance[None], truth[None], SPLIT, **how).nees


def test_topics_are_found_or_named_beside_a_bag_or_with_it(tmp_path):
    bag = whole(tmp_path / "run.mcap")
    for found in (
        jaxslam.evaluate_log(bag),
        jaxslam.evaluate_log(bag, estimate="/odometry", truth="/ground_truth"),
        jaxslam.evaluate_log(f"{bag}:/odometry", truth="/ground_truth"),
    ):
        np.testing.assert_allclose(found.nees, expected(), rtol=1e-9)


@pytest.mark.parametrize("body", ["base_link", "/base_link", "imu", ""])
def test_poses_of_two_bodies_are_told(body, tmp_path):
    r = ros_of("run.mcap")
    truth = [r.odometry(t, T, 0 * P[0], body=body) for t, T in zip(STAMPS, TRUTH, strict=True)]
    bag = write_bag(tmp_path / "run.mcap", {"/odometry": odometry(r), "/truth": truth})
    found = jaxslam.evaluate_log(bag, estimate="/odometry", truth="/truth")
    told = "the estimate is of base_link and the truth of imu: what is between counts as error"
    assert (told in found.notes) == (body == "imu")


def test_the_truth_may_be_of_another_bag_or_a_file(tmp_path):
    bag = write_bag(tmp_path / "run.bag", {"/odometry": odometry(ros_of("run.bag"))})
    other = ros_of("truth")
    write_bag(tmp_path / "truth", {"/a": poses(other), "/b": poses(other, ESTIMATE)})
    write_tum(tmp_path / "truth.txt", STAMPS, TRUTH)
    write_tum(tmp_path / "estimate.txt", STAMPS, ESTIMATE)
    write_covariances(tmp_path / "covariance.txt", STAMPS, P, SPLIT)
    topic = f"{tmp_path / 'truth'}:/a"
    of_file = {"covariance": tmp_path / "covariance.txt"}
    for found in (
        jaxslam.evaluate_log(bag, truth=topic),
        jaxslam.evaluate_log(bag, truth=tmp_path / "truth.txt"),
        jaxslam.evaluate_log(tmp_path / "estimate.txt", truth=topic, **of_file),
    ):
        np.testing.assert_allclose(found.nees, expected(), rtol=1e-4)
    with pytest.raises(ValueError, match=r"2 topics fit --truth BAG:TOPIC; name one .* /a .*/b "):
        jaxslam.evaluate_log(bag, truth=tmp_path / "truth")


def test_a_folder_of_bags_is_of_runs_and_tells_the_convention(tmp_path):
    """Written about the body's axes, as by a filter that does not heed what ROS says."""
    names, runs = ("a.bag", "b.mcap", "c", "d.db3", *(f"{i}.mcap" for i in range(16))), []
    for seed, name in enumerate(names):
        estimate, cov, truth = run(seed)
        M = np.zeros((STEPS, 6, 6))
        M[:, :3, :3] = M[:, 3:, 3:] = np.swapaxes(estimate[:, :3, :3], -1, -2)
        body, r = M @ cov @ np.swapaxes(M, -1, -2), ros_of(name)
        write_bag(
            tmp_path / name, {"/odom": odometry(r, estimate, body), "/truth": poses(r, truth)}
        )
        runs.append(expected(estimate, body, truth)[0])
    found = jaxslam.evaluate_log(tmp_path)
    order = np.argsort(names)
    np.testing.assert_allclose(found.nees, np.array(runs)[order], rtol=1e-9)
    assert found.suggested is not None
    assert (found.suggested.error, found.suggested.axes) == ("split", "body")
    stated = jaxslam.evaluate_log(tmp_path, stated={"error": "split", "axes": "body"})
    assert np.nanmean(stated.nees) < 7


def refused(message, *given, **more):
    with pytest.raises(ValueError, match=message) as caught:
        jaxslam.evaluate_log(*given, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_topics_are_listed_where_none_or_several_fit(tmp_path):
    r = ros_of("run.mcap")
    topics = {"/a": odometry(r), "/b": odometry(r), "/c": poses(r), "/d": poses(r)}
    bag = write_bag(tmp_path / "run.mcap", topics, empty=[("/e", "nav_msgs/Odometry")])
    said = refused(r"run\.mcap: 2 topics fit --estimate; name one with messages of nav_ms", bag)
    assert "/a (nav_msgs/Odometry, 30 messages), /b (nav_msgs/Odometry, 30" in said
    assert "/c" not in said
    said = refused(r"run\.mcap: 3 other topics fit --truth; name one with", bag, estimate="/a")
    assert "/b (nav" in said
    assert "/c (geometry_msgs/PoseStamped, 30 messages)" in said
    said = refused(r"run\.mcap: no topics fit --estimate /odom; name", bag, estimate="/odom")
    assert all(f"/{x} (" in said for x in "abcde")
    refused(
        r"fit --estimate /c; name one with messages of nav_msgs/Odometry, g", bag, estimate="/c"
    )
    refused(r"fit --estimate /e; .*/e \(nav_msgs/Odometry, 0 messages\)", bag, estimate="/e")
    refused(r"fit --truth /x; .*PoseStamped", bag, estimate="/a", truth="/x")
    refused(r"a bag has its own covariances", bag, covariance=tmp_path / "covariance.txt")
    one = write_bag(tmp_path / "one.bag", {"/odom": odometry(ros_of("one.bag"))})
    refused(r"one\.bag: no other topics fit --truth; name one .*; there are /odom \(", one)
    refused(r"runs\.npz: --estimate goes with a trajectory", _npz(tmp_path), estimate="/odom")
    txt = write_path(tmp_path / "t.txt", TIMES)
    refused(r"t\.txt: --estimate is for a ROS bag", txt, estimate="/odom")


def _npz(folder):
    np.savez(folder / "runs.npz", errors=np.zeros((1, 2, 3)), covariances=np.ones((1, 2, 3, 3)))
    return folder / "runs.npz"


def wrong(T, place, value):
    changed = T.copy()
    changed[(4, *place)] = value
    return changed


def quaternion_zeroed(r):
    told = poses(r)
    told[4].pose.orientation = r.make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 0.0)
    return told


def gt(make):
    return lambda r: {"/gt": make(r)}


def odom(P):
    return lambda r: {"/odom": odometry(r, covariances=P)}


BACK, STUCK = np.r_[STAMPS[:5], STAMPS[:25]], 0 * STAMPS
NO_PATH = wrong(TRUTH, (2, 3), np.nan)


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (gt(lambda r: poses(r, wrong(TRUTH, (0, 3), np.nan))), "/gt, pose 4: expected"),
        (gt(lambda r: poses(r, wrong(TRUTH, (0, 3), np.inf))), "/gt, pose 4: expected"),
        (gt(quaternion_zeroed), "/gt, pose 4: the quaternion is zero, so it"),
        (odom(0 * P), "/odom: has no covariances, all 30 are NaN or zero; a verdict needs them"),
        (
            odom(wrong(P, (0, 0), -1.0)),
            "/odom: the covariance of run, step 4 has variance -1 .*positive definite",
        ),
        (
            gt(lambda r: poses(r, stamps=BACK)),
            "/gt: times decrease from 1700000000.400 to 1700000000.000 s; expected one run",
        ),
        (gt(lambda r: poses(r, stamps=STUCK)), "/gt: .* 1 different times, .* never st"),
        (gt(lambda r: poses(r, stamps=STAMPS + 99)), "/odom and .*/gt have no time stamps in"),
        (gt(lambda r: [r.path([], [])]), "/gt has no poses; choose a topic with p"),
        (gt(lambda r: [r.path(STAMPS, NO_PATH)]), "/gt, pose 4: expected finite numbers"),
    ],
)
def test_bad_messages_are_refused_in_one_line(topics, message, tmp_path):
    r = ros_of("run.bag")
    bag = write_bag(tmp_path / "run.bag", {"/odom": odometry(r), "/gt": poses(r)} | topics(r))
    assert str(bag) in refused(message, bag)


@pytest.mark.parametrize("name", KINDS)
def test_a_bag_that_is_nowhere_is_refused(name, tmp_path):
    refused(f"{name}: (no such file|cannot be read)", tmp_path / name)


@pytest.mark.parametrize("name", ["", "true", "1.5", "[1]"])
def test_a_topic_whose_name_in_the_metadata_is_none_is_no_estimate(name, tmp_path):
    bag = whole(tmp_path / "run")
    text = (bag / "metadata.yaml").read_text()
    assert "name: /odometry\n" in text
    (bag / "metadata.yaml").write_text(text.replace("name: /odometry\n", f"name: {name}\n"))
    refused("run(:None|:True|:1.5|:.1.)?(: | has )", bag)
    refused("run: no topics fit --estimate /odometry", bag, estimate="/odometry")


def test_without_the_library_the_error_says_what_to_install(tmp_path, monkeypatch):
    bag = whole(tmp_path / "run.mcap")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(r"a ROS bag needs the ros extra .* pip install 'jaxslam\[ros\]'", bag)
