"""Articulated objects as trees of boxes.

All coordinates are in the object frame [m]: x out of the front, y to the left,
z up, origin on the floor below the middle. Every part is drawn where it stands
with all joints at zero.
"""
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Box:
    """A solid cuboid: centre and half sizes [m], density [kg/m³]."""
    centre: tuple
    half: tuple
    density: float


@dataclass
class Part:
    """A rigid part, the joint that carries it and where a tool may grip it.

    joint: "root", "rigid", "prismatic" or "revolute". axis and anchor [m] in the
    object frame; span: lower and upper stop [m or rad]; damping [N·s/m or N·m·s/rad];
    friction [N or N·m]; grips: points [m] that a tool may pull on; stiffness: of that
    tool [N/m]; follows: the joint of this ancestor tends to be moved along.
    """
    name: str
    kind: str
    joint: str
    parent: str = None
    boxes: list = field(default_factory=list)
    axis: tuple = (0, 0, 1)
    anchor: tuple = (0, 0, 0)
    span: tuple = (0, 0)
    damping: float = 0.0
    friction: float = 0.0
    grips: list = field(default_factory=list)
    stiffness: float = 400.0
    follows: str = None

    @property
    def movable(self):
        return self.joint in ("prismatic", "revolute")

    def box(self, low, high, density):
        """Adds the cuboid between two corners [m]."""
        low, high = np.minimum(low, high), np.maximum(low, high)
        self.boxes.append(Box(tuple((low + high) / 2), tuple((high - low) / 2), density))


