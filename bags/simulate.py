"""Physics: a compliant tool pulls on one part after another; the rest follows."""
from dataclasses import dataclass, field

import mujoco
import numpy as np

import effects as fx

STEP = 0.0005          # s
WRENCH_STEPS = 16      # 125 Hz
CLOUD_STEPS = 200      # 10 Hz
SETTLE = 0.4           # s of rest before the first frame
LEAD, QUIET, TAIL = 1.0, 0.8, 0.8                                       # s
RAMP = 0.2             # s over which the tool takes hold and lets go


@dataclass
class Interaction:
    """One pull: when [s], on which part, where [m, frame of the body], and the joint positions it aims at."""
    part: object
    kind: str
    t0: float
    t1: float
    grip: np.ndarray                                # body frames are the object frame at zero, so this is both
    paths: dict = field(default_factory=dict)       # part name -> [(time since t0, joint position)]
    sway: np.ndarray = None                         # amplitude of the hand's error [m]
    sway_rate: float = 0.0                          # rad/s
    damping: float = 0.0                            # of the tool [N·s/m]
    last_pull: np.ndarray = None                    # stretch of the tool one step ago [m]


@dataclass
class Record:
    """What the simulation leaves: arrays at the wrench rate, joint states at the cloud rate."""
    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    force: np.ndarray
    contact: np.ndarray
    touched: np.ndarray
    cloud_t: np.ndarray
    cloud_q: np.ndarray
    cloud_contact: np.ndarray
    windows: list
    pushes: list


def minimum_jerk(path, t):
    """Position on a path of (time, value) pairs joined by minimum-jerk strokes."""
    for (ta, a), (tb, b) in zip(path[:-1], path[1:]):
        if t <= tb:
            s = min(max((t - ta) / (tb - ta), 0.0), 1.0)
            return a + (b - a) * s ** 3 * (10 - 15 * s + 6 * s * s)
    return path[-1][1]


class Planner:
    """Chooses the strokes of each interaction from where the joints stand at its start."""

    def __init__(self, parts, idle, rng):
        self.rng, self.parts = rng, {p.name: p for p in parts}
        movable = [p for p in parts if p.movable]
        ancestors = {p.parent for p in movable}
        leaves = [p for p in movable if p.name not in ancestors]
        resting = {p.name for p in rng.permutation(np.array(leaves, dtype=object))[:idle]} if idle else set()
        self.touchable = [p for p in movable if p.name not in resting]
        self.queue, self.kinds = [], []

    def next_part(self):
        if not self.queue:
            self.queue = list(self.rng.permutation(np.array(self.touchable, dtype=object)))
        return self.queue.pop()

    def next_kind(self):
        if not self.kinds:
            self.kinds = list(self.rng.permutation(["fast", "slow", "fast"]))
        return str(self.kinds.pop())

    def plan(self, t0, q):
        """The next interaction; q: current position of each joint by part name."""
        rng, part, kind = self.rng, self.next_part(), self.next_kind()
        length = rng.uniform(2.5, 4.5)
        move = Interaction(part, kind, t0, t0 + length, np.array(part.grips[rng.integers(len(part.grips))]))
        end = length - RAMP
        lead_in = 0.0
        leader = self.parts.get(part.follows)
        together = leader is not None and leader in self.touchable and rng.random() < 0.55
        if together and part.kind == "lever":                           # press first, then pull
            lead_in = rng.uniform(0.35, 0.45) * end
            down = part.span[1] * rng.uniform(0.75, 1.02)
            move.paths[part.name] = [(0, q[part.name]), (lead_in, down), (end, down)]
        else:
            move.paths[part.name] = self.strokes(part, q[part.name], kind, 0.0, end)
        while together:
            move.paths[leader.name] = self.strokes(leader, q[leader.name], "slow", lead_in, end)
            leader = self.parts.get(leader.follows)
            together = leader is not None and rng.random() < 0.4
        move.sway = rng.normal(size=3) * rng.uniform(0.002, 0.008)
        move.sway_rate = rng.uniform(2.0, 6.0)
        return move

    def strokes(self, part, q, kind, start, end):
        """A path from q at start to end: one or two strokes if slow, several if fast."""
        rng, (low, high) = self.rng, part.span
        reach = high - low
        top = (0.55 if part.joint == "prismatic" else 2.2) if kind == "fast" else (0.2 if part.joint == "prismatic" else 0.8)
        n = int(rng.integers(3, 5)) if kind == "fast" else int(rng.integers(1, 3))
        cuts = np.cumsum(rng.uniform(0.8, 1.2, n))
        times = start + (end - start) * cuts / cuts[-1]
        path, t = [(0, q)] + ([(start, q)] if start > 0 else []), start
        for i, tb in enumerate(times):
            limit = top * (tb - t) / 1.875
            near_low = q - low < high - q
            target = low + reach * (rng.uniform(0.45, 0.95) if near_low else rng.uniform(0.0, 0.5))
            if rng.random() < 0.22:
                target = high + 0.04 * reach if near_low else low - 0.04 * reach
            if i == n - 1 and part.kind in ("lid", "flap") and rng.random() < 0.6 and not near_low:
                target = low - 0.01 * reach
            q = q + float(np.clip(target - q, -limit, limit))
            path.append((float(tb), q))
            t = tb
        return path


