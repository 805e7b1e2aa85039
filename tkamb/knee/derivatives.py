"""Derivatives of the knee's forces and of a model's dynamics with them.

w_L is the wrench of all loads on a link L (tibia, femur, patella) about the insert's origin, in the
insert frame. It depends on the pose of the femur, on the coordinates c of the patella, and by
friction on the twist s of the femur relative to the insert. xi_L is the twist of L relative to the
insert per joint velocity. Then

    dw_L/dq = K_L xi_F + C_L dc/dq + D_L ds/dq,        dw_L/dv = D_L xi_F,

and the force f of L in the frame of its joint changes by

    df = A (dw_L - xi_L x* w_L),

where A maps a force from the insert frame to the joint's frame. The second term is geometric: a
force that is constant in the insert frame turns in the frame of a joint that moves against the
insert. For a twist (v, w) and a force (f, m), (v, w) x* (f, m) = (w x f, w x m + v x f).

If the model has no patella, its coordinates solve three equations g(pose, c) = 0: gap, length of
the patellar ligament, moment (`tkamb.knee.patella_search`). By the implicit function theorem

    dc = -(dg/dc)^-1 (dg/dpose) xi_F.

The derivatives of pin.aba and pin.rnea with constant forces come from Pinocchio. The change of the
forces adds J_j^T df_j for each joint j with its Jacobian J_j:

    da/dq = (da/dq)_f + M^-1 sum_j J_j^T df_j/dq,
    dtau/dq = (dtau/dq)_f - sum_j J_j^T df_j/dq.

All derivatives by q are in the tangent space (`pin.integrate(model, q, dq)`), with v constant in
the axes of the joints. Those of the extensor mechanism by the femur's pose and c are inner central
differences of its closed forms (no search is repeated); all others are analytic.

Reference: Carpentier & Mansard, Analytical derivatives of rigid body dynamics algorithms, RSS
(2018), doi:10.15607/RSS.2018.XIV.038.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.geometry.frames import Array, cross_matrix, displaced
from tkamb.knee.anatomy import FixedFrame
from tkamb.knee.canonical import KneePose, force_cross, mirrored_spatial, summed

if TYPE_CHECKING:
    from tkamb.knee.assembled import KneeData
    from tkamb.knee.knee import Knee
    from tkamb.knee.patella import PatellaState


# m: step of the femur's pose. Rounding errors and the error of the difference are below 1e-7 of the
# derivative.
POSE_STEP = 1e-7
# m: step of the patella's coordinates. Shorter, because the facets under the button are short.
PATELLA_STEP = 1e-8
# 1: relative difference of one-sided differences from which an edge of a facet lies between them.
# Without an edge it is proportional to the step: in 30 states its median was 4e-5 by ten times
# `POSE_STEP` and 5e-6 by ten times `PATELLA_STEP`. An edge that is not noticed makes an error of at
# most half of it.
EDGE = 1e-5
# m: lever arm; a rotation's step is the step over this arm. Chosen as half the distance of the
# condyles.
FORCE_DERIVATIVE_ARM = 0.025
# m and rad: step of q for the twist of a model with mimic joints, for which Pinocchio has no
# velocity derivatives. J(q) is smooth.
JOINT_STEP = 1e-6


LINKS = ("tibia", "femur", "patella")


@dataclass(frozen=True, eq=False)
class RelativeTwists:
    """Twists of the knee's bodies per joint velocity, in the insert frame of the user's knee.

    Args:
        femur: xi relative to the insert, (6, nv).
        patella: xi of the link "patella" relative to the insert, (6, nv).
        coordinates: derivative of the patella's coordinates, (3, nv), if the model has one.
    """

    femur: Array
    patella: Array
    coordinates: Array | None


def forces_and_derivatives(
    knee: "Knee", q: Array, v: Array, tensions: Any, data: "KneeData"
) -> tuple[Any, Array, Array]:
    """Return the results of `Knee.external_forces` and `Knee.external_forces_derivatives`."""
    if knee.contact is not None:
        knee.contact.check_differentiable()
    muscle_tensions = knee._tensions(tensions)
    heads = {} if knee.patella is None else knee._take_heads(muscle_tensions)
    twists = relative_twists(knee, q, data, knee._loads_patella(muscle_tensions))
    kinematics = knee._kinematics(data, q, v)
    wrenches, by_q, by_v = _between(knee, data, kinematics, twists, q, v)
    beside, slopes = _beside(knee, data, kinematics, muscle_tensions, twists)
    if heads:
        beside, slopes = _with_released_patella(
            knee, data, kinematics, heads, twists, beside, slopes
        )
    for link, wrench in beside.items():
        wrenches[link] = wrenches[link] + wrench
        by_q[link] = by_q[link] + slopes[link]
    shape = knee.model.njoints, 6, knee.model.nv
    df_dq, df_dv = np.zeros(shape), np.zeros(shape)
    for link in LINKS if beside else LINKS[:2]:
        joint, to_joint = knee.bridge.joint_of(link), knee.bridge.to_joint(data.data, link)
        wrench, change, rate = (_users(knee, m[link]) for m in (wrenches, by_q, by_v))
        twist = {"femur": twists.femur, "patella": twists.patella}.get(link)
        # The tibia does not move against the insert; the other bodies do.
        if twist is not None:
            change = change - force_cross(twist, wrench)
        df_dq[joint] += to_joint @ change
        df_dv[joint] += to_joint @ rate
    for name, line in knee._lines.items():
        if tension := muscle_tensions.get(name, 0.0):
            line.add_derivatives(knee.model, data.data, tension, df_dq)
    forces = knee.bridge.joint_forces(data.data, wrenches)
    return knee._with_lines(data, muscle_tensions, forces), df_dq, df_dv


def relative_twists(
    knee: "Knee", q: Array, data: "KneeData", loads_patella: bool
) -> RelativeTwists:
    """Update `data`, return the twists at q.

    Those of an unloaded patella are not computed.
    """
    femur, bridge, anatomy = knee.relative_jacobian(q, data), knee.bridge, knee.anatomy
    if anatomy.patella is None or knee.extensor is None or not loads_patella:
        return RelativeTwists(femur, femur, None)
    pin_data = data.data
    patella = _relative_jacobian(knee.model, pin_data, anatomy.patella, bridge.insert)
    # In the patella's plane: twist and pose of the patella, mirrored for a left knee.
    in_plane = _relative_jacobian(knee.model, pin_data, anatomy.patella, anatomy.plane)
    in_plane = _users(knee, in_plane)
    plane = pin_data.oMi[anatomy.plane.joint] * anatomy.plane.placement
    placement = pin_data.oMi[anatomy.patella.joint] * anatomy.patella.placement
    pose = bridge.of_right_knee(plane.actInv(placement))
    centre = in_plane[:3] - cross_matrix(pose[:3, 3]) @ in_plane[3:]
    front = -cross_matrix(pose[:3, 0]) @ in_plane[3:]
    # The rotation is the angle of the patella's x axis in the plane: d atan2(y, x).
    x, y = pose[0, 0], pose[1, 0]
    rotation = (x * front[1] - y * front[0]) / (x**2 + y**2)
    return RelativeTwists(femur, patella, np.stack([centre[0], centre[1], rotation]))


def _users(knee: "Knee", columns: Array) -> Array:
    """Mirror twists or wrenches (6, ...) between a right knee and the user's."""
    return mirrored_spatial(columns.T).T if knee.left else columns


