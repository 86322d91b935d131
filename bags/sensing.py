"""Two depth cameras by ray casting, and a force sensor, with their errors."""
from dataclasses import dataclass

import mujoco
import numpy as np

FOCAL = 600.0                  # px
DISPARITY_STEP = 1.05e-3       # 1/m: depth steps of this × z²
SILHOUETTE_GAP = 0.02          # m of depth between neighbours
DROPOUT = 0.03
FLYING, BLEED = 0.3, 0.35      # chance at a silhouette
GRID = 2.0 ** -13              # m, to which coordinates are rounded (for the size of the file)


@dataclass
class Camera:
    """An optical frame (x right, y down, z forward) in world: origin [m], rotation."""
    name: str
    origin: np.ndarray
    rotation: np.ndarray

    @property
    def quaternion(self):
        """(x, y, z, w)"""
        q = np.zeros(4)
        mujoco.mju_mat2Quat(q, self.rotation.flatten())
        return q[[1, 2, 3, 0]]


def look_at(name, origin, target):
    """A camera at origin that looks at target [m, world], upright."""
    z = (target - origin) / np.linalg.norm(target - origin)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return Camera(name, origin, np.stack([x, np.cross(z, x), z], axis=1))


def corners(model, data, geoms):
    """Corners of box geoms in world [m]."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    local = model.geom_size[geoms][:, None, :] * signs
    return (np.einsum("gij,gcj->gci", data.geom_xmat[geoms].reshape(-1, 3, 3), local) + data.geom_xpos[geoms][:, None, :]).reshape(-1, 3)


class DepthSensor:
    """Casts the rays of a camera on a pixel grid that moves from frame to frame."""

    def __init__(self, model, labels, camera, target, rng, mislabel=0.0):
        self.model, self.camera, self.rng = model, camera, rng
        self.labels = labels                           # by geom; 0: not a part
        self.part_geoms = np.flatnonzero(labels)
        self.target, self.stride, self.mislabel = target, None, mislabel
        self.known = np.unique(labels[labels > 0])

    def cast(self, data, pixels):
        """Depth along the optical axis [m] (inf: nothing), geom and the cosine of incidence at each pixel."""
        rays = np.column_stack([pixels / FOCAL, np.ones(len(pixels))])
        length = np.linalg.norm(rays, axis=1)
        world = (rays / length[:, None]) @ self.camera.rotation.T
        n = len(rays)
        geom, dist, normal = np.full(n, -1, np.int32), np.zeros(n), np.zeros(3 * n)
        mujoco.mj_multiRay(self.model, data, self.camera.origin, np.ascontiguousarray(world).ravel(), None, True, -1,
                           geom, dist, normal, n, 1e10)
        depth = np.where(geom >= 0, dist / length, np.inf)
        cosine = np.abs(np.sum(normal.reshape(-1, 3) * world, axis=1))
        return depth, geom, cosine

    def grid(self, data):
        """Integer pixels over the object's extent in the image."""
        p = (corners(self.model, data, self.part_geoms) - self.camera.origin) @ self.camera.rotation
        uv = FOCAL * p[:, :2] / p[:, 2:]
        low, high = uv.min(0), uv.max(0)
        if self.stride is None:
            self.stride = np.sqrt(np.prod(high - low) * 0.6 / self.target)
        axes = [np.round(np.arange(a + self.rng.uniform(0, self.stride), b, self.stride)) for a, b in zip(low, high)]
        return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)

    def tune(self, data):
        """Finds the stride that yields the wanted number of points."""
        for _ in range(3):
            _, geom, _ = self.cast(data, self.grid(data))
            self.follow(np.sum((geom >= 0) & (self.labels[geom] > 0)))

    def follow(self, hits):
        """Adapts the stride to the number of rays that met a part."""
        self.stride *= np.sqrt(np.clip(hits * (1 - DROPOUT) / self.target, 0.5, 2.0))

    def capture(self, data):
        """Points in the optical frame [m] and their labels."""
        rng = self.rng
        if self.stride is None:
            self.tune(data)
        pixels = self.grid(data)
        depth, geom, cosine = self.cast(data, pixels)
        label = np.where(geom >= 0, self.labels[geom], 0)
        seen = label > 0
        self.follow(seen.sum())
        pixels, depth, label, cosine = pixels[seen], depth[seen], label[seen], cosine[seen]
        step = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[rng.integers(4, size=len(pixels))]
        beside, geom, _ = self.cast(data, pixels + step)
        other = np.where(geom >= 0, self.labels[geom], 0)
        edge = (np.abs(beside - depth) > SILHOUETTE_GAP) | ((other != label) & (other > 0))
        flying = edge & (rng.random(len(depth)) < FLYING) & (np.abs(beside - depth) > SILHOUETTE_GAP)
        behind = np.where(np.isfinite(beside), beside, depth + 0.4)
        z = np.where(flying, depth + rng.random(len(depth)) * (behind - depth), depth)
        bleed = edge & (other > 0) & (rng.random(len(depth)) < BLEED)
        label = np.where(bleed, other, label)
        wrong = rng.random(len(label)) < self.mislabel
        shift = rng.integers(1, len(self.known), len(label))
        label = np.where(wrong, self.known[(np.searchsorted(self.known, label) + shift) % len(self.known)], label)
        z = z + rng.normal(size=len(z)) * (0.0008 + 0.0016 * z * z)
        z = 1.0 / (np.round(1.0 / z / DISPARITY_STEP) * DISPARITY_STEP)
        keep = (rng.random(len(z)) > DROPOUT) & (rng.random(len(z)) < cosine / 0.12) & (z > 0.2) & (z < 6)
        points = np.column_stack([pixels / FOCAL, np.ones(len(z))]) * z[:, None]
        return np.round(points[keep] / GRID) * GRID, label[keep]