class Builder:
    """Draws sizes, masses, damping and friction at random."""

    def __init__(self, rng):
        self.rng = rng
        self.parts = []
        self.wood = rng.uniform(480, 640)
        self.board = rng.uniform(0.016, 0.022)

    def u(self, low, high):
        return float(self.rng.uniform(low, high))

    def log_u(self, low, high):
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def add(self, *args, **kwargs):
        part = Part(*args, **kwargs)
        self.parts.append(part)
        return part

    def root(self):
        return self.add("body", "root", "root")

    # --- pieces of furniture -------------------------------------------------

    def carcass(self, part, depth, y, z):
        """A box open at the front (x = 0), from x = −depth; y and z are (low, high)."""
        b, rho = self.board, self.wood
        part.box((-depth, y[0], z[0]), (-depth + b / 2, y[1], z[1]), rho)
        for side in y:
            inner = side + np.sign(np.mean(y) - side) * b
            part.box((-depth + b / 2, side, z[0]), (0, inner, z[1]), rho)
        for level in z:
            inner = level + np.sign(np.mean(z) - level) * b
            part.box((-depth + b / 2, y[0] + b, level), (0, y[1] - b, inner), rho)

    def front(self, part, y, z, handle_y, handle_z, upright, thickness=None):
        """A front plate before x = 0 with a bar handle; returns the grip [m]."""
        t = thickness or self.board
        part.box((0.002, y[0], z[0]), (0.002 + t, y[1], z[1]), self.wood)
        reach, length, width = self.u(0.028, 0.045), self.u(0.05, 0.09), self.u(0.007, 0.011)
        half = (width, length) if upright else (length, width)
        part.box((0.002 + t, handle_y - half[0], handle_z - half[1]),
                 (0.002 + t + reach, handle_y + half[0], handle_z + half[1]), 900)
        return (0.002 + t + reach, handle_y, handle_z)

    def door(self, name, parent, y, z, left=None, thickness=None, scale=1.0):
        """A door on a vertical hinge at its left (y high) or right edge."""
        left = bool(self.rng.integers(2)) if left is None else left
        hinge, free = (y[1], y[0]) if left else (y[0], y[1])
        inward = np.sign(hinge - free)
        part = self.add(name, "door", "revolute", parent, axis=(0, 0, 1.0 if left else -1.0),
                        anchor=(self.u(0.0, 0.012), hinge - inward * self.u(0.002, 0.012), np.mean(z)),
                        span=(0.0, self.u(1.4, 2.0)), damping=scale * self.log_u(0.1, 0.6),
                        friction=scale * self.log_u(0.1, 0.6), stiffness=self.u(250, 420))
        grip = self.front(part, y, z, free + inward * self.u(0.03, 0.05),
                          self.u(z[0] * .65 + z[1] * .35, z[0] * .35 + z[1] * .65), True, thickness)
        part.grips = [grip]
        return part

    def drawer(self, name, parent, depth, y, z):
        """A front with a hollow box behind it, sliding along x."""
        b, rho = self.board * 0.7, self.wood
        length = depth * self.u(0.78, 0.92)
        part = self.add(name, "drawer", "prismatic", parent, axis=(1, 0, 0),
                        anchor=(0, np.mean(y), np.mean(z)), span=(0.0, length * self.u(0.65, 0.9)),
                        damping=self.log_u(4, 12), friction=self.log_u(1.2, 5.5),
                        stiffness=self.u(350, 600))
        gy, gz = np.mean(y) + self.u(-.1, .1) * (y[1] - y[0]), np.mean(z) + self.u(-.1, .2) * (z[1] - z[0])
        part.grips = [self.front(part, y, z, gy, gz, False)]
        iy = (y[0] + self.board + 0.008, y[1] - self.board - 0.008)
        iz = (z[0] + 0.02, z[1] - self.u(0.03, 0.05))
        part.box((-length, iy[0], iz[0]), (0.002, iy[1], iz[0] + b), rho)
        part.box((-length, iy[0], iz[0] + b), (-length + b, iy[1], iz[1]), rho)
        for side, inner in ((iy[0], iy[0] + b), (iy[1], iy[1] - b)):
            part.box((-length + b, side, iz[0] + b), (0.002, inner, iz[1]), rho)
        return part

    def panel(self, name, parent, y, z):
        """A fixed front, with or without a dummy handle."""
        part = self.add(name, "panel", "rigid", parent)
        if self.rng.random() < 0.5:
            self.front(part, y, z, np.mean(y), np.mean(z), False)
        else:
            part.box((0.002, y[0], z[0]), (0.002 + self.board, y[1], z[1]), self.wood)
        return part

    def column(self, body, kinds, depth, y, z, names):
        """A carcass with fronts stacked from the floor up."""
        self.carcass(body, depth, y, z)
        weight = dict(door=(1.6, 2.3), drawer=(0.75, 1.1), panel=(0.6, 0.9))
        share = np.array([self.u(*weight[k]) for k in kinds])
        edges = z[0] + (z[1] - z[0]) * np.concatenate([[0], np.cumsum(share) / share.sum()])
        gap = 0.002
        for kind, name, low, high in zip(kinds, names, edges[:-1], edges[1:]):
            fy, fz = (y[0] + gap, y[1] - gap), (low + gap, high - gap)
            if kind == "drawer":
                self.drawer(name, "body", depth, fy, fz)
            else:
                getattr(self, kind)(name, "body", fy, fz)
            if high < z[1] - 0.01:
                b = self.board
                body.box((-depth + b / 2, y[0] + b, high - b / 4), (-0.01, y[1] - b, high + b / 4), self.wood)


def cabinet(b, doors=None, drawers=None, panels=None):
    """One or two columns of doors, drawers and fixed panels."""
    body = b.root()
    doors = int(b.rng.integers(1, 3)) if doors is None else doors
    drawers = int(b.rng.integers(1, 3)) if drawers is None else drawers
    panels = int(b.rng.integers(0, 2)) if panels is None else panels
    kinds = list(b.rng.permutation(["door"] * doors + ["drawer"] * drawers + ["panel"] * panels))
    names = [f"{k}_{i}" for i, k in enumerate(kinds)]
    depth, height = b.u(0.36, 0.5), b.u(0.72, 1.0)
    split = len(kinds) // 2 if doors > 1 else len(kinds)
    width = b.u(0.46, 0.66) if split == len(kinds) else b.u(0.8, 1.0)
    cut = width / 2 if split == len(kinds) else b.u(-0.06, 0.06)
    z = (b.u(0.02, 0.08), height)
    b.column(body, kinds[:split], depth, (-width / 2, cut), z, names[:split])
    if split < len(kinds):
        b.column(body, kinds[split:], depth, (cut, width / 2), z, names[split:])
    body.box((-depth - 0.01, -width / 2 - 0.01, height), (0.02, width / 2 + 0.01, height + 0.025), b.wood)


def small_cabinet(b):
    """One door and one drawer."""
    cabinet(b, 1, 1, 0)


