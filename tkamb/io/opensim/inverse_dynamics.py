"""Generalised forces that an OpenSim model's motion takes, from its bodies' momentum.

With the twist J_b of body b per unit of the coordinates (in ground, at ground's origin), its
momentum h_b there, gravity g at its centre of mass c and the other wrenches w_b that act on it,

    τ = Σ_b J_bᵀ (dh_b/dt - (c × m g, m g) - w_b).

Accelerations go out along the chain: each axis s, with its angle or translation u(q), adds
s ü + (v × s) u̇, where v is the twist of what carries the axis and × the cross product of
twists. Translations come first, then the rotations in turn, seen from the parent frame.

Reference: Featherstone, Rigid Body Dynamics Algorithms (2008), chapters 2 and 5.
"""

from collections.abc import Mapping

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.io.opensim.kinematics import Kinematics, Motion


def inverse_dynamics(
    kinematics: Kinematics,
    q: Array,
    rates: Array,
    accelerations: Array,
    wrenches: Mapping[str, Array] | None = None,
) -> Array:
    """Return the generalised forces τ (f, n), N·m and N, one for each coordinate.

    Constraints and couplers play no part: each coordinate is taken as it is given.

    Args:
        kinematics: of the model.
        q: (f, n) coordinates, rad and m.
        rates: (f, n) their rates.
        accelerations: (f, n) their second derivatives by time.
        wrenches: body -> (f, 6) moment (N·m) above force (N) on it, in ground at ground's
            origin, such as the ground reaction on a foot.
    """
    motion = kinematics.motion(q)
    needed = required_wrenches(kinematics, motion, q, rates, accelerations, wrenches)
    return np.einsum("fbin,fbi->fn", motion.twists, needed)


def required_wrenches(
    kinematics: Kinematics,
    motion: Motion,
    q: Array,
    rates: Array,
    accelerations: Array,
    wrenches: Mapping[str, Array] | None = None,
) -> Array:
    """Return what else must act on each body (f, b, 6), beside gravity and the given wrenches.

    Moment (N·m) above force (N), in ground at ground's origin; zero for ground. Over the bodies
    beyond a joint, this sums up to what muscles, ligaments and the joint itself exert on them.

    Args:
        kinematics: of the model.
        motion: at q.
        q: (f, n) coordinates.
        rates: (f, n) their rates.
        accelerations: (f, n) their second derivatives by time.
        wrenches: body -> (f, 6), as in `inverse_dynamics`.
    """
    twists = np.einsum("fbin,fn->fbi", motion.twists, rates)
    result = np.zeros_like(twists)
    twist_rates = _accelerations(kinematics, motion, twists, q, rates, accelerations)
    for name, body in kinematics.model.bodies.items():
        b = kinematics.bodies[name]
        rotation = motion.poses[:, b, :3, :3]
        centre = rotation @ body.centre + motion.poses[:, b, :3, 3]
        tensor = rotation @ body.inertia @ np.swapaxes(rotation, -1, -2)
        omega, alpha = twists[:, b, :3], twist_rates[:, b, :3]
        speed = twists[:, b, 3:] + np.cross(omega, centre)
        acceleration = twist_rates[:, b, 3:] + np.cross(alpha, centre) + np.cross(omega, speed)
        force = body.mass_kg * (acceleration - kinematics.model.gravity)
        angular_momentum = np.einsum("fij,fj->fi", tensor, omega)
        moment = np.einsum("fij,fj->fi", tensor, alpha) + np.cross(omega, angular_momentum)
        result[:, b] = np.hstack([np.cross(centre, force) + moment, force])
        if wrenches is not None and name in wrenches:
            result[:, b] -= wrenches[name]
    return result


def _accelerations(
    kinematics: Kinematics, motion: Motion, twists: Array, q: Array, rates: Array, second: Array
) -> Array:
    """Return the rate (f, b, 6) of each body's twist."""
    result = np.zeros_like(twists)
    speeds, axis_accelerations = kinematics.axis_rates(q, rates, second)
    first = 0
    for joint in kinematics.model.joints:
        count = len(joint.rotations)
        last = first + count + len(joint.translations)
        inboard, outboard = kinematics.bodies[joint.inboard], kinematics.bodies[joint.outboard]
        carrier = twists[:, kinematics.bodies[joint.parent]]
        total = np.zeros_like(carrier)
        # Translations lie in the parent frame, beneath the rotations.
        for a in (*range(first + count, last), *range(first, first + count)):
            axis, speed = motion.axes[:, a], speeds[:, a, None]
            total += axis * axis_accelerations[:, a, None] + _cross(carrier, axis) * speed
            carrier = carrier + axis * speed
        sign = -1.0 if joint.backwards else 1.0
        result[:, outboard] = result[:, inboard] + sign * total
        first = last
    return result


def _cross(twist: Array, axis: Array) -> Array:
    """Return the cross product (f, 6) of twists: the rate of an axis carried along."""
    omega, speed = twist[:, :3], twist[:, 3:]
    linear = np.cross(omega, axis[:, 3:]) + np.cross(speed, axis[:, :3])
    return np.hstack([np.cross(omega, axis[:, :3]), linear])
