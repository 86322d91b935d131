"""A real ROS 2 peer of `bom node`: plays a bag, listens, calls services. Needs the environment of rosidl_peer/build.sh.

peer.py SCENARIO [ARGUMENT...]   prints one JSON object with what was seen. Scenarios are the functions below.
"""

import array
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, WrenchStamped
from lifecycle_msgs.msg import TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from mcap.reader import make_reader
from rcl_interfaces.msg import Log, Parameter, ParameterEvent, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from bayesian_object_models.msg import Criticism, ObjectPosterior, PredictedPartPoses, WrenchSegment
from bayesian_object_models.srv import LoadModel, Predict, SaveModel
from bond.msg import Status as BondStatus

NODE = "/bom"
TYPES = {
    "sensor_msgs/msg/PointCloud2": PointCloud2,
    "geometry_msgs/msg/WrenchStamped": WrenchStamped,
    "tf2_msgs/msg/TFMessage": TFMessage,
}
JOINT_TYPES = ("rigid", "prismatic", "revolute")


def quality(reliable=True, latched=False, depth=10):
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class Bond:
    """A lifecycle manager's side of a bond, as bondcpp has it."""

    def __init__(self, node):
        self.sides = []
        self.publisher = node.create_publisher(BondStatus, "/bond", quality(depth=5))
        node.create_subscription(BondStatus, "/bond", self.heard, quality(depth=100))
        node.create_timer(0.1, lambda: self.say(True))

    def say(self, active):
        self.publisher.publish(BondStatus(id=NODE.strip("/"), instance_id="manager", active=active))

    def heard(self, status):
        if status.instance_id == "manager" or status.id != NODE.strip("/"):
            return
        if not self.sides or self.sides[-1] != (status.instance_id, status.active):
            self.sides.append((status.instance_id, status.active))
            if not status.active:
                self.say(False)

    def seen(self):
        """Its sides as they came: the number of the instance, and whether it was there."""
        instances = list(dict.fromkeys(instance for instance, _ in self.sides))
        return [[instances.index(instance), active] for instance, active in self.sides]


class Peer(Node):
    """Keeps what it hears, by topic, with when it came."""

    def __init__(self, name="peer"):
        super().__init__(name)
        self.heard = {}

    def hear(self, topic, message_type, profile):
        heard = self.heard.setdefault(topic, [])
        self.create_subscription(message_type, topic, lambda m: heard.append((time.monotonic(), m)), profile)

    def hear_all(self):
        self.hear(f"{NODE}/object_posterior", ObjectPosterior, quality(latched=True, depth=1))
        self.hear(f"{NODE}/predicted_poses", PredictedPartPoses, quality())
        self.hear(f"{NODE}/criticism", Criticism, quality(latched=True, depth=1))
        self.hear(f"{NODE}/markers", MarkerArray, quality())
        self.hear(f"{NODE}/robot_description", String, quality(latched=True, depth=1))
        self.hear(f"{NODE}/joint_states", JointState, quality())
        self.hear(f"{NODE}/transition_event", TransitionEvent, quality())
        self.hear("/parameter_events", ParameterEvent, quality(depth=100))
        self.hear("/diagnostics", DiagnosticArray, quality())
        self.hear("/rosout", Log, quality(depth=1000))

    def last(self, topic):
        heard = self.heard.get(f"{NODE}/{topic}") or self.heard.get(f"/{topic}")
        return heard[-1][1] if heard else None

    def count(self, topic):
        return len(self.heard.get(f"{NODE}/{topic}") or self.heard.get(f"/{topic}") or [])

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=max(0.0, min(0.05, end - time.monotonic())))

    def wait(self, what, seconds):
        """Whether it came true in time."""
        end = time.monotonic() + seconds
        while not what():
            if time.monotonic() > end:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        return True

    def call(self, name, service, **fields):
        client = self.create_client(service, f"{NODE}/{name}")
        if not client.wait_for_service(timeout_sec=20.0):
            raise SystemExit(f"{name}: no such service")
        future = client.call_async(service.Request(**fields))
        rclpy.spin_until_future_complete(self, future, timeout_sec=20.0)
        if future.result() is None:
            raise SystemExit(f"{name}: no answer")
        return future.result()

    def logged(self, text):
        return any(text in m.msg for _, m in self.heard["/rosout"])

    def diagnosed(self, text):
        """When a diagnostic first said so."""
        for at, message in self.heard["/diagnostics"]:
            for status in message.status:
                if text in status.message and status.level == b"\x01":
                    return at
        return None