def fridge(b):
    """A tall body with a big door, a small door above it and perhaps a drawer below."""
    body = b.root()
    width, depth, height = b.u(0.54, 0.66), b.u(0.5, 0.6), b.u(1.25, 1.5)
    left = bool(b.rng.integers(2))
    y, z0 = (-width / 2, width / 2), 0.04
    b.carcass(body, depth, y, (z0, height))
    z = z0
    if b.rng.random() < 0.6:
        z = z0 + b.u(0.2, 0.28)
        b.drawer("drawer", "body", depth, (y[0] + .003, y[1] - .003), (z0, z - .003))
    top = b.u(0.66, 0.74) * height
    thick = b.u(0.035, 0.05)
    b.door("door", "body", (y[0] + .003, y[1] - .003), (z + .003, top - .003), left, thick, 2.5)
    b.door("freezer", "body", (y[0] + .003, y[1] - .003), (top + .003, height - .003), left, thick, 2.0)


def chain(b):
    """Wall, door in it, lever handle on the door."""
    body = b.root()
    w, h, base = b.u(0.42, 0.56), b.u(0.6, 0.8), b.u(0.2, 0.4)
    jamb, head, thick = b.u(0.1, 0.18), b.u(0.08, 0.14), b.u(0.05, 0.08)
    y, z = (-w / 2, w / 2), (base, base + h)
    for low, high in ((y[0] - jamb, y[0]), (y[1], y[1] + jamb)):
        body.box((-thick, low, z[0] - 0.1), (0, high, z[1] + head), b.wood)
    body.box((-thick, y[0], z[1]), (0, y[1], z[1] + head), b.wood)
    body.box((-thick, y[0], z[0] - 0.1), (0, y[1], z[0]), b.wood)
    left = bool(b.rng.integers(2))
    hinge, free = (y[1], y[0]) if left else (y[0], y[1])
    inward = np.sign(hinge - free)
    leaf = b.u(0.028, 0.04)
    door = b.add("door", "door", "revolute", "body", axis=(0, 0, 1.0 if left else -1.0),
                 anchor=(b.u(0.002, 0.014), hinge - inward * 0.004, np.mean(z)), span=(0.0, b.u(1.3, 1.8)),
                 damping=b.log_u(0.25, 1.0), friction=b.log_u(0.3, 1.2), stiffness=b.u(250, 400))
    door.box((-leaf, y[0] + .004, z[0] + .004), (0, y[1] - .004, z[1] - .004), b.wood)
    pivot = (0.0, free + inward * b.u(0.06, 0.08), z[0] + h * b.u(0.42, 0.6))
    door.grips = [(0.0, free + inward * b.u(0.03, 0.05), pivot[2] + s * b.u(0.18, 0.28)) for s in (-1, 1)]
    reach, length, bar = b.u(0.05, 0.065), b.u(0.2, 0.26), b.u(0.024, 0.032)
    thin = b.u(0.02, 0.03)
    # pressed down, the free end of the lever (towards the hinge) sinks
    lever = b.add("lever", "lever", "revolute", "door", axis=(-inward, 0, 0), anchor=pivot,
                  span=(0.0, b.u(0.7, 1.0)), damping=b.log_u(0.02, 0.08), friction=b.log_u(0.35, 0.7),
                  stiffness=b.u(250, 350), follows="door")
    tip = pivot[1] + inward * length
    rho = b.u(420, 600)
    lever.box((0.001, pivot[1] - bar * .6, pivot[2] - bar * .6), (reach, pivot[1] + bar * .6, pivot[2] + bar * .6), rho)
    lever.box((reach, pivot[1] - inward * bar, pivot[2] - bar), (reach + thin, tip, pivot[2] + bar), rho)
    lever.grips = [(reach + thin, tip - inward * 0.02, pivot[2])]


