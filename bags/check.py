#!/usr/bin/env python3
"""Checks bags against their truth, without stepping the simulator: check.py BAG_FOLDER...

Joint inertia from the boxes alone; kinematics by the product of exponentials against
MuJoCo; parts at rest stay at rest; the reported wrench explains the motion (loosely, where
physics is undeclared; late or biased wrenches show as residuals).
"""
import csv
import json
import math
import os
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import generate
import objects

GRAVITY = np.array([0, 0, -9.81])


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def screw(part, q):
    """The displacement of a joint by q as a 4×4 transform in world."""
    n, a = np.array(part["axis_direction_world"]), np.array(part["axis_point_world_m"])
    d = np.eye(4)
    if part["joint"] == "prismatic":
        d[:3, 3] = n * q
    else:
        d[:3, :3] = np.eye(3) + math.sin(q) * skew(n) + (1 - math.cos(q)) * skew(n) @ skew(n)
        d[:3, 3] = a - d[:3, :3] @ a
    return d


class Bag:
    """Truth of a bag and the object it was drawn from."""

    def __init__(self, folder):
        self.folder, self.name = folder, os.path.basename(os.path.normpath(folder))
        self.truth = json.load(open(f"{folder}/truth.json"))
        rows = list(csv.reader(open(f"{folder}/truth.csv")))
        table = np.array(rows[1:], float)
        self.column = {h: table[:, i] for i, h in enumerate(rows[0])}
        self.t = self.column["t_s"]
        self.part = {p["label"]: p for p in self.truth["parts"]}
        self.joints = [p for p in self.truth["parts"] if "q_first" in p]
        self.rebuild()

    def rebuild(self):
        a = SimpleNamespace(**self.truth["args"])
        rng = [np.random.default_rng([a.seed, i]) for i in range(2)]
        given = {k: getattr(a, k) for k in ("doors", "drawers", "panels") if getattr(a, k) is not None and a.object == "cabinet"}
        self.parts = objects.build(a.object, rng[0], **given)
        self.position, quaternion, self.rotation = generate.object_pose(rng[1])
        self.model = mujoco.MjModel.from_xml_string(objects.to_mjcf(self.parts, self.position, quaternion, 0.0005))
        self.data = mujoco.MjData(self.model)

    def chain(self, label):
        """Joint parts from the root to a label."""
        up = []
        while label is not None:
            up.append(self.part[label])
            label = self.part[label]["parent_label"]
        return up[::-1]

    def displacement(self, label, i):
        d = np.eye(4)
        for p in self.chain(label):
            if "q_first" in p:
                d = d @ screw(p, self.column[f"q_{p['label']}"][i] - p["q_first"])
        return d


def kinematics_error(bag):
    """Largest distance [m] between the truth's centres of mass and MuJoCo's, over some rows."""
    worst = 0.0
    for i in range(0, len(bag.t), 50):
        for p in bag.joints:
            bag.data.qpos[bag.model.joint(p["name"]).qposadr[0]] = bag.column[f"q_{p['label']}"][i]
        mujoco.mj_kinematics(bag.model, bag.data)
        for p in bag.truth["parts"]:
            com = (bag.displacement(p["label"], i) @ np.append(p["com_world_m"], 1))[:3]
            worst = max(worst, np.linalg.norm(com - bag.data.xipos[bag.model.body(p["name"]).id]))
    return worst


def inertia_error(bag):
    """Largest relative error of joint_inertia against a sum over the boxes of the subtree."""
    worst = 0.0
    for p in bag.joints:
        below = [x for x in bag.parts if p["label"] in [c["label"] for c in bag.chain(next(q["label"] for q in bag.truth["parts"] if q["name"] == x.name))]]
        axis = bag.rotation.T @ p["axis_direction_world"]
        point = bag.rotation.T @ (np.array(p["axis_point_world_m"]) - bag.position)
        total = 0.0
        for box in (b for x in below for b in x.boxes):
            h, c = np.array(box.half), np.array(box.centre) - point
            mass = 8 * np.prod(h) * box.density
            own = mass / 3 * np.diag([h[1]**2 + h[2]**2, h[0]**2 + h[2]**2, h[0]**2 + h[1]**2])
            total += mass if p["joint"] == "prismatic" else axis @ own @ axis + mass * np.sum(np.cross(axis, c)**2)
        worst = max(worst, abs(p["joint_inertia"] / total - 1))
    return worst


