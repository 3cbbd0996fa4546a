"""Bags of ROS 1 and 2: their topics and messages, and the poses in them; `BAG:TOPIC` names one.

The library rosbags reads them by ROS' own definitions, so that nothing in a bag is run.
"""

import shutil
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from jaxslam._runtime.extras import missing
from jaxslam._runtime.files import one_line
from jaxslam.io.logs.log import ROS, Log, interpolated
from jaxslam.io.tum import rows_as_poses

Message: TypeAlias = Any
"""A message, with the fields of its ROS type as attributes."""
BAG = "a ROS bag (.bag; .mcap, .db3, or the folder with metadata.yaml)"
WITH_COVARIANCE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_OF_TF = "geometry_msgs/TransformStamped[] transforms"
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
    own = Path(path.stem) if path.suffix == ".zstd" else path
    return (path / "metadata.yaml").is_file() or own.suffix in (".bag", ".mcap", ".db3")


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
    name, _, frames = own.partition(":")
    for x in held:
        if x.type == TRANSFORMS and x.name.strip("/") == name and types == POSES:
            return x._replace(name=f"{x.name}:{frames}".rstrip(":"))
    fit = [x for x in held if x.type in types and held[x] and x.name.strip("/") != other]
    fit = [x for x in fit if not own or x.name.strip("/") == own]
    if len(fit) == 1:
        return fit[0]
    told = ", ".join(f"{x.name} ({x.type}, {held[x]} messages)" for x in sorted(fit or held))
    told = f"messages of {', '.join(types)}; there are {told or 'none'}".replace("/msg/", "/")
    if any(x.type == TRANSFORMS for x in held):
        without = "have no covariance; they can be the truth, as --truth /tf:PARENT.CHILD"
        told += f". Transforms of /tf {without}"
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
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise missing(f"{path}: a ROS bag needs", "ros", error) from None
    first = path.suffix == ".bag" and not path.is_dir()
    try:
        store = get_typestore(Stores.ROS1_NOETIC if first else Stores.LATEST)
        if first:  # whose types there are without those of tf
            store.register(get_types_from_msg(_OF_TF, TRANSFORMS))
        with _unpacked(path) as file, (rosbag1 if first else rosbag2).Reader(file) as reader:
            yield reader, store.deserialize_ros1 if first else store.deserialize_cdr
    except Exception as error:  # of many kinds, as the library trusts its bytes
        told = one_line(error) or type(error).__name__
        raise ValueError(f"{path}: cannot be read ({told}); expected {BAG}, complete") from None


@contextmanager
def _unpacked(path: Path) -> Generator[Path]:
    """The file of a bag that is compressed by itself, for as long as it is read."""
    if path.suffix != ".zstd":
        yield path
        return
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / path.stem
        with zstd.open(path, "rb") as packed, whole.open("wb") as file:
            shutil.copyfileobj(packed, file)
        yield whole


def seconds(message: Message) -> float:
    """The stamp of a message's header."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def read_poses(topic: Topic) -> Log:
    """The poses of a topic, and the covariances that are with them, if any.

    Of paths the last one is read, and of transforms those from `PARENT` to `CHILD`, named with the
    topic as `/tf:PARENT.CHILD`. Raises ValueError, naming the place of what is no pose.
    """
    if topic.type == TRANSFORMS:
        return _joined(topic)
    stamped = messages(topic)
    if topic.type == "nav_msgs/msg/Path":
        stamped = (pose for path in deque(stamped, 1) for pose in path.poses)
    told = list(stamped)
    if not told:
        raise ValueError(f"{topic} has no poses; choose a topic with poses")
    rows = np.array([_row(message) for message in told], float)
    T_wc = rows_as_poses(lambda i: f"{topic}, pose {i}", rows[:, :8])
    P = rows[:, 8:].reshape(-1, 6, 6)
    body = str(getattr(told[0], "child_frame_id", "")).strip("/")
    world = str(told[0].header.frame_id).strip("/")
    return Log(rows[:, 0], T_wc, P, ROS if len(P) else {}, world=world, body=body)


def _joined(topic: Topic) -> Log:
    """The transform from one frame to another, along the tree, at the stamps of its fastest part.

    Raises ValueError, naming the frames that there are.
    """
    name, _, frames = topic.name.partition(":")
    edges: dict[str, tuple[str, list[list[float]]]] = {}
    for own in (topic._replace(name=name), topic._replace(name=f"{name}_static")):
        for message in messages(own):
            for x in message.transforms:
                child = x.child_frame_id.strip("/")
                edges.setdefault(child, (x.header.frame_id.strip("/"), []))[1].append(_row(x))
    parent, _, child = frames.partition(".")
    chain = [child]
    while chain[-1] in edges and chain[-1] != parent and len(chain) <= len(edges):
        chain.append(edges[chain[-1]][0])
    if not parent or chain[-1] != parent:
        known = ", ".join(f"{above} → {child}" for child, (above, _) in sorted(edges.items()))
        raise ValueError(
            f"{topic}: name the pose as {name}:PARENT.CHILD, of frames that are joined; there are "
            f"{known or 'none'}"
        )
    parts = []
    for frame in reversed(chain[:-1]):
        rows = np.array(edges[frame][1])
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
        parts.append((rows[:, 0], rows_as_poses(lambda i: f"{topic}, transform {i}", rows)))
    times = max((times for times, _ in parts), key=len)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    for own, poses in parts:
        T = T @ interpolated(own, poses, times, beyond=True)
    return Log(times, T, np.empty((0, 6, 6)), world=parent, body=child)


def _row(message: Message) -> list[float]:
    """A stamped pose as `t tx ty tz qx qy qz qw`, and after it the covariance where it has one."""
    pose = message.transform if hasattr(message, "transform") else message.pose
    P, of = getattr(pose, "covariance", ()), getattr(pose, "pose", pose)
    p = of.translation if hasattr(of, "rotation") else of.position
    q = of.rotation if hasattr(of, "rotation") else of.orientation
    return [seconds(message), p.x, p.y, p.z, q.x, q.y, q.z, q.w, *P]
