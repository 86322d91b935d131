"""Loads a URDF with yourdfpy, which is not ours: urdf.py FILE POSITIONS, a file with a JSON list of {joint: position}.

Prints {joints: [[name, type, lower, upper, damping, friction], …], masses: {link: kg}, vertices: {link: count},
poses: for each of the given positions {link: the 4×4 transform from the base link}}.
"""

import json
import sys
import urllib.parse

import numpy
import yourdfpy



def file_of(fname):
    """The path of a file URI."""
    scheme, path = fname[:7], fname[7:]
    if scheme != "file://":
        sys.exit(f"{fname}: expected a file URI")
    return urllib.parse.unquote(path)


robot = yourdfpy.URDF.load(
    sys.argv[1],
    build_collision_scene_graph=True,
    load_meshes=True,
    load_collision_meshes=True,
    filename_handler=file_of,
)
if not robot.validate():
    sys.exit(str(robot.errors))

joints = []
for name, joint in robot.joint_map.items():
    limit, dynamics = joint.limit, joint.dynamics
    joints.append(
        [
            name,
            joint.type,
            limit.lower if limit else None,
            limit.upper if limit else None,
            # Read as text.
            float(dynamics.damping) if dynamics else None,
            float(dynamics.friction) if dynamics else None,
        ]
    )
masses = {name: link.inertial.mass for name, link in robot.link_map.items() if link.inertial}
for link in robot.link_map.values():
    if link.inertial and numpy.linalg.eigvalsh(link.inertial.inertia).min() <= 0:
        sys.exit(f"{link.name}: inertia {link.inertial.inertia}")
vertices = {}
for name in robot.link_map:
    for node in robot.scene.graph.transforms.children.get(name, []):
        geometry = robot.scene.graph[node][1]
        if geometry:
            vertices[name] = len(robot.scene.geometry[geometry].vertices)
poses = []
with open(sys.argv[2], encoding="utf-8") as file:
    wanted = json.load(file)
for positions in wanted:
    robot.update_cfg({name: q for name, q in positions.items()})
    poses.append({name: robot.get_transform(name).tolist() for name in robot.link_map})
json.dump({"joints": joints, "masses": masses, "vertices": vertices, "poses": poses}, sys.stdout)