def place_cameras(model, data, geoms, object_rotation, rng):
    """Two cameras before the object, left and right, looking at its front half."""
    points = corners(model, data, geoms)
    low, high = points.min(0), points.max(0)
    target = (low + high) / 2 + object_rotation @ [0.1, 0, 0]
    distance = 1.25 + 0.75 * np.linalg.norm(high - low)
    cameras = []
    for i, side in enumerate((-1, 1)):
        azimuth, elevation = side * rng.uniform(0.4, 0.85), rng.uniform(0.4, 0.7)
        direction = object_rotation @ [np.cos(azimuth), np.sin(azimuth), 0]
        direction[2] = np.tan(elevation)
        origin = target + direction / np.linalg.norm(direction) * min(distance, 2.5) * rng.uniform(0.92, 1.08)
        cameras.append(look_at(f"camera_{i}_optical", origin, target + rng.normal(size=3) * 0.03))
    return cameras


class Occluder:
    """A robot arm of three capsules between the contact point and the cameras; it carries no label."""

    def __init__(self, model, shoulder):
        self.names = ("occluder_hand", "occluder_fore", "occluder_upper")
        self.mocap = [model.body(n).mocapid[0] for n in self.names]
        self.half = [model.geom_size[model.body(n).geomadr[0], 1] for n in self.names]
        self.shoulder = shoulder

    def pose(self, data, tool):
        """Puts the hand at the tool and the links behind it, towards the shoulder [m, world]."""
        start = np.asarray(tool, float)
        towards = (self.shoulder - start) / np.linalg.norm(self.shoulder - start)
        bends = (towards, towards + [0, 0, 0.25], towards - [0, 0, 0.15])
        start = start + 0.05 * towards
        for mocap, half, bend in zip(self.mocap, self.half, bends):
            along = bend / np.linalg.norm(bend)
            data.mocap_pos[mocap] = start + along * half
            mujoco.mju_quatZ2Vec(data.mocap_quat[mocap], along)
            start = start + along * 2 * half


def tool_path(record, home, out, rng):
    """Position of the tool [m, world] at every wrench: on the contact while touching, in the air between."""
    tool = record.contact.copy()
    touching = np.flatnonzero(record.touched >= 0)
    free = np.flatnonzero(record.touched < 0)
    for run in np.split(free, np.flatnonzero(np.diff(free) > 1) + 1):
        before, after = run[0] - 1, run[-1] + 1
        a = tool[before] if before >= 0 else home
        b = record.contact[after] if after < len(tool) else home
        s = (np.arange(len(run)) + 1) / (len(run) + 1)
        ease = s ** 2 * (3 - 2 * s)
        tool[run] = a + (b - a) * ease[:, None] + out * (0.15 * np.sin(np.pi * s) ** 2)[:, None]
    return tool