def arm(b):
    """Pedestal, two links on near-vertical axes, telescoping end."""
    body = b.root()
    half, height = b.u(0.09, 0.13), b.u(0.45, 0.7)
    body.box((-half, -half, 0), (half, half, height), 300)
    body.box((-half - .1, -half - .1, 0), (half + .1, half + .1, 0.03), 500)
    w1, w2, w3 = b.u(0.04, 0.05), b.u(0.034, 0.044), b.u(0.02, 0.026)
    l1, l2, l3 = b.u(0.36, 0.48), b.u(0.34, 0.44), b.u(0.26, 0.34)
    lean = float(b.rng.normal(0, 0.01)), float(b.rng.normal(0, 0.01))
    z1, t = height + 0.004, b.u(0.05, 0.07)
    rho = b.u(350, 520)
    one = b.add("link1", "link", "revolute", "body", axis=(*lean, 1.0), anchor=(0, 0, height),
                span=(-b.u(0.8, 1.2), b.u(0.8, 1.2)), damping=b.log_u(0.25, 0.8), friction=b.log_u(0.3, 1.0),
                stiffness=b.u(250, 400))
    one.box((-w1, -w1, z1), (l1, w1, z1 + t), rho)
    one.grips = [(l1 - 0.02, w1, z1 + t * .6), (l1 - 0.03, -w1, z1 + t * .6)]
    z2 = z1 + t + 0.004
    two = b.add("link2", "link", "revolute", "link1", axis=(*lean[::-1], 1.0), anchor=(l1 - w1, 0, z2),
                span=(-b.u(1.0, 1.5), b.u(1.0, 1.5)), damping=b.log_u(0.15, 0.5), friction=b.log_u(0.25, 0.8),
                stiffness=b.u(250, 400), follows="link1")
    x0 = l1 - 2 * w1
    h2 = b.u(0.05, 0.065)
    for low, high in ((-w2, -w3 - .002), (w3 + .002, w2)):               # a channel, open above
        two.box((x0, low, z2), (x0 + l2, high, z2 + h2), rho * 1.6)
    two.box((x0, -w3 - .002, z2), (x0 + l2, w3 + .002, z2 + 0.012), rho * 1.6)
    two.grips = [(x0 + l2 - 0.02, w2, z2 + h2 / 2), (x0 + l2 - 0.02, -w2, z2 + h2 / 2)]
    tip = b.add("slider", "slider", "prismatic", "link2", axis=(1, 0, 0), anchor=(x0 + l2 / 2, 0, z2 + h2 / 2),
                span=(0.0, b.u(0.17, 0.24)), damping=b.log_u(4, 12), friction=b.log_u(1.5, 5), stiffness=b.u(300, 500),
                follows="link2")
    end = x0 + l2 + 0.06
    tip.box((end - l3, -w3, z2 + 0.014), (end, w3, z2 + h2 + 0.01), rho)
    tip.box((end, -b.u(0.06, 0.09), z2), (end + 0.02, b.u(0.06, 0.09), z2 + b.u(0.12, 0.18)), rho)
    tip.grips = [(end + 0.02, 0.0, z2 + 0.05)]


def flap(b):
    """A lid hinged at the back above, or an oven door hinged at its foot; a drawer below."""
    body = b.root()
    width, depth, height = b.u(0.56, 0.76), b.u(0.42, 0.55), b.u(0.55, 0.75)
    y, base = (-width / 2, width / 2), 0.03
    lid = b.rng.random() < 0.5
    cut = base + b.u(0.2, 0.26)
    b.carcass(body, depth, y, (base, cut))
    b.drawer("drawer", "body", depth, (y[0] + .003, y[1] - .003), (base, cut - .003))
    if lid:
        for side, inner in ((y[0], y[0] + b.board), (y[1], y[1] - b.board)):
            body.box((-depth, side, cut), (0, inner, height), b.wood)
        body.box((-b.board, y[0] + b.board, cut), (0, y[1] - b.board, height), b.wood)
        body.box((-depth, y[0] + b.board, cut), (-depth + b.board, y[1] - b.board, height), b.wood)
        part = b.add("lid", "lid", "revolute", "body", axis=(0, -1, 0), anchor=(-depth + b.u(0, .01), 0, height + b.u(0, .01)),
                     span=(0.0, b.u(1.2, 1.5)), damping=b.log_u(0.25, 0.8), friction=b.log_u(0.8, 5.0),
                     stiffness=b.u(350, 500))
        part.box((-depth, y[0] - .01, height + .001), (0.03, y[1] + .01, height + .001 + b.board), b.wood)
        part.grips = [(0.03, b.u(-.15, .15) * width, height + b.board / 2)]
    else:
        b.carcass(body, depth, y, (cut, height))
        part = b.add("oven_door", "flap", "revolute", "body", axis=(0, 1, 0), anchor=(b.u(.004, .012), 0, cut + .008),
                     span=(0.0, b.u(1.3, 1.57)), damping=b.log_u(0.6, 1.6), friction=b.log_u(0.8, 5.0),
                     stiffness=b.u(350, 500))
        part.grips = [b.front(part, (y[0] + .004, y[1] - .004), (cut + .004, height - .004), 0.0, height - 0.04, False)]
    body.box((-depth, y[0], 0), (-0.02, y[1], base), b.wood)


