#!/usr/bin/env python3
"""Simulates a robot pulling on a piece of articulated furniture and writes it as a ROS 2 bag with the truth beside it.

generate.py OBJECT --seed N --out DIR writes DIR/NAME.mcap (NAME: the folder's name), DIR/truth.json, DIR/truth.csv.
"""
import argparse
import csv
import inspect
import json
import os

import mujoco
import numpy as np

import effects as fx
import objects
import rosbag
import sensing
import simulate

EPOCH_NS = 1_760_000_000 * 10**9
CLOUD_LATENCY_NS = 30_000_000
FORCE_NOISE, TORQUE_NOISE, TOOL_NOISE = 0.1, 0.002, 0.001               # N, N·m, m


def arguments():
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("object", choices=sorted(objects.OBJECTS))
    p.add_argument("--seed", type=int, required=True)
    p.add_argument("--out", required=True, help="folder to write; its name names the bag")
    p.add_argument("--effect", action="append", default=[], help="undeclared physics, see effects.py; may be repeated")
    p.add_argument("--doors", type=int)
    p.add_argument("--drawers", type=int)
    p.add_argument("--panels", type=int)
    p.add_argument("--interactions", type=int, default=6)
    p.add_argument("--points", type=int, default=3000, help="per stamp, both cameras together")
    p.add_argument("--idle", type=int, default=0, help="movable parts never touched")
    p.add_argument("--mislabel", type=float, default=0.0, help="share of points with a random label")
    p.add_argument("--occluder", action="store_true", help="an arm hides part of what it moves")
    p.add_argument("--fused", action="store_true", help="one cloud in world instead of one per camera")
    p.add_argument("--turned-tool", action="store_true", help="the tool frame has its own fixed orientation")
    p.add_argument("--no-clouds", action="store_true")
    a = p.parse_args()
    a.effect = [fx.ALIASES.get(e, e) for e in a.effect]
    return a


def object_pose(rng):
    """Random pose on the floor: position [m], quaternion (w, x, y, z), rotation."""
    yaw, tilt = rng.uniform(-0.6, 0.6), rng.normal(size=2) * 0.008
    position = np.append(rng.uniform(-0.15, 0.15, 2), rng.uniform(0, 0.02))
    turn, lean, q, r = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(turn, np.array([0, 0, 1.0]), yaw)
    mujoco.mju_axisAngle2Quat(lean, np.append(tilt, 0) / np.linalg.norm(tilt), np.linalg.norm(tilt))
    mujoco.mju_mulQuat(q, lean, turn)
    mujoco.mju_quat2Mat(r, q)
    return position, q, r.reshape(3, 3)


def draw_effects(names, parts, rng):
    """Undeclared effects of every joint by part name, under their contract names."""
    drawn = {}
    for part in parts:
        if part.movable:
            drawn[part.name] = dict(fx.draw(n, part, rng) for n in names if n not in fx.SENSOR + ("pushes",))
    return drawn


def part_truth(part, sim, label_of, record, joint_effects, counts):
    """The entry of a part in truth.json."""
    body = sim.body[part.name]
    seen = np.array(counts[label_of[part.name]] or [0])
    entry = dict(name=part.name, kind=part.kind, joint=part.joint, parent=part.parent, label=label_of[part.name],
                 points_mean=float(seen.mean()), points_min=int(seen.min()),
                 parent_label=label_of.get(part.parent), mass_kg=float(sim.model.body_mass[body]),
                 com_world_m=sim.first["com"][body].tolist())
    if part.movable:
        dof, joint = sim.dof[part.name], sim.model.joint(part.name).id
        q = record.q[:, dof]
        entry.update(axis_direction_world=sim.first["axis"][joint].tolist(), axis_point_world_m=sim.first["anchor"][joint].tolist(),
                     range=list(map(float, part.span)), q_first=float(sim.first["q"][dof]), q_seen=[float(q.min()), float(q.max())],
                     damping=part.damping, friction=part.friction, subtree_mass_kg=float(sim.model.body_subtreemass[body]),
                     joint_inertia=float(sim.first["inertia"][dof]), acted=any(w.part is part for w in record.windows),
                     effects=joint_effects[part.name])
    return entry


