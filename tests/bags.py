"""Bags of ROS that tests write themselves, by the library's own writers."""

import shutil
from pathlib import Path

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
STORES[1].register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
KINDS = ("run.bag", "run.mcap", "run.db3", "run")
"""Names of a bag of ROS 1, single files of ROS 2 and its folder."""
EPOCH = 1_700_000_000


class Ros:
    """Messages of ROS 1 or 2."""

    def __init__(self, version):
        self.version, self.store = version, STORES[version]

    def make(self, kind, *fields):
        return self.store.types[kind.replace("/", "/msg/")](*fields)

    def header(self, stamp, frame="map"):
        nanoseconds = round(stamp * 1e9)
        time = self.make("builtin_interfaces/Time", *divmod(nanoseconds, 10**9))
        return self.make("std_msgs/Header", *[0] * (self.version == 1), time, frame)

    def parts(self, T):
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        return [float(x) for x in T[:3, 3]], [float(x) for x in q]

    def pose(self, T):
        p, q = self.parts(T)
        point = self.make("geometry_msgs/Point", *p)
        return self.make("geometry_msgs/Pose", point, self.make("geometry_msgs/Quaternion", *q))

    def with_covariance(self, T, P):
        return self.make("geometry_msgs/PoseWithCovariance", self.pose(T), P.ravel())

    def pose_with_covariance_stamped(self, t, T, P, frame="map"):
        pose = self.with_covariance(T, P)
        return self.make("geometry_msgs/PoseWithCovarianceStamped", self.header(t, frame), pose)

    def odometry(self, t, T, P, frame="map", body="base_link"):
        zero = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/Twist", zero, zero)
        twist = self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
        pose = self.with_covariance(T, P)
        return self.make("nav_msgs/Odometry", self.header(t, frame), body, pose, twist)

    def pose_stamped(self, t, T, frame="map"):
        return self.make("geometry_msgs/PoseStamped", self.header(t, frame), self.pose(T))

    def transform_stamped(self, t, T, frame="map", body="base_link"):
        p, q = self.parts(T)
        moved = self.make("geometry_msgs/Vector3", *p)
        turned = self.make("geometry_msgs/Quaternion", *q)
        transform = self.make("geometry_msgs/Transform", moved, turned)
        header = self.header(t, frame)
        return self.make("geometry_msgs/TransformStamped", header, body, transform)

    def transforms(self, *stamped):
        return self.make("tf2_msgs/TFMessage", list(stamped))

    def path(self, times, poses, frame="map"):
        stamped = [self.pose_stamped(t, T, frame) for t, T in zip(times, poses, strict=True)]
        return self.make("nav_msgs/Path", self.header(times[-1] if len(times) else 0.0), stamped)

    def image(self, t, data, encoding, *, width=None, step=None, big=0):
        """An image of an array (height, …) of numbers, `step` bytes a row, the last ones spare."""
        raw = np.ascontiguousarray(data).view(np.uint8).reshape(len(data), -1)
        step = raw.shape[1] if step is None else step
        rows = np.full((len(data), step), 255, np.uint8)
        rows[:, : raw.shape[1]] = raw
        size = len(data), data.shape[1] if width is None else width
        return self.make(
            "sensor_msgs/Image", self.header(t), *size, encoding, big, step, rows.ravel()
        )

    def imu(self, t, rates, forces, *, force_known=True):
        unknown = np.r_[-1.0, np.zeros(8)]
        turn = self.make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        rates, forces = (
            self.make("geometry_msgs/Vector3", *map(float, x)) for x in (rates, forces)
        )
        of_force = np.zeros(9) if force_known else unknown
        return self.make(
            "sensor_msgs/Imu", self.header(t), turn, unknown, rates, np.zeros(9), forces, of_force
        )

    def compressed(self, t, data, form="jpeg"):
        return self.make("sensor_msgs/CompressedImage", self.header(t), form, np.ravel(data))

    def camera_info(self, t, size, K, D, model="plumb_bob", P=None, part=(0,) * 6):
        P = np.zeros(12) if P is None else np.asarray(P, float).ravel()
        x, y, width, height, *binned = part
        roi = self.make("sensor_msgs/RegionOfInterest", x, y, height, width, False)
        return self.make(
            "sensor_msgs/CameraInfo", self.header(t), *size, model,
            np.array(D, float), np.ravel(K).astype(float), np.eye(3).ravel(), P, *binned, roi,
        )  # fmt: skip


def ros_of(path):
    return Ros(1 if Path(path).suffix == ".bag" else 2)


def write_bag(path, topics, empty=()):
    """A bag of messages by topic, and of topics (name, type) without one.

    They are received a second apart, whatever their stamps.
    """
    path = Path(path)
    first = path.suffix == ".bag"
    folder = path if first or not path.suffix else path.with_name(f"{path.name}.folder")
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    writer = (
        rosbag1.Writer(path) if first else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    )
    store = ros_of(path).store
    serialized = store.serialize_ros1 if first else store.serialize_cdr
    with writer:
        for name, kind in empty:
            writer.add_connection(name, kind.replace("/", "/msg/"), typestore=store)
        for name, told in topics.items():
            kind = told[0].__msgtype__
            connection = writer.add_connection(name, kind, typestore=store)
            for i, message in enumerate(told):
                writer.write(connection, (EPOCH + 5000 + i) * 10**9, serialized(message, kind))
    if folder != path:
        shutil.move(next(folder.glob(f"*{path.suffix}")), path)
        shutil.rmtree(folder)
    return path