def _relative_jacobian(model: Any, data: Any, follower: FixedFrame, base: FixedFrame) -> Array:
    """Return one body's twist (6, nv) relative to another, at the origin of `base`."""
    placement, total = data.oMi[base.joint] * base.placement, np.zeros((6, model.nv))
    for frame, sign in ((follower, 1.0), (base, -1.0)):
        if frame.joint:
            local = pin.getJointJacobian(model, data, frame.joint, pin.ReferenceFrame.LOCAL)
            to_base = placement.actInv(data.oMi[frame.joint]).toActionMatrix()
            total += sign * to_base @ local.reshape(6, -1)
    return total


def _between(
    knee: "Knee",
    data: "KneeData",
    kinematics: KneePose,
    twists: RelativeTwists,
    q: Array,
    v: Array,
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
    """Return link -> wrench (6,), derivatives (6, nv) by q and by v, of a right knee's contact and
    femorotibial ligaments.
    """
    on_insert, by_q = np.zeros(6), np.zeros((6, knee.model.nv))
    by_v, femur = np.zeros_like(by_q), _users(knee, twists.femur)
    stiffness = knee._crossing_stiffness(kinematics)
    if knee.contact is not None:
        twist = knee.bridge.twist(data.data)
        contact = knee._contact_at(data, kinematics)
        on_insert += knee.contact.wrench(contact, twist)
        stiffness = stiffness + knee.contact.stiffness(
            data.probe, kinematics.pose, contact, twist, True
        )
        if knee.friction:
            damping = knee.contact.damping(contact, twist)
            by_v = damping @ femur
            if np.any(v):
                by_q = damping @ _users(knee, twist_derivative(knee, data.data, twists.femur, q, v))
    if knee._crossing is not None:
        on_insert += knee._crossing.wrench(kinematics.pose)
    # Action and reaction: the femur's wrench is the opposite of the tibia's.
    by_q = by_q + stiffness @ femur
    zero = np.zeros(6), np.zeros_like(by_q), np.zeros_like(by_q)
    total = on_insert, by_q, by_v
    wrenches, slopes, rates = (
        {"tibia": one, "femur": -one, "patella": nothing}
        for one, nothing in zip(total, zero, strict=True)
    )
    return wrenches, slopes, rates


def twist_derivative(knee: "Knee", data: Any, femur: Array, q: Array, v: Array) -> Array:
    """Return the derivative (6, nv) of the femur's twist relative to the insert by q, at v.

    It is in the insert frame of the user's knee, as is `femur`, the twist per joint velocity, (6,
    nv).
    """
    model, bridge = knee.model, knee.bridge
    if len(model.mimicking_joints):
        return _twist_differences(knee, q, v)
    pin.computeForwardKinematicsDerivatives(model, data, q, v, np.zeros(model.nv))
    insert = data.oMi[bridge.insert.joint] * bridge.insert.placement
    total = np.zeros((6, model.nv))
    for frame, sign in ((bridge.component, 1.0), (bridge.insert, -1.0)):
        if not frame.joint:
            continue
        by_q, _ = pin.getJointVelocityDerivatives(
            model, data, frame.joint, pin.ReferenceFrame.LOCAL
        )
        to_insert = insert.actInv(data.oMi[frame.joint])
        total += sign * to_insert.toActionMatrix() @ by_q
        if sign > 0.0:
            # The femur's axes turn against the insert: xi x (X v_F).
            velocity = to_insert.act(data.v[frame.joint])
            total -= velocity.action @ femur
    return total


def _twist_differences(knee: "Knee", q: Array, v: Array) -> Array:
    """Return `twist_derivative` by central differences of J(q) v."""
    model, step = knee.model, JOINT_STEP
    columns = []
    for direction in step * np.eye(model.nv):
        ahead, behind = (
            knee.relative_jacobian(pin.integrate(model, q, sign * direction)) @ v
            for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * step))
    return np.array(columns).T


