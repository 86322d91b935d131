"""Random chains simulated by MuJoCo, as a reference for `tests/mujoco.rs`.

    python tests/mujoco_peer/trajectories.py > tests/mujoco_peer/trajectories.json

Every joint has viscous damping and Coulomb friction; some have limits. A force that is piecewise
linear in time pulls at a point of one body. All is in world at the reference configuration. Friction
and limits are at the stiffest that MuJoCo allows (impedance .9999). Its integrator and its friction
are of first order in the step, so two runs at .1 and .05 ms are extrapolated to zero; `--check` prints
how far the result moves when both steps are doubled.
"""

import argparse
import json
import sys

import mujoco
import numpy as np

STEP_S = 5e-5
DURATION_S = 4.0
OUTPUT_S = 0.05
FORCE_S = 0.1
SOFTNESS_S = 0.01


def rounded(values, digits=6):
    return [round(float(v), digits) for v in np.ravel(values)]


def random_chain(rng, joints, types=None):
    """A chain of `joints` bodies; numbers are rounded here, so that both sides see the same."""
    bodies = []
    anchor = rng.uniform(-0.5, 0.5, 3) + [0.0, 0.0, 1.0]
    for j in range(joints):
        kind = types[j] if types else rng.choice(["prismatic", "revolute"])
        turns = kind == "revolute"
        axis = rng.normal(size=3)
        axis = np.array(rounded(axis / np.linalg.norm(axis)))
        com = anchor + rng.uniform(-0.25, 0.25, 3)
        half = rng.uniform(0.03, 0.25, 3)
        mass = rng.uniform(0.5, 4.0)
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        limited = rng.random() < 0.5
        reach = rng.uniform(0.2, 0.8) if turns else rng.uniform(0.05, 0.25)
        bodies.append(
            {
                "type": kind,
                "axis": rounded(axis),
                "point": rounded(anchor),
                "mass": round(mass, 6),
                "com": rounded(com),
                "principal": rounded(mass / 3 * (half @ half - half**2)),
                "quaternion": rounded(quaternion, 9),
                "damping": round(rng.uniform(0.05, 0.5) if turns else rng.uniform(0.5, 8.0), 6),
                "friction": round(rng.uniform(0.02, 0.6) if turns else rng.uniform(0.2, 4.0), 6),
                "range": rounded([-reach, reach]) if limited else None,
            }
        )
        anchor = com + rng.uniform(-0.2, 0.2, 3)
    gravity = [0.0, 0.0, -9.81] if rng.random() < 0.7 else [0.0, 0.0, 0.0]
    knots = round(DURATION_S / FORCE_S) + 1
    times = np.arange(knots) * FORCE_S
    force = np.zeros((knots, 3))
    for _ in range(3):
        frequency, phase = rng.uniform(0.2, 1.2), rng.uniform(0, 2 * np.pi)
        force += np.outer(np.sin(2 * np.pi * frequency * times + phase), rng.uniform(-6, 6, 3))
    on = rng.integers(0, joints)
    return {
        "bodies": bodies,
        "gravity": gravity,
        "force_body": int(on),
        "force_point": rounded(np.array(bodies[on]["com"]) + rng.uniform(-0.15, 0.15, 3)),
        "force_period_s": FORCE_S,
        "force": [rounded(f, 4) for f in force],
        "softness_s": SOFTNESS_S,
    }


def xml_of(chain, step):
    """Bodies at the origin of world at the reference configuration, so all points are world's."""
    friction = f"{2 * step} 1"
    text = f'<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="Euler" '
    text += 'iterations="200" tolerance="1e-14" solver="Newton" cone="elliptic" gravity="'
    text += " ".join(map(str, chain["gravity"])) + '"/><worldbody>'
    for i, b in enumerate(chain["bodies"]):
        def words(key, b=b):
            return " ".join(map(str, b[key]))

        kind = "hinge" if b["type"] == "revolute" else "slide"
        text += f'<body name="b{i}"><joint type="{kind}" axis="{words("axis")}" '
        text += f'pos="{words("point")}" damping="{b["damping"]}" frictionloss="{b["friction"]}" '
        text += f'solreffriction="{friction}" solimpfriction=".9999 .9999 .001 .5 2" '
        if b["range"]:
            text += f'limited="true" range="{words("range")}" margin="0" '
            text += f'solreflimit="{chain["softness_s"]} 1" solimplimit=".9999 .9999 .001 .5 2" '
        text += f'/><inertial pos="{words("com")}" quat="{words("quaternion")}" '
        text += f'mass="{b["mass"]}" diaginertia="{words("principal")}"/>'
    return text + "</body>" * len(chain["bodies"]) + "</worldbody></mujoco>"


def simulate(chain, step):
    model = mujoco.MjModel.from_xml_string(xml_of(chain, step))
    data = mujoco.MjData(model)
    body = chain["force_body"] + 1
    point = np.array(chain["force_point"])
    force = np.array(chain["force"])
    period = chain["force_period_s"]
    every = round(OUTPUT_S / step)
    positions = []
    for i in range(round(DURATION_S / step) + 1):
        if i % every == 0:
            positions.append(data.qpos.copy())
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        # A step takes the force of its middle.
        place = min((i + 0.5) * step / period, len(force) - 1 - 1e-9)
        first = int(place)
        f = force[first] + (place - first) * (force[first + 1] - force[first])
        now = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
        data.qfrc_applied[:] = 0
        mujoco.mj_applyFT(model, data, f, np.zeros(3), now, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    return np.array(positions)


def extrapolated(chain, step):
    return 2 * simulate(chain, step) - simulate(chain, 2 * step)


def chains():
    rng = np.random.default_rng(20)
    for joints, count in [(1, 4), (2, 4), (3, 4)]:
        for _ in range(count):
            yield random_chain(rng, joints)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare with steps twice as long")
    arguments = parser.parse_args()
    result = []
    for chain in chains():
        positions = extrapolated(chain, STEP_S)
        if arguments.check:
            coarse = extrapolated(chain, 2 * STEP_S)
            kinds = "+".join(b["type"] for b in chain["bodies"])
            print(
                f"{kinds}: steps doubled {np.abs(coarse - positions).max():.2e}, "
                f"travel {np.ptp(positions, axis=0)}",
                file=sys.stderr,
            )
        chain["output_period_s"] = OUTPUT_S
        chain["positions"] = [rounded(p, 7) for p in positions]
        result.append(chain)
    json.dump({"mujoco": mujoco.__version__, "chains": result}, sys.stdout, separators=(",", ":"))
    print()


if __name__ == "__main__":
    main()