def write_truth_table(path, sim, label_of, record):
    """truth.csv: every second wrench stamp, joint positions and rates, true force in world."""
    labels = [label_of[p.name] for p in sim.joints]
    dofs = [sim.dof[p.name] for p in sim.joints]
    with open(path, "w", newline="") as f:
        w = csv.writer(f, lineterminator="\n")
        w.writerow(["t_s"] + [f"q_{x}" for x in labels] + [f"qd_{x}" for x in labels] + ["fx_N", "fy_N", "fz_N"])
        for i in range(0, len(record.t), 2):
            row = [record.t[i], *record.q[i, dofs], *record.qd[i, dofs], *record.force[i]]
            w.writerow([f"{x:.8g}" for x in row])


def wrench_messages(record, tool, bias, delay, turned, epoch, rng):
    """WrenchStamped and the tool's transform, 125 Hz."""
    rotation, quaternion = np.eye(3), np.array([0, 0, 0, 1.0])
    if turned:
        q, r = rng.normal(size=4), np.zeros(9)
        q /= np.linalg.norm(q)
        mujoco.mju_quat2Mat(r, q)
        rotation, quaternion = r.reshape(3, 3), q[[1, 2, 3, 0]]
    offset = rng.normal(size=3) * 0.002
    late = np.stack([np.interp(record.t - delay, record.t, record.force[:, i]) for i in range(3)], axis=1)
    for i, t in enumerate(record.t):
        stamp = epoch + round(t * 1e9)
        # the bias lives in the sensor's own axes
        force = rotation.T @ late[i] + bias + rng.normal(size=3) * FORCE_NOISE
        origin = tool[i] + offset + rng.normal(size=3) * TOOL_NOISE
        yield stamp, "/wrench", rosbag.wrench_stamped(stamp, "ft_tool", force, rng.normal(size=3) * TORQUE_NOISE)
        yield stamp, "/tf", rosbag.transforms(stamp, [("world", "ft_tool", origin, quaternion)])


def cloud_messages(a, sim, record, tool, cameras, geom_labels, counts, epoch, rng):
    """PointCloud2 messages, 10 Hz; fills in the number of points of each label per stamp."""
    data = mujoco.MjData(sim.model)
    sensors = [sensing.DepthSensor(sim.model, geom_labels, c, a.points / 2, rng, a.mislabel) for c in cameras]
    arm = None
    if a.occluder:
        beside = 0.85 * cameras[0].origin + 0.15 * cameras[1].origin    # mostly in the way of the first camera
        arm = sensing.Occluder(sim.model, beside - [0, 0, 0.15])
    for t, q in zip(record.cloud_t, record.cloud_q):
        data.qpos[:] = q
        if arm:
            arm.pose(data, [np.interp(t, record.t, tool[:, i]) for i in range(3)])
        mujoco.mj_kinematics(sim.model, data)
        mujoco.mj_camlight(sim.model, data)
        stamp = epoch + round(t * 1e9)
        shots = [s.capture(data) for s in sensors]
        every = np.concatenate([label for _, label in shots])
        for label in counts:
            counts[label].append(int((every == label).sum()))
        if a.fused:
            xyz = np.concatenate([p @ c.rotation.T + c.origin for (p, _), c in zip(shots, cameras)])
            shots, frames = [(np.round(xyz / sensing.GRID) * sensing.GRID, every)], ["world"]
        else:
            frames = [c.name for c in cameras]
        for (xyz, label), frame in zip(shots, frames):
            yield stamp + CLOUD_LATENCY_NS, "/parts/points", rosbag.point_cloud(stamp, frame, xyz, label)