def rest_drift(bag):
    """Largest movement [m or rad] of a joint in the last .3 s before each pull, for joints that friction holds."""
    worst = 0.0
    for w in bag.truth["windows"]:
        i = (bag.t > w["t0"] - 0.3) & (bag.t < w["t0"] - 0.01)
        for p in bag.joints:
            q = bag.column[f"q_{p['label']}"][i]
            if abs(bag.column[f"qd_{p['label']}"][i][0]) < 1e-4:
                worst = max(worst, np.ptp(q))
    return worst


def read_wrench(bag):
    """Stamps [s], forces and tool positions in world from the bag."""
    wrench, tool = [], []
    with open(f"{bag.folder}/{bag.name}.mcap", "rb") as f:
        for _, channel, _, m in make_reader(f, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics=["/wrench", "/tf"]):
            if channel.topic == "/wrench":
                v = m.wrench.force
                wrench.append((m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, v.x, v.y, v.z))
            else:
                x = m.transforms[0].transform
                tool.append((x.translation.x, x.translation.y, x.translation.z, x.rotation.w, x.rotation.x, x.rotation.y, x.rotation.z))
    wrench, tool = np.array([[w[0] - bag.truth["stamp_offset_ns"], *w[1:]] for w in wrench], float), np.array(tool)
    r = np.zeros(9)
    mujoco.mju_quat2Mat(r, tool[0, 3:])
    return wrench[:, 0] * 1e-9, wrench[:, 1:] @ r.reshape(3, 3).T, tool[:, :3]


def sliding(bag, part, i):
    """Whether a joint moves steadily around row i, clear of its stops, so that friction is known."""
    near = slice(max(i - 2, 0), i + 3)
    q, v = bag.column[f"q_{part['label']}"][near], bag.column[f"qd_{part['label']}"][near]
    floor = 0.02 if part["joint"] == "prismatic" else 0.06
    low, high = part["range"]
    return min(abs(v)) > floor and abs(np.sum(np.sign(v))) == len(v) and low + .01 < min(q) and max(q) < high - .01


def dynamics_report(bag):
    """Inertia, damping and friction fitted to the reported wrench over the truth, for joints whose ancestors and descendants rest."""
    tw, force, tool = read_wrench(bag)
    out = []
    for p in bag.joints:
        rows, label = [], p["label"]
        parents = [c["label"] for c in bag.chain(label)[:-1]]
        family = parents + [x["label"] for x in bag.joints if x is not p and p in bag.chain(x["label"])]
        for w in bag.truth["windows"]:
            if w["label"] != label:
                continue
            for i in np.flatnonzero((bag.t > w["t0"] + 0.05) & (bag.t < w["t1"] - 0.05)):
                v = bag.column[f"qd_{label}"]
                if not sliding(bag, p, i):
                    continue
                if any(abs(bag.column[f"qd_{x}"][i]) > 1e-4 for x in family if f"qd_{x}" in bag.column):
                    continue
                j = np.argmin(abs(tw - bag.t[i]))
                d = bag.displacement(p["parent_label"], i)
                n, a = d[:3, :3] @ p["axis_direction_world"], (d @ np.append(p["axis_point_world_m"], 1))[:3]
                pull = n @ force[j] if p["joint"] == "prismatic" else n @ np.cross(tool[j] - a, force[j])
                for x in [p] + [x for x in bag.truth["parts"] if x is not p and p in bag.chain(x["label"])]:
                    com = (bag.displacement(x["label"], i) @ np.append(x["com_world_m"], 1))[:3]
                    weight = x["mass_kg"] * GRAVITY
                    pull += n @ weight if p["joint"] == "prismatic" else n @ np.cross(com - a, weight)
                rows.append((pull, (v[i + 1] - v[i - 1]) / (bag.t[i + 1] - bag.t[i - 1]), v[i], np.sign(v[i])))
        if len(rows) < 60:
            out.append(f"{p['name']}: {len(rows)} usable rows")
            continue
        rows = np.array(rows)
        fit, *_ = np.linalg.lstsq(rows[:, 1:], rows[:, 0], rcond=None)
        exact = np.array([p["joint_inertia"], p["damping"], p["friction"]])
        rms = np.sqrt(np.mean((rows[:, 0] - rows[:, 1:] @ exact) ** 2))
        out.append(f"{p['name']}: fit/truth inertia {fit[0]/exact[0]:.3f} damping {fit[1]/exact[1]:.3f} friction {fit[2]/exact[2]:.3f}, residual at truth {rms:.3f} of {np.std(rows[:, 0]):.2f}")
    return out


