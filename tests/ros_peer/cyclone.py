"""A peer of another DDS vendor: Eclipse Cyclone DDS. Reads the latched description, sends wrenches and a cloud.

Prints one JSON object with what was seen. Needs cyclonedds alone.
"""

import json
import os
import struct
import time
from dataclasses import dataclass

os.environ.setdefault(
    "CYCLONEDDS_URI",
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1' multicast='true'/></Interfaces>"
    "<AllowMulticast>true</AllowMulticast></General></Domain></CycloneDDS>",
)

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Text(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    force: Vector3
    torque: Vector3


@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    header: Header
    wrench: Wrench


@dataclass
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


def main():
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    reliable = Policy.Reliability.Reliable(duration(seconds=1))
    latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
    plain = Qos(reliable, Policy.Durability.Volatile, Policy.History.KeepLast(10))
    description = DataReader(participant, Topic(participant, "rt/bom/robot_description", Text), qos=latched)
    states = DataReader(participant, Topic(participant, "rt/bom/joint_states", JointState), qos=plain)
    wrenches = DataWriter(participant, Topic(participant, "rt/wrench", WrenchStamped), qos=plain)
    clouds = DataWriter(participant, Topic(participant, "rt/parts/points", PointCloud2), qos=plain)
    fields = [PointField(name, 4 * i, 6 if name == "label" else 7, 1) for i, name in enumerate(["x", "y", "z", "label"])]
    grid = [(0.01 * i, 0.01 * j, 0.5, 1 + (i > 15)) for i in range(30) for j in range(30)]
    data = [byte for point in grid for byte in struct.pack("<fffI", *point)]
    zero = Vector3(0.0, 0.0, 0.0)
    texts, frames, begin, sent = [], 0, time.monotonic(), 0
    while time.monotonic() - begin < 20.0 and not (frames >= 5 and any("part_2" in text for text in texts)):
        t = 100.0 + time.monotonic() - begin
        header = Header(Time(int(t), int(t % 1.0 * 1e9)), "world")
        wrenches.write(WrenchStamped(header, Wrench(zero, zero)))
        if sent % 5 == 0:
            clouds.write(PointCloud2(header, 1, len(grid), fields, False, 16, 16 * len(grid), data, True))
        sent += 1
        texts += [sample.data for sample in description.take(10)]
        frames += len(states.take(10))
        time.sleep(0.02)
    print(json.dumps({"descriptions": len(texts), "last": texts[-1] if texts else None, "joint_states": frames}))


if __name__ == "__main__":
    main()
