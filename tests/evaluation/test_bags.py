"""A bag of ROS is evaluated as the arrays in it are; what it lacks is said in one line.

That every kind of a bag and of its messages is its arrays is a law of logs.
"""

import sys
from functools import partial

import numpy as np
import pytest
import refusals
from bags import ros_of, write_bag
from logs import ESTIMATE, TIMES, TRUTH, in_space, in_the_world, joined
from logs import P as MIXED
from recordings import write as write_path

import jaxslam
from jaxslam.evaluation import write_covariances
from jaxslam.io import write_tum

P, SPLIT = in_the_world(MIXED), jaxslam.Convention("split", "world")


def odometry(r, poses=ESTIMATE, covariances=P, stamps=TIMES):
    told = zip(stamps, poses, covariances, strict=True)
    return [r.odometry(t, T, cov) for t, T, cov in told]


def poses(r, T=TRUTH, stamps=TIMES):
    return [r.pose_stamped(t, pose) for t, pose in zip(stamps, T, strict=True)]


def whole(path):
    r = ros_of(path)
    return write_bag(path, {"/odometry": odometry(r), "/ground_truth": poses(r)})


WANTED = jaxslam.evaluate_poses(ESTIMATE[None], P[None], TRUTH[None], SPLIT).nees


def test_topics_and_truths_are_found_or_named_beside_a_bag_or_with_it(tmp_path):
    bag, other = whole(tmp_path / "run.mcap"), ros_of("truth")
    alone = write_bag(tmp_path / "run.bag", {"/odometry": odometry(ros_of("run.bag"))})
    write_bag(tmp_path / "truth", {"/a": poses(other), "/b": poses(other, ESTIMATE)})
    write_tum(tmp_path / "truth.txt", TIMES, TRUTH)
    write_tum(tmp_path / "estimate.txt", TIMES, ESTIMATE)
    write_covariances(tmp_path / "covariance.txt", TIMES, P, SPLIT)
    topic, of_file = f"{tmp_path / 'truth'}:/a", {"covariance": tmp_path / "covariance.txt"}
    for found in (
        jaxslam.evaluate_log(bag),
        jaxslam.evaluate_log(f"{bag}:/odometry", truth="/ground_truth"),
        jaxslam.evaluate_log(alone, truth=topic),
        jaxslam.evaluate_log(alone, truth=tmp_path / "truth.txt"),
        jaxslam.evaluate_log(tmp_path / "estimate.txt", truth=topic, **of_file),
    ):
        np.testing.assert_allclose(found.nees, WANTED, rtol=1e-4)
    refused(
        r"2 topics fit --truth BAG:TOPIC; name one .* /a .*/b ", alone, truth=tmp_path / "truth"
    )


def test_poses_of_two_bodies_are_told(tmp_path):
    for number, body in enumerate(("/base_link", "imu", "")):
        path = tmp_path / f"{number}.mcap"
        r = ros_of(path)
        truth = [r.odometry(t, T, 0 * P[0], body=body) for t, T in zip(TIMES, TRUTH, strict=True)]
        bag = write_bag(path, {"/odometry": odometry(r), "/truth": truth})
        found = jaxslam.evaluate_log(bag, estimate="/odometry", truth="/truth")
        told = "the estimate is of base_link and the truth of imu: what is between counts as error"
        assert (told in found.notes) == (body == "imu")


def test_a_folder_of_bags_is_of_runs_and_tells_the_convention(tmp_path):
    """Written with rotations about the body's axes, as by a filter that does not heed what ROS
    says."""
    names, runs = ("a.bag", "b.mcap", "c", "d.db3", *(f"{i}.mcap" for i in range(4))), []
    for name in names:
        (estimate, P, truth), r = in_space(), ros_of(name)
        told = {"/odom": odometry(r, estimate, P), "/truth": poses(r, truth)}
        write_bag(tmp_path / name, told)
        runs.append(jaxslam.evaluate_poses(estimate[None], P[None], truth[None], SPLIT).nees[0])
    found = jaxslam.evaluate_log(tmp_path)
    np.testing.assert_allclose(found.nees, np.array(runs)[np.argsort(names)], rtol=1e-9)
    assert found.suggested is not None
    assert (found.suggested.error, found.suggested.axes) == ("split", "mixed")
    stated = jaxslam.evaluate_log(tmp_path, stated={"error": "split", "axes": "mixed"})
    assert np.nanmean(stated.nees) < 7


refused = partial(refusals.refused, jaxslam.evaluate_log)


