"""ROS 2 messages in CDR and an MCAP file holding them."""
import struct

import numpy as np
import zstandard
import mcap.writer
from mcap.writer import CompressionType, Writer

LINE = "=" * 80
TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
VECTOR = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"

SCHEMAS = {
    "sensor_msgs/msg/PointCloud2": [
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n", HEADER, TIME,
        "MSG: sensor_msgs/PointField\nuint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
        "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"],
    "geometry_msgs/msg/WrenchStamped": [
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n", HEADER, TIME,
        "MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n", VECTOR],
    "tf2_msgs/msg/TFMessage": [
        "geometry_msgs/TransformStamped[] transforms\n",
        "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        HEADER, TIME, "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        VECTOR, "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"],
}

_FOREVER = "{sec: 9223372036, nsec: 854775807}"


def qos(depth, reliability, durability):
    """One offered QoS profile, as rosbag2 writes it."""
    return (f"- history: keep_last\n  depth: {depth}\n  reliability: {reliability}\n  durability: {durability}\n"
            f"  deadline: {_FOREVER}\n  lifespan: {_FOREVER}\n  liveliness: automatic\n  liveliness_lease_duration: {_FOREVER}\n"
            f"  avoid_ros_namespace_conventions: false\n")


TOPICS = {
    "/parts/points": ("sensor_msgs/msg/PointCloud2", qos(5, "best_effort", "volatile")),
    "/wrench": ("geometry_msgs/msg/WrenchStamped", qos(50, "best_effort", "volatile")),
    "/tf": ("tf2_msgs/msg/TFMessage", qos(100, "reliable", "volatile")),
    "/tf_static": ("tf2_msgs/msg/TFMessage", qos(1, "reliable", "transient_local")),
}


class Cdr:
    """Little-endian CDR; alignment counts from after the 4-byte header."""

    def __init__(self):
        self.bytes = bytearray()

    def put(self, fmt, *values):
        size = struct.calcsize("<" + fmt[-1])
        self.bytes += b"\0" * (-len(self.bytes) % size) + struct.pack("<" + fmt, *values)
        return self

    def string(self, s):
        raw = s.encode() + b"\0"
        self.put("I", len(raw))
        self.bytes += raw
        return self

    def header(self, stamp_ns, frame):
        self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9)
        return self.string(frame)

    def raw(self, data):
        self.put("I", len(data))
        self.bytes += data
        return self

    def done(self):
        return b"\0\1\0\0" + bytes(self.bytes)


POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u4")])


def point_cloud(stamp_ns, frame, xyz, labels):
    """PointCloud2 of points [m] with a label each."""
    points = np.empty(len(xyz), POINT)
    points["x"], points["y"], points["z"], points["label"] = *np.asarray(xyz, "f4").T, labels
    c = Cdr().header(stamp_ns, frame).put("I", 1).put("I", len(points)).put("I", 4)
    for i, (name, datatype) in enumerate((("x", 7), ("y", 7), ("z", 7), ("label", 6))):
        c.string(name).put("I", 4 * i).put("B", datatype).put("I", 1)
    c.put("?", False).put("I", 16).put("I", 16 * len(points)).raw(points.tobytes()).put("?", True)
    return c.done()


def wrench_stamped(stamp_ns, frame, force, torque):
    """WrenchStamped, force [N] and torque [N·m]."""
    return Cdr().header(stamp_ns, frame).put("6d", *force, *torque).done()


def transforms(stamp_ns, entries):
    """TFMessage of (parent, child, translation [m], quaternion (x, y, z, w))."""
    c = Cdr().put("I", len(entries))
    for parent, child, p, q in entries:
        c.header(stamp_ns, parent).string(child).put("7d", *p, *q)
    return c.done()


class _Zstd:
    """Stands in for the writer's own zstandard, which has no level."""
    level = 19

    @staticmethod
    def compress(data):
        return zstandard.ZstdCompressor(level=_Zstd.level).compress(data)


def write(path, messages):
    """Writes (log time [ns], topic, CDR bytes), sorted by log time, as zstd-chunked MCAP."""
    mcap.writer.zstandard = _Zstd
    with open(path, "wb") as stream:
        w = Writer(stream, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        w.start(profile="ros2", library="bags/generate.py")
        channel, schema = {}, {}
        for topic, (kind, profile) in TOPICS.items():
            if kind not in schema:
                text = (LINE + "\n").join(SCHEMAS[kind])
                schema[kind] = w.register_schema(kind, "ros2msg", text.encode())
            channel[topic] = w.register_channel(topic, "cdr", schema[kind], {"offered_qos_profiles": profile})
        for i, (when, topic, data) in enumerate(sorted(messages, key=lambda m: m[0])):
            w.add_message(channel[topic], when, data, when, i)
        w.finish()
