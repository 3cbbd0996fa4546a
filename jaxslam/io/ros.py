"""Bags of ROS 1 and 2: their topics and messages, and the poses in them; `BAG:TOPIC` names one.

The library rosbags reads them by ROS' own definitions, so that nothing in a bag is run.
"""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from jaxslam._runtime.extras import missing
from jaxslam._runtime.files import one_line
from jaxslam.io.tum import read_log, rows_as_poses

Message: TypeAlias = Any
"""A message, with the fields of its ROS type as attributes."""
BAG = "a ROS bag (.bag; .mcap, .db3, or the folder with metadata.yaml)"
WITH_COVARIANCE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
POSES = (
    *WITH_COVARIANCE, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Path",
)  # fmt: skip


class Topic(NamedTuple):
    """A topic, in the bag that is its `parent`, and the type of its messages in ROS 2's words."""

    parent: Path
    name: str
    type: str

    def __str__(self) -> str:
        return f"{self.parent}:{self.name}"


def is_bag(path: Path) -> bool:
    """Whether this is a bag by its name, or a folder with the metadata of one."""
    return (path / "metadata.yaml").is_file() or path.suffix in (".bag", ".mcap", ".db3")


def bag_and_topic(place: str | Path) -> tuple[Path, str] | None:
    """The parts of `BAG:TOPIC`, or of a bag alone, whose topic is ""; None of another path."""
    if is_bag(Path(place)):
        return Path(place), ""
    bag, colon, topic = str(place).rpartition(":")
    return (Path(bag), topic) if colon and is_bag(Path(bag)) else None


def chosen(bag: Path, named: str, types: Sequence[str], option: str, other: str = "") -> Topic:
    """The topic of these types with messages that is `named`, or the only one but for the `other`.

    `option` is how it is named. Raises ValueError with the topics that fit, or else with all.
    """
    held: Counter[Topic] = Counter()
    with _opened(bag) as (reader, _):
        for x in reader.connections:
            held[Topic(bag, str(x.topic), str(x.msgtype))] += int(x.msgcount)  # of YAML: anything
    own, other = named.strip("/"), other.strip("/")
    fit = [x for x in held if x.type in types and held[x] and x.name.strip("/") != other]
    fit = [x for x in fit if not own or x.name.strip("/") == own]
    if len(fit) == 1:
        return fit[0]
    told = ", ".join(f"{x.name} ({x.type}, {held[x]} messages)" for x in sorted(fit or held))
    told = f"messages of {', '.join(types)}; there are {told or 'none'}".replace("/msg/", "/")
    which = f"{len(fit) or 'no'}{' other' * bool(other)} topics fit {option} {named}".strip()
    raise ValueError(f"{bag}: {which}; name one with {' '.join(told.split())}")


def messages(topic: Topic) -> Iterator[Message]:
    """The messages of a topic, one by one. Raises ValueError, naming the file."""
    with _opened(topic.parent) as (reader, decoded):
        own = [x for x in reader.connections if (x.topic, x.msgtype) == (topic.name, topic.type)]
        for _, _, data in reader.messages(own) if own else ():
            yield decoded(data, topic.type)


@contextmanager
def _opened(path: Path) -> Generator[tuple[Message, Callable[[bytes, str], Message]]]:
    """The library's reader, and what makes a message of bytes and a type. Raises ValueError."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing(f"{path}: a ROS bag needs", "ros", error) from None
    first = path.suffix == ".bag" and not path.is_dir()
    try:
        store = get_typestore(Stores.ROS1_NOETIC if first else Stores.LATEST)
        with (rosbag1 if first else rosbag2).Reader(path) as reader:
            yield reader, store.deserialize_ros1 if first else store.deserialize_cdr
    except Exception as error:  # of many kinds, as the library trusts its bytes
        told = one_line(error) or type(error).__name__
        raise ValueError(f"{path}: cannot be read ({told}); expected {BAG}, complete") from None


def body_of(place: Path | Topic) -> str:
    """The frame whose poses these are, by the first message; "" where nothing says it."""
    first = None if isinstance(place, Path) else next(messages(place), None)
    return str(getattr(first, "child_frame_id", "")).strip("/")


def seconds(message: Message) -> float:
    """The stamp of a message's header."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def read_poses(place: Path | Topic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,) in s, poses (n, 4, 4) in m of a text file (`read_log`) or a topic, and the
    covariances that are with them, if any.

    Of paths the last one is read. Raises ValueError, naming the place of what is no pose.
    """
    if isinstance(place, Path):
        return read_log(place)
    stamped = messages(place)
    if place.type == "nav_msgs/msg/Path":
        stamped = (pose for path in deque(stamped, 1) for pose in path.poses)
    rows = np.array([_row(message) for message in stamped], float)
    if not len(rows):
        raise ValueError(f"{place} has no poses; choose a topic with poses")
    T_wc = rows_as_poses(lambda i: f"{place}, pose {i}", rows)
    return rows[:, 0], T_wc, rows[:, 8:].reshape(-1, 6, 6)


def _row(message: Message) -> list[float]:
    """A stamped pose as `t tx ty tz qx qy qz qw`, and after it the covariance where it has one."""
    pose = message.transform if hasattr(message, "transform") else message.pose
    P, of = getattr(pose, "covariance", ()), getattr(pose, "pose", pose)
    p = of.translation if hasattr(of, "rotation") else of.position
    q = of.rotation if hasattr(of, "rotation") else of.orientation
    return [seconds(message), p.x, p.y, p.z, q.x, q.y, q.z, q.w, *P]