def main():
    a = arguments()
    rng = {k: np.random.default_rng([a.seed, i]) for i, k in enumerate(("object", "pose", "motion", "effects", "sensors", "labels"))}
    known = inspect.signature(objects.OBJECTS[a.object]).parameters
    given = {k: getattr(a, k) for k in ("doors", "drawers", "panels") if getattr(a, k) is not None and k in known}
    parts = objects.build(a.object, rng["object"], **given)
    position, quaternion, rotation = object_pose(rng["pose"])
    joint_effects = draw_effects(a.effect, parts, rng["effects"])
    direction = rng["effects"].normal(size=3)
    bias = direction / np.linalg.norm(direction) * rng["effects"].uniform(0.7, 1.3) if "bias" in a.effect else np.zeros(3)
    delay = float(rng["effects"].uniform(0.05, 0.12)) if "delay" in a.effect else 0.0
    mjcf = objects.to_mjcf(parts, position, quaternion, simulate.STEP, a.occluder)
    sim = simulate.Simulation(parts, mjcf, a.interactions, a.idle, joint_effects, 3 if "pushes" in a.effect else 0, rng["motion"])
    record = sim.run()

    labels = rng["labels"].permutation(len(parts)) + 1
    label_of = {p.name: int(x) for p, x in zip(parts, labels)}
    geom_labels = np.zeros(sim.model.ngeom, np.int64)
    for p in parts:
        geom_labels[sim.model.geom_bodyid == sim.body[p.name]] = label_of[p.name]
    start = mujoco.MjData(sim.model)
    start.qpos[:] = sim.first["q"]
    mujoco.mj_kinematics(sim.model, start)
    cameras = sensing.place_cameras(sim.model, start, np.flatnonzero(geom_labels), rotation, rng["sensors"])
    first_contact = record.contact[record.touched >= 0][0]
    tool = sensing.tool_path(record, first_contact + rotation @ [0.25, 0, 0.1], rotation @ [1.0, 0, 0.3], rng["sensors"])

    epoch = EPOCH_NS + a.seed * 10**9
    counts = {label: [] for label in label_of.values()}
    messages = [(epoch, "/tf_static", rosbag.transforms(epoch, [("world", c.name, c.origin, c.quaternion) for c in cameras]))]
    messages += wrench_messages(record, tool, bias, delay, a.turned_tool, epoch, rng["sensors"])
    if not a.no_clouds:
        messages += cloud_messages(a, sim, record, tool, cameras, geom_labels, counts, epoch, rng["sensors"])
    os.makedirs(a.out, exist_ok=True)
    name = os.path.basename(os.path.normpath(a.out))
    rosbag.write(f"{a.out}/{name}.mcap", messages)
    write_truth_table(f"{a.out}/truth.csv", sim, label_of, record)
    listed = {k: v for k, v in vars(a).items() if k != "out"}
    truth = dict(schema="bom.truth/1", object=a.object, seed=a.seed, args=listed, root_label=label_of[parts[0].name],
                 parts=[part_truth(p, sim, label_of, record, joint_effects, counts) for p in parts],
                 undeclared=a.effect, bias_N=bias.tolist(), delay_s=delay,
                 pushes=[dict(label=label_of[p["part"]], t0=p["t0"], span=p["span"], force=p["force"]) for p in record.pushes],
                 windows=[dict(t0=w.t0, t1=w.t1, label=label_of[w.part.name], kind=w.kind) for w in record.windows],
                 stamp_offset_ns=epoch, frames=len(record.cloud_t))
    with open(f"{a.out}/truth.json", "w") as f:
        json.dump(truth, f, indent=1)
        f.write("\n")
    size = os.path.getsize(f"{a.out}/{name}.mcap") / 1e6
    print(f"{name}: {a.object}, {len(parts)} parts, {record.t[-1]:.1f} s, {len(record.cloud_t)} clouds, {size:.1f} MB")


if __name__ == "__main__":
    main()