def test_topics_are_listed_where_none_or_several_fit(tmp_path):
    r = ros_of("run.mcap")
    topics = {"/a": odometry(r), "/b": odometry(r), "/c": poses(r), "/d": poses(r)}
    bag = write_bag(tmp_path / "run.mcap", topics, empty=[("/e", "nav_msgs/Odometry")])
    said = refused(r"run\.mcap: 2 topics fit --estimate; name one with messages of nav_ms", bag)
    assert "/a (nav_msgs/Odometry, 24 messages), /b (nav_msgs/Odometry, 24" in said
    assert "/c" not in said
    said = refused(r"run\.mcap: 3 other topics fit --truth; name one with", bag, estimate="/a")
    assert "/b (nav" in said
    assert "/c (geometry_msgs/PoseStamped, 24 messages)" in said
    said = refused(r"run\.mcap: no topics fit --estimate /odom; name", bag, estimate="/odom")
    assert all(f"/{x} (" in said for x in "abcde")
    refused(r"fit --estimate /c; name one with messages of nav_msgs/Odometry", bag, estimate="/c")
    refused(r"fit --estimate /e; .*/e \(nav_msgs/Odometry, 0 messages\)", bag, estimate="/e")
    refused(r"fit --truth /x; .*PoseStamped", bag, estimate="/a", truth="/x")
    refused(r"a bag has its own covariances", bag, covariance=tmp_path / "covariance.txt")
    tree = write_bag(tmp_path / "tree.mcap", {"/odom": odometry(r), **joined(r)})
    refused(r"Transforms of /tf have no covariance; they can be the truth", tree, estimate="/x")
    refused(r"name the pose as /tf:PARENT\.CHILD, of frames that are", tree, truth="/tf:map.x")
    one = write_bag(tmp_path / "one.bag", {"/odom": odometry(ros_of("one.bag"))})
    refused(r"one\.bag: no other topics fit --truth; name one .*; there are /odom \(", one)
    np.savez(tmp_path / "runs.npz", errors=np.zeros((1, 2, 3)), sigmas=np.ones((1, 2, 3)))
    npz = tmp_path / "runs.npz"
    refused(r"runs\.npz: --estimate goes with a trajectory", npz, estimate="/odom")
    text = write_path(tmp_path / "t.txt", TIMES)
    refused(r"t\.txt: --estimate is for a ROS bag", text, estimate="/odom")


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


BACK, STUCK = np.r_[TIMES[:5], TIMES[:-5]], 0 * TIMES
NO_PATH = wrong(TRUTH, (2, 3), np.nan)


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (gt(lambda r: poses(r, wrong(TRUTH, (0, 3), np.inf))), "/gt, pose 4: expected"),
        (gt(quaternion_zeroed), "/gt, pose 4: the quaternion is zero, so it"),
        (odom(0 * P), "/odom: has no covariances, all 24 are NaN or zero; a verdict needs them"),
        (odom(wrong(P, (0, 0), -1.0)), "/odom: the covariance of run, step 4 has variance -1 "),
        (gt(lambda r: poses(r, stamps=BACK)), "/gt: times decrease from 1700000000.400 to 17000"),
        (gt(lambda r: poses(r, stamps=STUCK)), "/gt: .* 1 different times, .* never st"),
        (gt(lambda r: poses(r, stamps=TIMES + 99)), "/odom and .*/gt have no time stamps in"),
        (gt(lambda r: [r.path([], [])]), "/gt has no poses; choose a topic with p"),
        (gt(lambda r: [r.path(TIMES, NO_PATH)]), "/gt, pose 4: expected finite numbers"),
    ],
)
def test_bad_messages_are_refused_in_one_line(topics, message, tmp_path):
    r = ros_of("run.bag")
    bag = write_bag(tmp_path / "run.bag", {"/odom": odometry(r), "/gt": poses(r)} | topics(r))
    assert str(bag) in refused(message, bag)


@pytest.mark.parametrize("name", ["", "1.5", "[1]"])
def test_a_topic_whose_name_in_the_metadata_is_none_is_no_estimate(name, tmp_path):
    bag = whole(tmp_path / "run")
    text = (bag / "metadata.yaml").read_text()
    assert "name: /odometry\n" in text
    (bag / "metadata.yaml").write_text(text.replace("name: /odometry\n", f"name: {name}\n"))
    refused("run(:None|:1.5|:.1.)?(: | has )", bag)
    refused("run: no topics fit --estimate /odometry", bag, estimate="/odometry")


def test_without_the_library_the_error_says_what_to_install(tmp_path, monkeypatch):
    bag = whole(tmp_path / "run.mcap")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(r"a ROS bag needs the ros extra .* pip install 'jaxslam\[ros\]'", bag)