def sliding(b):
    """A low wardrobe whose flat doors slide sideways in their own planes."""
    body = b.root()
    width, depth, height = b.u(0.95, 1.25), b.u(0.34, 0.45), b.u(0.65, 0.9)
    y, z = (-width / 2, width / 2), (0.05, height)
    b.carcass(body, depth, y, z)
    body.box((-depth + b.board, -b.board / 2, z[0] + b.board), (-0.06, b.board / 2, z[1] - b.board), b.wood)
    overlap, t = b.u(0.02, 0.05), b.u(0.014, 0.02)
    iz = (z[0] + b.board + .004, z[1] - b.board - .004)
    both = b.rng.random() < 0.6
    sides = b.rng.permutation([1.0, -1.0])                              # the first runs in front
    for i, side in enumerate(sides):
        x = -0.008 - i * (t + 0.006)
        moving = both or i == 0
        low, high = sorted((-side * overlap, side * (width / 2 - b.board - 0.003)))
        part = b.add(f"slider_{i}" if moving else "fixed_leaf", "sliding_door" if moving else "panel",
                     "prismatic" if moving else "rigid", "body", axis=(0, -side, 0), anchor=(x, 0, np.mean(iz)),
                     span=(0.0, width / 2 - b.board - overlap - b.u(0.03, 0.1)), damping=b.log_u(4, 12),
                     friction=b.log_u(1.5, 6), stiffness=b.u(350, 550))
        part.box((x - t, low, iz[0]), (x, high, iz[1]), b.wood)
        edge, gz = side * (width / 2 - b.board - 0.045), b.u(0.45, 0.6) * height
        knob = 0.02 if i == 0 else 0.004
        part.box((x, edge - 0.012, gz - 0.06), (x + knob, edge + 0.012, gz + 0.06), 900)
        part.grips = [(x + knob, edge, gz)]
    if b.rng.random() < 0.5:
        top = height + b.u(0.14, 0.2)
        b.carcass(body, depth, y, (height, top))
        b.drawer("drawer", "body", depth, (y[0] + .003, y[1] - .003), (height + .003, top - .003))


def desk(b):
    """A table top over two stacks of drawers."""
    body = b.root()
    width, depth, height = b.u(1.1, 1.35), b.u(0.5, 0.62), b.u(0.7, 0.76)
    stack, top = b.u(0.34, 0.42), 0.03
    body.box((-depth - .02, -width / 2 - .02, height - top), (0.03, width / 2 + .02, height), b.wood)
    n = 0
    for side in (-1, 1):
        y = tuple(sorted((side * width / 2, side * (width / 2 - stack))))
        kinds = ["drawer"] * int(b.rng.integers(1, 4)) + (["door"] if b.rng.random() < 0.35 else [])
        b.column(body, kinds, depth, y, (0.04, height - top), [f"{k}_{n + i}" for i, k in enumerate(kinds)])
        n += len(kinds)