class Player:
    """Plays a bag's messages as they were logged, in real time, stamps moved to the wall clock."""

    def __init__(self, node, path, rate=1.0, sim_time=False):
        self.node, self.rate, self.sim_time = node, rate, sim_time
        with open(path, "rb") as file:
            self.messages = [
                (m.log_time, c.topic, s.name, m.data) for s, c, m in make_reader(file).iter_messages()
            ]
        self.publishers_by_topic = {}
        for _, topic, kind, _ in self.messages:
            if topic not in self.publishers_by_topic:
                static = topic.endswith("tf_static")
                profile = quality(reliable="tf" in topic, latched=static, depth=100)
                self.publishers_by_topic[topic] = node.create_publisher(TYPES[kind], topic, profile)
        self.clock = node.create_publisher(Clock, "/clock", quality(reliable=False)) if sim_time else None

    def play(self, until=float("inf"), wanted=lambda topic, t: True, begin=0.0):
        """Plays on to `until` seconds after the first message; `wanted` says what is sent."""
        first = self.messages[0][0]
        start = time.monotonic() - begin / self.rate
        for logged, topic, _, data in self.messages:
            t = (logged - first) * 1e-9
            if t < begin and not topic.endswith("tf_static"):
                continue
            if t > until:
                break
            while t > (time.monotonic() - start) * self.rate:
                rclpy.spin_once(self.node, timeout_sec=max(0.0, min(0.005, start + t / self.rate - time.monotonic())))
            if self.clock:
                self.clock.publish(Clock(clock=rclpy.time.Time(nanoseconds=logged).to_msg()))
            if wanted(topic, t):
                self.publishers_by_topic[topic].publish(bytes(data))


def joints(posterior):
    """The likely edges: child → [parent, type]."""
    found = {}
    for edge in posterior.edges:
        if edge.probability > 0.5:
            chances = (edge.rigid_probability, edge.prismatic_probability, edge.revolute_probability)
            found[edge.child] = [edge.parent, JOINT_TYPES[chances.index(max(chances))]]
    return found


def interval(quantity):
    return {"median": quantity.median, "q05": quantity.q05, "q95": quantity.q95}


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def status(message):
    return {
        s.name: {"level": s.level[0], "message": s.message, "values": {v.key: v.value for v in s.values}}
        for s in message.status
    }


def plans(node, posterior):
    """Pulls and pushes the first slide by a plan: how far it would go along its axis, with its spread."""
    edge = next(e for e in posterior.edges if e.probability > 0.5 and e.prismatic_probability > 0.5)
    axis = edge.prismatic[0].axis_direction
    com = next(p.com for p in posterior.parts if p.label == edge.child)
    found = {"part": edge.child}
    for name, force in (("pull", 10.0), ("push", -10.0)):
        segment = WrenchSegment(duration=0.5)
        force += numpy.sign(force) * 2.0 * edge.friction.median
        segment.wrench.force.x, segment.wrench.force.y, segment.wrench.force.z = (
            force * axis.x,
            force * axis.y,
            force * axis.z,
        )
        answer = node.call(
            "predict", Predict, label=[edge.child], point=com, profile=[segment], duration=0.5, interval=0.5, seed=1
        )
        pose = [p for p in answer.trajectory if p.label == edge.child]
        t = pose[0].displacement.translation if pose else None
        found[name] = {
            "success": [answer.success, answer.message],
            "label": answer.label,
            "labels": sorted({p.label for p in answer.trajectory}),
            "way": t.x * axis.x + t.y * axis.y + t.z * axis.z if t else None,
            "variance": float(pose[0].center_covariance[0] + pose[0].center_covariance[4] + pose[0].center_covariance[8])
            if pose
            else None,
        }
    wrong = node.call("predict", Predict, label=[999], profile=[segment])
    found["wrong"] = [wrong.success, wrong.message]
    return found