class Simulation:
    """Steps the object through the interactions and records it."""

    def __init__(self, parts, mjcf, interactions, idle, joint_effects, pushes, rng):
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        self.data, self.aim = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self.parts = parts
        self.joints = [p for p in parts if p.movable]
        self.dof = {p.name: self.model.joint(p.name).dofadr[0] for p in self.joints}
        self.body = {p.name: self.model.body(p.name).id for p in parts}
        self.effects = {n: e for n, e in joint_effects.items() if e}
        self.count, self.rng, self.push_count = interactions, rng, pushes
        self.planner = Planner(parts, idle, rng)
        self.travel = np.zeros(self.model.nv)
        self.pushes = []

    def settle(self):
        """Lets the parts come to rest; this is then the first frame."""
        for _ in range(round(SETTLE / STEP)):
            self.declare_effects(0.0)
            mujoco.mj_step(self.model, self.data)
        self.data.time = 0.0
        self.data.qvel[:] = 0.0
        self.travel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        self.first = dict(q=self.data.qpos.copy(), com=self.data.xipos.copy(), axis=self.data.xaxis.copy(),
                          anchor=self.data.xanchor.copy(), inertia=self.mass_matrix_diagonal())

    def mass_matrix_diagonal(self):
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        return np.diag(full).copy()

    def declare_effects(self, t):
        """Sets friction bounds and undeclared joint forces for the coming step."""
        d, m = self.data, self.model
        d.qfrc_applied[:] = 0.0
        for part in self.joints:
            e = self.effects.get(part.name)
            if e:
                i = self.dof[part.name]
                x, v = d.qpos[i], d.qvel[i]
                m.dof_frictionloss[i] = fx.friction_bound(e, part.friction, x, v, self.travel[i])
                d.qfrc_applied[i] += fx.joint_force(e, part.damping, x, v)
        for p in self.pushes:
            if p["t0"] <= t < p["t0"] + p["span"]:
                d.qfrc_applied[self.dof[p["part"]]] += p["force"]

    def tool_force(self, move, t):
        """Force of the tool on the object and contact point, in world [N, m]."""
        d, b = self.data, self.body[move.part.name]
        contact = d.xpos[b] + d.xmat[b].reshape(3, 3) @ move.grip
        s = t - move.t0
        for name, path in move.paths.items():
            self.aim.qpos[self.dof[name]] = minimum_jerk(path, s)
        mujoco.mj_kinematics(self.model, self.aim)
        anchor = self.aim.xpos[b] + self.aim.xmat[b].reshape(3, 3) @ move.grip
        anchor = anchor + move.sway * np.sin(move.sway_rate * s) * min(1.0, s / 0.5)
        pull = anchor - contact
        rate = (pull - move.last_pull) / STEP if move.last_pull is not None else np.zeros(3)
        move.last_pull = pull
        gain = min(1.0, s / RAMP, (move.t1 - t) / RAMP)
        return max(gain, 0.0) * (move.part.stiffness * pull + move.damping * rate), contact

    def begin(self, move):
        """Fixes where the tool holds the part and how it is damped."""
        d, i = self.data, self.dof[move.part.name]
        lever = 1.0 if move.part.joint == "prismatic" else np.linalg.norm(np.cross(move.part.axis, move.grip - move.part.anchor))
        mass = self.first["inertia"][i] / lever ** 2
        move.damping = 2 * 0.7 * np.sqrt(move.part.stiffness * mass)
        self.aim.qpos[:] = d.qpos
        if self.push_count and self.rng.random() < 0.7:
            self.push_count -= 1
            size = (self.rng.uniform(6, 12) if move.part.joint == "prismatic" else self.rng.uniform(1.5, 3)) * self.rng.choice([-1, 1])
            self.pushes.append(dict(part=move.part.name, t0=float(move.t0 + self.rng.uniform(.3, .7) * (move.t1 - move.t0)),
                                    span=float(self.rng.uniform(.15, .4)), force=float(size)))

    def run(self):
        """Simulates all interactions."""
        self.settle()
        m, d = self.model, self.data
        rows, clouds, windows = [], [], []
        move, next_start, remaining, end = None, LEAD, self.count, None
        contact, k = np.full(3, np.nan), 0
        while end is None or k * STEP < end:
            t = k * STEP
            if move is None and remaining and t >= next_start - 1e-9:
                move = self.planner.plan(t, {p.name: d.qpos[self.dof[p.name]] for p in self.joints})
                remaining -= 1
                windows.append(move)
                self.begin(move)
            self.declare_effects(t)
            mujoco.mj_step1(m, d)
            force = np.zeros(3)
            if move is not None:
                force, contact = self.tool_force(move, t)
                b = self.body[move.part.name]
                d.xfrc_applied[b, :3] = force
                d.xfrc_applied[b, 3:] = np.cross(contact - d.xipos[b], force)
            if k % WRENCH_STEPS == 0:
                rows.append((t, d.qpos.copy(), d.qvel.copy(), force, contact if move is not None else np.full(3, np.nan),
                             len(windows) - 1 if move is not None else -1))
            if k % CLOUD_STEPS == 0:
                clouds.append((t, d.qpos.copy(), contact if move is not None else np.full(3, np.nan)))
            mujoco.mj_step2(m, d)
            self.travel += np.abs(d.qvel) * STEP
            k += 1
            if move is not None and k * STEP >= move.t1:
                d.xfrc_applied[:] = 0.0
                next_start = k * STEP + QUIET
                if not remaining:
                    end = k * STEP + TAIL
                move = None
        return Record(*(np.array(c) for c in zip(*rows)), *(np.array(c) for c in zip(*clouds)), windows, self.pushes)