def chest(b):
    """A branching tree: base, carriage sliding on it, lid on the carriage, drawer in the base."""
    body = b.root()
    width, depth, h0 = b.u(0.75, 0.95), b.u(0.42, 0.52), b.u(0.24, 0.32)
    y = (-width / 2, width / 2)
    b.carcass(body, depth, y, (0.03, h0))
    b.drawer("tray", "body", depth, (y[0] + .003, y[1] - .003), (0.033, h0 - .003))
    sideways = b.rng.random() < 0.5
    cw, cd, ch = width * b.u(0.45, 0.6), depth * b.u(0.72, 0.9), b.u(0.16, 0.24)
    y0 = y[0] + b.u(0.01, 0.03) if sideways else b.u(-.1, .1) - cw / 2
    cy, cx = (y0, y0 + cw), (-0.02 - cd, -0.02)
    z = (h0 + 0.006, h0 + ch)
    box = b.add("carriage", "carriage", "prismatic", "body", axis=(0, 1, 0) if sideways else (1, 0, 0),
                anchor=(np.mean(cx), np.mean(cy), h0), span=(0.0, b.u(0.2, width - cw - .04) if sideways else b.u(0.2, 0.3)),
                damping=b.log_u(4, 11), friction=b.log_u(1.2, 4.5), stiffness=b.u(350, 550))
    t = 0.014
    box.box((cx[0], cy[0], z[0]), (cx[1], cy[1], z[0] + t), b.wood)
    for low, high in ((cx[0], cx[0] + t), (cx[1] - t, cx[1])):
        box.box((low, cy[0], z[0] + t), (high, cy[1], z[1]), b.wood)
    for low, high in ((cy[0], cy[0] + t), (cy[1] - t, cy[1])):
        box.box((cx[0] + t, low, z[0] + t), (cx[1] - t, high, z[1]), b.wood)
    box.grips = [(cx[1], np.mean(cy) + b.u(-.05, .05), z[0] + ch * 0.5)]
    lid = b.add("lid", "lid", "revolute", "carriage", axis=(0, -1, 0), anchor=(cx[0] + b.u(0, .008), np.mean(cy), z[1] + b.u(0, .006)),
                span=(0.0, b.u(1.2, 1.5)), damping=b.log_u(0.08, 0.4), friction=b.log_u(0.4, 2.2), stiffness=b.u(250, 350),
                follows="carriage")
    lid.box((cx[0], cy[0] - .006, z[1] + .001), (cx[1] + .03, cy[1] + .006, z[1] + .001 + t), b.wood)
    lid.grips = [(cx[1] + .03, np.mean(cy) + b.u(-.06, .06), z[1] + t / 2)]


OBJECTS = dict(cabinet=cabinet, small_cabinet=small_cabinet, fridge=fridge, chain=chain, arm=arm, flap=flap,
               sliding=sliding, desk=desk, chest=chest)


def build(name, rng, **counts):
    """The parts of a randomly drawn object, parents before children."""
    builder = Builder(rng)
    OBJECTS[name](builder, **counts) if counts else OBJECTS[name](builder)
    return builder.parts


def to_mjcf(parts, position, quaternion, step, occluder=False):
    """MuJoCo XML of the parts; position [m] and quaternion (w, x, y, z) put the object in world; step [s]."""
    triple = lambda v: " ".join(f"{float(x):.17g}" for x in v)
    children = {}
    for p in parts:
        children.setdefault(p.parent, []).append(p)

    def body(p):
        where = f'pos="{triple(position)}" quat="{triple(quaternion)}"' if p.joint == "root" else 'pos="0 0 0"'
        out = [f'<body name="{p.name}" {where}>']
        if p.movable:
            out.append(f'<joint name="{p.name}" type="{"slide" if p.joint == "prismatic" else "hinge"}" axis="{triple(p.axis)}" '
                       f'pos="{triple(p.anchor)}" range="{triple(p.span)}" damping="{p.damping:.17g}" frictionloss="{p.friction:.17g}"/>')
        out += [f'<geom type="box" pos="{triple(x.centre)}" size="{triple(x.half)}" density="{x.density:.17g}"/>' for x in p.boxes]
        return "\n".join(out + [body(c) for c in children.get(p.name, [])] + ["</body>"])

    arm_bodies = "" if not occluder else "\n".join(
        f'<body name="{n}" mocap="true" pos="0 0 9"><geom type="capsule" size="{r} {h}"/></body>'
        for n, r, h in (("occluder_hand", .065, .05), ("occluder_fore", .055, .22), ("occluder_upper", .075, .28)))
    return f"""<mujoco>
<compiler angle="radian" autolimits="true"/>
<option timestep="{step}" gravity="0 0 -9.81" integrator="Euler" iterations="100" tolerance="1e-12"/>
<default>
 <geom contype="0" conaffinity="0"/>
 <joint armature="0" solreflimit="0.004 1" solimplimit=".99 .9999 .0005" solreffriction="{2 * step} 1" solimpfriction=".9999 .9999 .001"/>
</default>
<worldbody>
{body(parts[0])}
{arm_bodies}
</worldbody>
</mujoco>"""