def ready(node):
    """The node is there and at work."""
    node.hear_all()
    state = node.call("get_state", GetState).current_state.label
    found = node.wait(lambda: node.get_publishers_info_by_topic(f"{NODE}/predicted_poses"), 20.0)
    node.spin(1.0)
    return state, bool(found)


def live(bag, settle="60", model="/tmp/model.json"):
    """A whole bag: everything that the node says of it, what a late joiner gets, and the object once more from
    a saved model."""
    node = Peer()
    state, _ = ready(node)
    prior = node.last("object_posterior")
    player = Player(node, bag)
    node.wait(lambda: node.count_subscribers("/parts/points") > 0, 10.0)
    node.spin(1.0)
    player.play()
    windows = lambda: node.last("object_posterior").windows_learned if node.last("object_posterior") else 0

    def learned():
        report = status(node.last("diagnostics")).get("bom: inference", {}).get("values", {})
        idle = report.get("windows waiting") == "0" and report.get("inference running for [s]") == "0.00"
        return idle and windows() == int(report.get("windows learned", -1))

    node.spin(3.0)
    settled = node.wait(learned, float(settle))
    node.spin(1.0)
    late = Peer("late")
    late.hear(f"{NODE}/object_posterior", ObjectPosterior, quality(latched=True, depth=1))
    late.hear(f"{NODE}/robot_description", String, quality(latched=True, depth=1))
    # Of a writer's history the newest may come last.
    newest = lambda: late.last("object_posterior") and late.last("object_posterior").windows_learned == windows()
    late.wait(lambda: newest() and late.last("robot_description"), 10.0)
    posterior = node.last("object_posterior")
    predicted = node.last("predicted_poses")
    # What removes all before has no namespace, and whoever joins later does not hear it.
    markers = {m.ns for _, message in node.heard[f"{NODE}/markers"] for m in message.markers if m.ns}
    largest = max(len(serialize_message(m)) for _, m in node.heard[f"{NODE}/markers"]) if markers else 0
    description = node.last("robot_description")
    states = node.last("joint_states")
    planned = plans(node, posterior)
    saved = node.call("save_model", SaveModel, path=model)
    reset = node.call("reset", Trigger)
    node.spin(0.5)
    forgotten = windows()
    missing = node.call("load_model", LoadModel, path="/nowhere/model.json")
    loaded = node.call("load_model", LoadModel, path=model)
    player.play(until=1.5)
    node.wait(lambda: windows() > 0, 5.0)
    edges = {
        edge.child: {name: interval(getattr(edge, name)) for name in ("damping", "friction", "joint_inertia")}
        for edge in posterior.edges
        if edge.probability > 0.5
    }
    return {
        "state": state,
        "prior": None if prior is None else {"parts": len(prior.parts), "edges": len(prior.edges)},
        "settled": settled,
        "windows": posterior.windows_learned,
        "joints": joints(posterior),
        "edges": edges,
        "predicted": {
            "count": node.count("predicted_poses"),
            "labels": sorted({p.label for p in predicted.poses}) if predicted else [],
            "horizons": sorted({round(p.horizon, 3) for p in predicted.poses}) if predicted else [],
            "frame": predicted.header.frame_id if predicted else None,
        },
        "criticism": node.last("criticism") is not None,
        "markers": sorted(markers),
        "largest_markers": largest,
        "description": description.data if description else None,
        "planned": planned,
        "model": {
            "saved": [saved.success, saved.message],
            "reset": reset.success,
            "forgotten": forgotten,
            "missing": [missing.success, missing.message],
            "loaded": [loaded.success, loaded.message],
            "windows": windows(),
            "joints": joints(node.last("object_posterior")),
        },
        "joint_states": dict(zip(states.name, states.position)) if states else None,
        "diagnostics": status(node.last("diagnostics")),
        "late": {
            "windows": late.last("object_posterior").windows_learned if late.last("object_posterior") else None,
            "description": late.last("robot_description") is not None,
        },
        "nodes": [f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()],
        "log": [m.msg for _, m in node.heard["/rosout"]],
    }


