"""Reads a bag with two independent readers and prints what they saw: read.py BAG.mcap."""
import json
import sys
from pathlib import Path

from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore


def seconds(stamp):
    nanosec = stamp.nanosec
    return [stamp.sec, nanosec]


def told(topic, log_time, message):
    """The content of a message, by what it has."""
    row = dict(topic=topic, log_time=log_time)
    if hasattr(message, "point_step"):
        row.update(stamp=seconds(message.header.stamp), frame=message.header.frame_id, width=message.width,
                   fields=[[f.name, f.offset, f.datatype, f.count] for f in message.fields], data=list(bytes(message.data)))
    elif hasattr(message, "wrench"):
        f, t = message.wrench.force, message.wrench.torque
        row.update(stamp=seconds(message.header.stamp), frame=message.header.frame_id, wrench=[f.x, f.y, f.z, t.x, t.y, t.z])
    elif hasattr(message, "transforms"):
        t = message.transforms[0]
        p, q = t.transform.translation, t.transform.rotation
        row.update(stamp=seconds(t.header.stamp), frame=t.header.frame_id, child=t.child_frame_id, pose=[p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    elif hasattr(message, "pose"):
        row.update(stamp=seconds(message.header.stamp), frame=message.header.frame_id,
                   position=[message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z],
                   covariance=[float(x) for x in message.pose.covariance])
    return row


def by_mcap(path):
    return [told(m.channel.topic, m.log_time_ns, m.ros_msg) for m in read_ros2_messages(str(path))]


def by_rosbags(path):
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [told(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


path = Path(sys.argv[1])
json.dump(dict(mcap=by_mcap(path), rosbags=by_rosbags(path)), sys.stdout)
