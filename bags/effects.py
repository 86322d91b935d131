"""Undeclared physics: generalized forces on joints [N or N·m] and changed friction bounds.

x is the joint position from its closed position [m or rad], v its rate, s the distance
travelled so far, t the time [s]. Names and parameters are those of the interface
contract; "asymmetric", "rail", "warm" and "pushes" name asymmetric_friction,
position_friction, friction that falls as the joint runs in, and impulse.
"""
import math

ALIASES = dict(asymmetric_friction="asymmetric", position_friction="rail", impulse="pushes",
               wrench_bias="bias", wrench_delay="delay")
SENSOR = ("bias", "delay")


def spring(p, x, v):
    return -p["stiffness"] * (x - p["rest"])


def catch(p, x, v):
    return -p["peak"] * math.exp(-max(x, 0.0) / p["width"])


def soft_close(p, x, v):
    if x >= p["range"]:
        return 0.0
    return -(p["stiffness"] * x + p["pull"] * math.tanh(x / 0.003) + (p["damping"] * v if v < 0 else 0.0))


def detent(p, x, v):
    return -p["peak"] * math.sin(2 * math.pi * x / p["period"] + p["phase"])


def self_closing(p, x, v):
    width = p["width_before"] if x < p["centre"] else p["width_after"]
    return -p["peak"] * math.exp(-0.5 * ((x - p["centre"]) / width) ** 2)


def drag(p, x, v):
    return -p["coefficient"] * v * abs(v)


def gravity_offset(p, x, v):
    return p["offset"]


FORCES = dict(spring=spring, catch=catch, soft_close=soft_close, detent=detent, self_closing=self_closing,
              drag=drag, gravity_offset=gravity_offset)


def friction_bound(effects, base, x, v, s):
    """The Coulomb bound [N or N·m] in force at this moment."""
    bound = base
    if "asymmetric_friction" in effects:
        p = effects["asymmetric_friction"]
        bound = p["friction_plus"] if v >= 0 else p["friction_minus"]
    if "stribeck" in effects:
        p = effects["stribeck"]
        bound += (p["static"] - base) * math.exp(-(v / p["stribeck_rate"]) ** 2)
    if "position_friction" in effects:
        p = effects["position_friction"]
        bound += p["amplitude"] * math.sin(2 * math.pi * x / p["period"] + p["phase"])
    if "warm" in effects:
        p = effects["warm"]
        bound += p["extra"] * math.exp(-s / p["distance"])
    return max(bound, 0.0)


def joint_force(effects, damping, x, v):
    """The sum of the undeclared generalized forces [N or N·m]."""
    force = sum(FORCES[name](p, x, v) for name, p in effects.items() if name in FORCES)
    if "asymmetric_friction" in effects:
        p = effects["asymmetric_friction"]
        force -= ((p["damping_plus"] if v >= 0 else p["damping_minus"]) - damping) * v
    return force


def draw(name, part, rng):
    """Random parameters of an effect on a joint, under its contract name."""
    slide = part.joint == "prismatic"
    u = lambda low, high: float(rng.uniform(low, high))
    reach, f, d = part.span[1] - part.span[0], part.friction, part.damping
    if name == "spring":
        return "spring", dict(stiffness=u(15, 35) if slide else u(0.8, 2.2), rest=0.0)
    if name == "catch":
        return "catch", dict(peak=u(5, 9) if slide else u(1.6, 3), width=u(.008, .016) if slide else u(.03, .06))
    if name == "soft_close":
        return name, (dict(range=u(.05, .09), stiffness=u(15, 40), pull=u(3, 6), damping=u(15, 40)) if slide else
                      dict(range=u(.25, .45), stiffness=u(.5, 1.5), pull=u(.6, 1.2), damping=u(.8, 2)))
    if name == "detent":
        return name, dict(peak=u(2, 4) if slide else u(.6, 1.2), period=u(.05, .09) if slide else u(.3, .5), phase=0.0)
    if name == "self_closing":
        return name, dict(peak=u(4, 8) if slide else u(1, 2), centre=u(.2, .4) * reach, width_before=u(.1, .2) * reach,
                          width_after=u(.05, .12) * reach)
    if name == "drag":
        return name, dict(coefficient=u(15, 40) if slide else u(.4, 1.0))
    if name == "stribeck":
        return name, dict(static=f * u(1.8, 2.6), stribeck_rate=u(.02, .05) if slide else u(.05, .15))
    if name == "asymmetric":
        return "asymmetric_friction", dict(friction_plus=f, friction_minus=f * u(1.8, 2.8), damping_plus=d, damping_minus=d * u(1, 2))
    if name == "rail":
        return "position_friction", dict(amplitude=f * u(.5, .9), period=u(.3, .8) * reach, phase=u(0, 6.28))
    if name == "warm":
        return "warm", dict(extra=f * u(1, 2), distance=reach * u(1, 2))
    if name == "gravity_offset":
        return name, dict(offset=-u(1, 1.6) * f)
    raise SystemExit(f"unknown effect {name}")