def play(bag, settle="180"):
    """A whole bag: what was learned of it, to the last digit."""
    node = Peer()
    ready(node)
    node.hear("/tf", TFMessage, quality(depth=100))
    player = Player(node, bag)
    node.wait(lambda: node.count_subscribers("/parts/points") > 0, 10.0)
    node.spin(1.0)
    player.play()

    def learned():
        report = status(node.last("diagnostics")).get("bom: inference", {}).get("values", {})
        idle = report.get("windows waiting") == "0" and report.get("inference running for [s]") == "0.00"
        return idle and node.last("object_posterior").windows_learned == int(report.get("windows learned", -1))

    node.spin(3.0)
    settled = node.wait(learned, float(settle))
    node.spin(0.5)
    posterior = node.last("object_posterior")
    states = [m for _, m in node.heard[f"{NODE}/joint_states"] if len(m.velocity) == len(m.name) > 0]
    return {
        "settled": settled,
        "windows": posterior.windows_learned,
        "spans": [[seconds(w.start), seconds(w.end)] for w in posterior.recent_windows],
        "joints": joints(posterior),
        "medians": {
            e.child: [e.damping.median, e.friction.median, e.joint_inertia.median]
            for e in posterior.edges
            if e.probability > 0.5
        },
        "predicted": node.count("predicted_poses"),
        "fastest": max((abs(v) for m in states for v in m.velocity), default=0.0),
        "tf": sorted({t.child_frame_id for _, m in node.heard["/tf"] for t in m.transforms if "part" in t.child_frame_id}),
    }


def stands_still():
    """A reliable subscriber that stops at its third message, with its process."""
    node = Peer("stands_still")
    node.hear(f"{NODE}/predicted_poses", PredictedPartPoses, quality())
    node.wait(lambda: node.count("predicted_poses") > 2, 30.0)
    os.kill(os.getpid(), signal.SIGSTOP)


def held_up(bag):
    """Whether a subscriber that stands still holds up what others hear."""
    node = Peer()
    ready(node)
    player = Player(node, bag)
    node.wait(lambda: node.count_subscribers("/parts/points") > 0, 10.0)
    other = subprocess.Popen([sys.executable, __file__, "stands_still"], stdout=subprocess.DEVNULL)
    stopped_at = []

    def stopped(*_):
        if not stopped_at and pathlib.Path(f"/proc/{other.pid}/stat").read_text().split()[2] == "T":
            stopped_at.append(time.monotonic())
        return not stopped_at or time.monotonic() - stopped_at[0] < 12.0

    player.play(wanted=stopped)
    other.kill()
    after = [at for at, _ in node.heard[f"{NODE}/predicted_poses"] if stopped_at and at > stopped_at[0]]
    return {
        "stood_still": bool(stopped_at),
        "heard": len(after),
        "longest_gap": max((b - a for a, b in zip(after, after[1:])), default=None),
    }