Loads = Mapping[str, Array]


def _beside(
    knee: "Knee",
    data: "KneeData",
    kinematics: KneePose,
    tensions: Mapping[str, float],
    twists: RelativeTwists,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return link -> wrench (6,), and derivative (6, nv), of extensor mechanism and ligaments that
    end on the patella.
    """
    if not knee._loads_patella(tensions):
        return {}, {}
    patella = knee._find_patella(kinematics, data) if knee.extensor_lines is not None else None
    by_pose, by_patella, wrenches = _slopes_beside(knee, kinematics, patella, tensions)
    femur = _users(knee, twists.femur)
    slopes = {link: by_pose[link] @ femur for link in LINKS}
    if patella is not None:
        change = twists.coordinates
        # Without a patella in the model its equilibrium gives its movement.
        if change is None:
            change = _patella_slopes(knee, kinematics, patella) @ femur
        slopes = {link: slopes[link] + by_patella[link] @ change for link in LINKS}
    return wrenches, slopes


def _with_released_patella(
    knee: "Knee",
    data: "KneeData",
    kinematics: KneePose,
    heads: Mapping[str, float],
    twists: RelativeTwists,
    beside: Loads,
    slopes: Loads,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the result of `_beside` with the loads of a released patella added."""
    from tkamb.knee.patella_equilibrium import PulledTibiaSlopes, pulled_tibia

    button = knee.button_contact
    assert knee.patella is not None and button is not None
    button.contact.check_differentiable()
    wrench, body, coordinates = pulled_tibia(knee, kinematics, heads, data)
    slopes_of = PulledTibiaSlopes.of(body, coordinates, knee.patella.released)
    slope = slopes_of.by_displacement() @ _users(knee, twists.femur)
    total, change = dict(beside), dict(slopes)
    for link, sign in (("tibia", 1.0), ("femur", -1.0)):
        total[link] = total.get(link, np.zeros(6)) + sign * wrench
        change[link] = change.get(link, np.zeros_like(slope)) + sign * slope
    return total, change


def _slopes_beside(
    knee: "Knee",
    kinematics: KneePose,
    patella: "PatellaState | None",
    tensions: Mapping[str, float],
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
    """Return link -> derivative by the pose (6, 6), by the patella (6, 3), and wrench (6,)."""

    def total(pose: Array, state: "PatellaState | None") -> Array:
        loads = summed(knee._loads_beside(replace(kinematics, pose=pose), state, tensions))
        return np.concatenate([loads.get(link, np.zeros(6)) for link in LINKS])

    if patella is None:
        by_pose = _pose_differences(lambda pose: total(pose, None), kinematics.pose)
        by_patella, here = np.zeros((18, 3)), total(kinematics.pose, None)
    else:
        lines, pose = knee.extensor_lines, kinematics.pose
        assert lines is not None
        contact = lines.mechanism.contact.at(patella.coordinates)
        by_pose = _pose_differences(
            lambda moved: total(moved, lines.given(moved, patella.coordinates, contact)), pose
        )
        by_patella = _patella_differences(
            lambda coordinates: total(pose, lines.given(pose, coordinates)), patella.coordinates
        )
        here = total(pose, patella)
    return tuple(  # type: ignore[return-value]
        {link: part[6 * k : 6 * k + 6] for k, link in enumerate(LINKS)}
        for part in (by_pose, by_patella, here)
    )


def _patella_slopes(knee: "Knee", kinematics: KneePose, patella: "PatellaState") -> Array:
    """Return the derivative (3, 6) of a solved patella's coordinates by the femur's pose."""
    from tkamb.knee.patella import PatellaFrame

    lines = knee.extensor_lines
    assert lines is not None
    mechanism, coordinates = lines.mechanism, patella.coordinates
    contact = mechanism.contact.at(coordinates)
    here = PatellaFrame(mechanism, kinematics.pose)

    def conditions(frame: PatellaFrame, at: Array, touching: Any) -> Array:
        balance = frame.balance_at(at, touching)
        return np.array([balance.contact.gap, balance.ligament.length, balance.moment])

    by_pose = _pose_differences(
        lambda pose: conditions(PatellaFrame(mechanism, pose), coordinates, contact),
        kinematics.pose,
    )
    by_patella = _patella_differences(
        lambda at: conditions(here, at, mechanism.contact.at(at)), coordinates
    )
    return np.asarray(-np.linalg.solve(by_patella, by_pose))


def _pose_differences(values: Callable[[Array], Array], pose: Array) -> Array:
    """Return the derivative (n, 6) of values (n,) by a displacement of the femur."""
    sizes = np.repeat([1.0, 1.0 / FORCE_DERIVATIVE_ARM], 3)
    return _edge_free(lambda move: values(displaced(pose, move)), sizes, POSE_STEP)


def _patella_differences(values: Callable[[Array], Array], coordinates: Array) -> Array:
    """Return the derivative (n, 3) of values (n,) by the patella's coordinates."""
    sizes = np.array([1.0, 1.0, 1.0 / FORCE_DERIVATIVE_ARM])
    return _edge_free(lambda move: values(coordinates + move), sizes, PATELLA_STEP)


def _edge_free(values: Callable[[Array], Array], sizes: Array, step: float) -> Array:
    """Return the derivative (n, k) of values (n,) by k coordinates, by central differences.

    If the two one-sided differences of a coordinate differ by more than `EDGE`, an edge of a facet
    lies within the step: a tenth of the step is tried, then a hundredth.
    """
    here, columns = values(np.zeros(len(sizes))), []
    for k, size in enumerate(sizes):
        for share in (1.0, 0.1, 0.01):
            move = share * step * size
            ahead, behind = (values(sign * move * np.eye(len(sizes))[k]) for sign in (1.0, -1.0))
            column = (ahead - behind) / (2.0 * move)
            bend = (ahead - 2.0 * here + behind) / move
            if np.linalg.norm(bend) <= EDGE * np.linalg.norm(column):
                break
        columns.append(column)
    return np.array(columns).T


def generalised(model: Any, data: Any, changes: Array) -> Array:
    """Return sum_j J_j^T df_j (nv, k) of changes df (njoints, 6, k) of the joints' forces.

    `data` is that after `pin.computeJointJacobians`; each change is in its joint's frame.
    """
    total = np.zeros((model.nv, changes.shape[2]))
    for joint in 1 + np.flatnonzero(changes[1:].any(axis=(1, 2))):
        local = pin.getJointJacobian(model, data, int(joint), pin.ReferenceFrame.LOCAL)
        total += local.reshape(6, -1).T @ changes[joint]
    return total