def coupled_residual(bag):
    """Per joint, the RMS [N or N·m] of what the reported wrench leaves unexplained when all joints move, at the truth's parameters."""
    tw, force, tool = read_wrench(bag)
    m, d = bag.model, bag.data
    dof = {p["label"]: m.joint(p["name"]).dofadr[0] for p in bag.joints}
    rest, pulls = {p["label"]: [] for p in bag.joints}, {p["label"]: [] for p in bag.joints}
    full, jac = np.zeros((m.nv, m.nv)), np.zeros((3, m.nv))
    for w in bag.truth["windows"]:
        body = m.body(bag.part[w["label"]]["name"]).id
        for i in np.flatnonzero((bag.t > w["t0"] + 0.05) & (bag.t < w["t1"] - 0.05)):
            rate, acceleration = np.zeros(m.nv), np.zeros(m.nv)
            for label, k in dof.items():
                v = bag.column[f"qd_{label}"]
                d.qpos[k], rate[k] = bag.column[f"q_{label}"][i], v[i]
                acceleration[k] = (v[i + 1] - v[i - 1]) / (bag.t[i + 1] - bag.t[i - 1])
            d.qvel[:] = rate
            mujoco.mj_forward(m, d)
            mujoco.mj_fullM(m, d, full)
            j = np.argmin(abs(tw - bag.t[i]))
            mujoco.mj_jac(m, d, jac, None, tool[j], body)
            applied = jac.T @ force[j]
            missing = applied - full @ acceleration - d.qfrc_bias
            for p in bag.joints:
                k = dof[p["label"]]
                if sliding(bag, p, i):
                    rest[p["label"]].append(missing[k] - p["damping"] * rate[k] - p["friction"] * np.sign(rate[k]))
                    pulls[p["label"]].append(applied[k])
    return ", ".join(f"{p['name']} {np.sqrt(np.mean(np.square(rest[p['label']]))):.3f} of {np.std(pulls[p['label']]):.2f}" for p in bag.joints if rest[p["label"]])


def main():
    failed = False
    for folder in sys.argv[1:]:
        bag = Bag(folder)
        k, i, r = kinematics_error(bag), inertia_error(bag), rest_drift(bag)
        bad = k > 1e-4 or i > 1e-6 or (r > 2e-5 and not bag.truth["undeclared"])
        failed |= bad
        print(f"{bag.name}: {'BAD' if bad else 'ok'}; kinematics {k * 1e6:.2g} µm, inertia {i:.1e}, rest drift {r * 1e6:.2g} µm (µrad); undeclared {bag.truth['undeclared']}")
        for line in dynamics_report(bag):
            print("   ", line)
        print("    coupled residual RMS:", coupled_residual(bag))
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