def services():
    """Parameters, lifecycle and the node's own services, called as tools and managers do."""
    node = Peer()
    bond = Bond(node)
    state, _ = ready(node)
    bonded = node.wait(lambda: bond.seen() == [[0, True]], 10)
    names = node.call("list_parameters", ListParameters).result.names
    below = node.call("list_parameters", ListParameters, prefixes=["windows"], depth=1).result.names
    described = node.call("describe_parameters", DescribeParameters, names=["windows.quiet_s", "use_sim_time"])
    quiet, sim = described.descriptors
    values = node.call("get_parameters", GetParameters, names=["windows.quiet_s", "nothing"]).values
    types = node.call("get_parameter_types", GetParameterTypes, names=["publish_tf", "windows.quiet_s"]).types

    def parameter(name, **fields):
        return Parameter(name=name, value=ParameterValue(**fields))

    def outcome(result):
        return [result.successful, result.reason]

    wanted = [
        parameter("publish_tf", type=1, bool_value=True),
        parameter("use_sim_time", type=1, bool_value=True),
        parameter("windows.quiet_s", type=3, double_value=0.5),
        parameter("wrench_timeout_s", type=3, double_value=-1.0),
        parameter("nothing", type=1, bool_value=True),
    ]
    one_by_one = [outcome(r) for r in node.call("set_parameters", SetParameters, parameters=wanted).results]
    together = outcome(node.call("set_parameters_atomically", SetParametersAtomically, parameters=wanted[:2]).result)

    def change(number):
        request = ChangeState.Request()
        request.transition.id = number
        success = node.call("change_state", ChangeState, transition=request.transition).success
        return [success, node.call("get_state", GetState).current_state.label]

    states = [s.label for s in node.call("get_available_states", GetAvailableStates).available_states]
    transitions = node.call("get_available_transitions", GetAvailableTransitions).available_transitions
    graph = node.call("get_transition_graph", GetAvailableTransitions).available_transitions
    # Deactivate, a wrong one, clean up; set what only then can be set; configure and activate again.
    changes = [change(4)]
    unbonded = node.wait(lambda: bond.seen()[-1:] == [[0, False]], 3)
    changes += [change(4), change(2)]
    unconfigured = outcome(node.call("set_parameters", SetParameters, parameters=wanted[2:3]).results[0])
    changes += [change(1), change(3)]
    reset = node.call("reset", Trigger)
    node.spin(1.5)
    return {
        "state": state,
        "names": names,
        "below": below,
        "quiet": [quiet.type, quiet.description, quiet.read_only, [r.to_value for r in quiet.floating_point_range]],
        "sim": [sim.type, sim.read_only],
        "values": [values[0].double_value, values[1].type],
        "types": list(types),
        "one_by_one": one_by_one,
        "together": together,
        "states": states,
        "transitions": sorted(t.transition.label for t in transitions),
        "graph": len(graph),
        "changes": changes,
        "unconfigured": unconfigured,
        "reset": [reset.success, reset.message],
        "events": [e.goal_state.label for _, e in node.heard[f"{NODE}/transition_event"]],
        "parameter_events": [p.name for _, e in node.heard["/parameter_events"] for p in e.changed_parameters],
        "diagnostics": status(node.last("diagnostics")),
        "bonded": [bonded, unbonded],
        "bond": bond.seen(),
        "shutdown": change(7) if "shutdown" in sys.argv else None,
    }


def cloud(stamp, parts, frame="world"):
    """A cloud of parts: label → points."""
    points = numpy.concatenate([numpy.asarray(p, dtype=numpy.float32) for p in parts.values()])
    labels = numpy.concatenate([numpy.full(len(p), label, dtype=numpy.uint32) for label, p in parts.items()])
    data = numpy.zeros(len(points), dtype=[("xyz", "<f4", 3), ("label", "<u4")])
    data["xyz"], data["label"] = points, labels
    message = PointCloud2(height=1, width=len(points), point_step=16, row_step=16 * len(points), is_dense=True)
    message.header.frame_id, message.header.stamp = frame, stamp
    for index, name in enumerate(("x", "y", "z", "label")):
        datatype = PointField.UINT32 if name == "label" else PointField.FLOAT32
        message.fields.append(PointField(name=name, offset=4 * index, datatype=datatype, count=1))
    message.data = array.array("B", data.tobytes())
    return message


def box(rng, count, center, size):
    """Points on a box's faces, by area."""
    size = numpy.asarray(size)
    areas = numpy.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[numpy.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size + numpy.asarray(center) + rng.normal(0.0, 0.001, (count, 3))


def stamp_at(seconds):
    return rclpy.time.Time(nanoseconds=int(seconds * 1e9)).to_msg()


def trouble():
    """One bad input after the other: how long until a diagnostic and a log line name it [s]."""
    node = Peer()
    ready(node)
    rng = numpy.random.default_rng(1)
    parts = {1: box(rng, 400, (0.0, 0.0, 0.5), (0.4, 0.4, 0.4)), 2: box(rng, 400, (0.3, 0.0, 0.5), (0.1, 0.3, 0.3))}
    clouds = node.create_publisher(PointCloud2, "/parts/points", quality(reliable=False, depth=2))
    wrenches = node.create_publisher(WrenchStamped, "/wrench", quality(depth=100))
    clock = node.create_publisher(Clock, "/clock", quality(reliable=False))
    node.wait(lambda: node.count_subscribers("/clock") > 0 and node.count_subscribers("/wrench") > 0, 20.0)
    node.spin(1.0)
    now, found = [1000.0], {}

    def run(name, text, seconds=3.0, cloud_hz=10.0, wrench_hz=100.0, clock_hz=100.0, frame="world", wait=True):
        """Sends at these rates until the text is said, or the time is over."""
        begin = time.monotonic()
        sent = {"cloud": 0, "wrench": 0, "clock": 0}
        start = now[0]
        while time.monotonic() - begin < seconds:
            elapsed = time.monotonic() - begin
            now[0] = start + (elapsed if clock_hz else 0.0)
            for kind, rate in (("clock", clock_hz), ("wrench", wrench_hz), ("cloud", cloud_hz)):
                if elapsed * rate < sent[kind]:
                    continue
                sent[kind] += 1
                if kind == "clock" and rate:
                    clock.publish(Clock(clock=stamp_at(now[0])))
                elif kind == "wrench" and rate:
                    message = WrenchStamped()
                    message.header.frame_id, message.header.stamp = "world", stamp_at(start + elapsed)
                    wrenches.publish(message)
                elif kind == "cloud" and rate:
                    clouds.publish(cloud(stamp_at(start + elapsed), parts, frame))
            rclpy.spin_once(node, timeout_sec=0.001)
            said = [at for at, m in node.heard["/diagnostics"] if at > begin and any(text in s.message for s in m.status)]
            logged = [at for at, m in node.heard["/rosout"] if at > begin and text in m.msg]
            if wait and said and logged:
                found[name] = [round(said[0] - begin, 3), round(logged[0] - begin, 3)]
                return
        if wait:
            found[name] = None

    run("steady", "", seconds=2.0, wait=False)
    quiet = status(node.last("diagnostics"))["bom: inputs"]
    run("no transform", "frame `nowhere` is unknown", frame="nowhere")
    run("steady", "", seconds=4.0, wait=False)
    run("wrench dies", "/wrench: silent", wrench_hz=0.0)
    run("steady", "", seconds=1.0, wait=False)
    run("clock stands still", "/clock has stood still", clock_hz=0.0)
    run("steady", "", seconds=1.0, wait=False)
    now[0] -= 500.0
    run("clock goes back", "/clock went back by")
    predicted = node.count("predicted_poses")
    run("steady", "", seconds=1.5, wait=False)
    going_on = node.count("predicted_poses") - predicted
    run("slow clouds", "/parts/points: clouds at", cloud_hz=1.0)
    run("fast clouds", "", seconds=2.0, cloud_hz=60.0, wait=False)
    fast = status(node.last("diagnostics"))["bom: inputs"]["values"]
    # A publisher that the node's subscription cannot take.
    begin = time.monotonic()
    unfit = node.create_publisher(TFMessage, "/tf", quality(reliable=False))
    text = "/tf: a publisher's QoS does not fit"
    node.wait(lambda: node.diagnosed(text) and node.logged(text), 5.0)
    found["QoS"] = [round(node.diagnosed(text) - begin, 3)] if node.diagnosed(text) and node.logged(text) else None
    node.destroy_publisher(unfit)
    return {
        "quiet": quiet["message"],
        "found": found,
        "going_on": going_on,
        "fast": {key: value for key, value in fast.items() if "points" in key},
        "state": node.call("get_state", GetState).current_state.label,
        "diagnostics": status(node.last("diagnostics")),
    }


def load(seconds="60", rate="30", points="10000", reliable=""):
    """A cabinet of real size: a body and three drawers, one pulled after the other, at a camera's rate."""
    node = Peer()
    ready(node)
    rng = numpy.random.default_rng(2)
    count, rate, seconds = int(points), float(rate), float(seconds)
    body = box(rng, count, (0.0, 0.0, 0.5), (0.5, 0.6, 1.0))
    drawers = {2 + k: box(rng, count, (0.26, 0.0, 0.25 + 0.3 * k), (0.03, 0.5, 0.25)) for k in range(3)}
    clouds = node.create_publisher(PointCloud2, "/parts/points", quality(reliable=bool(reliable), depth=2))
    wrenches = node.create_publisher(WrenchStamped, "/wrench", quality(reliable=False, depth=100))
    tf = node.create_publisher(TFMessage, "/tf", quality(depth=100))
    node.wait(lambda: node.count_subscribers("/tf") > 0 and node.count_subscribers("/parts/points") > 0, 20.0)
    node.spin(1.0)
    # One drawer after the other is pulled out by 0.2 m and pushed back: 3 s, then 1 s of rest.
    def opening(t):
        phase, which = t % 4.0, 2 + int(t // 4.0) % 3
        if phase > 3.0 or t < 2.0:
            return which, 0.0, 0.0, False
        w = 2.0 * numpy.pi / 3.0
        x, v, a = (0.1 * (1 - numpy.cos(w * phase)), 0.1 * w * numpy.sin(w * phase), 0.1 * w * w * numpy.cos(w * phase))
        return which, x, 2.0 * a + 5.0 * v + 2.0 * numpy.tanh(v / 0.01), True

    wall, begin, sent, read, late = time.time(), time.monotonic(), 0, 0, 0.0
    sizes = []
    while time.monotonic() - begin < seconds:
        t = time.monotonic() - begin
        while read / 125.0 <= t:
            at = read / 125.0
            which, x, force, held = opening(at)
            transform = TransformStamped(child_frame_id="tool")
            transform.header.frame_id, transform.header.stamp = "world", stamp_at(wall + at)
            transform.transform.translation.x = 0.29 + x if held else 0.6
            transform.transform.translation.z = 0.25 + 0.3 * (which - 2)
            tf.publish(TFMessage(transforms=[transform]))
            message = WrenchStamped()
            message.header.frame_id, message.header.stamp = "tool", stamp_at(wall + at)
            message.wrench.force.x = force + rng.normal(0.0, 0.1)
            wrenches.publish(message)
            read += 1
        if sent / rate <= t:
            at = sent / rate
            which, x, _, _ = opening(at)
            parts = {1: body, **drawers}
            parts[which] = drawers[which] + numpy.array([x, 0.0, 0.0])
            clouds.publish(cloud(stamp_at(wall + at), parts))
            late = max(late, t - at)
            sent += 1
            if sent % int(5 * rate) == 0:
                sizes.append(status(node.last("diagnostics"))["bom: tracking"]["values"].get("memory [MB]"))
        rclpy.spin_once(node, timeout_sec=0.001)
    node.spin(2.0)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in node.heard[f"{NODE}/predicted_poses"]]
    return {
        "sent": sent,
        "predicted": len(stamps),
        "latest_send": late,
        "memory": sizes,
        "joints": joints(node.last("object_posterior")),
        "diagnostics": status(node.last("diagnostics")),
        "log": [m.msg for _, m in node.heard["/rosout"]],
    }


def main():
    rclpy.init()
    scenarios = {name: f for name, f in globals().items() if callable(f) and f.__module__ == "__main__"}
    print(json.dumps(scenarios[sys.argv[1]](*sys.argv[2:])))
    # The interpreter's end is not always a clean one for DDS.
    sys.stdout.flush()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
