"""Forward dynamics of a model with a knee: one implicit time step, as an example to copy.

Let v_m = (1 - theta) v + theta v'. Newton's method solves the equations of a step h,

    v' = v + h a(q + theta h v_m, v_m),    q' = q + h v_m,

for v'. Here a is the result of `pin.aba` with `Knee.external_forces`. theta = 1/2 is the implicit
midpoint rule, of second order, which conserves the energy of a frictionless contact. theta = 1 is
the implicit Euler method, of first order, which dissipates energy, so that the knee converges to
equilibrium. An explicit step would have to resolve the oscillation of the contact, which has 100 Hz
or more under the mass of a thigh.

The forces of a contact have kinks, and Newton's step d may overshoot across one. Let r be the
residual of the first equation and M the inertia of the joints. Without friction, M r is the
gradient of an energy that is lowest at the end of the step. d is halved while d . M r is positive
at its end and more than a given share of its size at the beginning: the energy then rises again.

References: Hairer, Lubich & Wanner, Geometric Numerical Integration, 2nd ed., II.1.1 (2006),
doi:10.1007/3-540-30666-8; Matthies & Strang, Int J Numer Methods Eng 14:1613 (1979),
doi:10.1002/nme.1620141104 (the halving).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array
from tkamb.knee.knee import Knee, KneeData

# m/s and rad/s: residual of the step's equation below which Newton's method has converged.
# It is far below any speed of a knee.
VELOCITY_TOLERANCE = 1e-8
# m/s and rad/s: residual below which the step is accepted if Newton's method no longer reduces it.
# A thousand times `VELOCITY_TOLERANCE`.
STAGNATION_TOLERANCE = 1e-5
# Maximum number of evaluations of the residual. Not studied.
MAX_NEWTON_STEPS = 40
# 1: Newton's step is halved while the slope of the energy at its end exceeds this share of its size
# at the beginning, see above. Measured on a knee simulator with steps of 10 ms: 80 steps take 168
# evaluations with shares of 0.5 and 0.9, 175 with 0.1. From 40 random starts all runs converge;
# without the halving 24 do not.
LARGEST_RISE = 0.5


REUSE_BELOW = 0.2
"""1: the Jacobian is reused if the last Newton step left less than this share of the residual."""


def implicit_step(
    knee: Knee,
    q: Array,
    v: Array,
    step: float,
    tau: Array | None = None,
    fext: Any = None,
    tensions: Mapping[str, float] | None = None,
    theta: float = 0.5,
    friction_of_joints: Array | None = None,
    data: KneeData | None = None,
    linear: bool = False,
) -> tuple[Array, Array]:
    """Return q and v after one time step.

    Args:
        q: configuration, (nq,).
        v: velocity, (nv,).
        step: s.
        tau: torques and forces of the joints, (nv,), N·m and N; None: zero.
        fext: external forces on the joints, as `fext` of `pin.aba`; None: zero.
        tensions: muscle -> tension, N, as for `Knee.external_forces`.
        theta: 0.5: implicit midpoint; 1: implicit Euler.
        friction_of_joints: viscous friction of the joints, (nv,), N·s/m or N·m·s/rad; None:
            zero.
        linear: True: one Newton step, the linearly implicit method of first order. It takes a third
            of the time or less, and does not check the residual of the step.

    Raises:
        ComputationError: Newton's method does not converge, or the contact model is out of range.
    """
    model, data = knee.model, knee.create_data() if data is None else data
    viscosity = np.zeros(model.nv) if friction_of_joints is None else friction_of_joints
    torques = np.zeros(model.nv) if tau is None else tau
    cache, v_end, last_norm = model.createData(), np.array(v, float), np.inf
    change, slope, residual_jacobian = np.zeros(model.nv), 0.0, None
    inertia = pin.crba(model, cache, q).copy()
    for _ in range(MAX_NEWTON_STEPS):
        v_middle = (1.0 - theta) * v + theta * v_end
        q_middle = pin.integrate(model, q, theta * step * v_middle)
        try:
            forces = knee.external_forces(q_middle, v_middle, tensions, data)
        # Newton's step leads out of the contact model's range, or far from the knee: halve it.
        except (ComputationError, InputError):
            if not change.any():
                raise
            change, slope = change / 2.0, slope / 2.0
            v_end = v_end - change
            continue
        knee_forces = forces
        if fext is not None:
            forces = pin.StdVec_Force([f + e for f, e in zip(forces, fext, strict=True)])
        torque = torques - viscosity * v_middle
        # Residual of the equation for the velocity at the end of the step.
        residual = v_end - v - step * pin.aba(model, cache, q_middle, v_middle, torque, forces)
        residual_norm = float(np.abs(residual).max())
        if residual_norm < VELOCITY_TOLERANCE or (
            last_norm <= residual_norm < STAGNATION_TOLERANCE
        ):
            return pin.integrate(model, q, step * v_middle), v_end
        if change @ inertia @ residual > LARGEST_RISE * abs(slope):
            change, slope = change / 2.0, slope / 2.0
            v_end = v_end - change
            continue
        if residual_jacobian is None or residual_norm > REUSE_BELOW * last_norm:
            jacobian = knee.relative_jacobian(q_middle)
            stiffness = knee.stiffness(q_middle, v_middle, data, exact=False)
            stiffness = stiffness + _rotation_stiffness(knee, knee_forces, data)
            damping = knee.damping(q_middle, v_middle, data)
            pin.computeABADerivatives(model, cache, q_middle, v_middle, torque, forces)
            # Pinocchio's derivatives hold the forces constant. The knee's stiffness and damping add
            # the change of the forces.
            by_q = cache.ddq_dq - cache.Minv @ jacobian.T @ stiffness @ jacobian
            by_v = cache.ddq_dv - cache.Minv @ (
                jacobian.T @ damping @ jacobian + np.diag(viscosity)
            )
            # Derivative of the residual by the end velocity v'. The middle velocity has the
            # derivative theta by v', the middle configuration theta * theta * step.
            residual_jacobian = np.eye(model.nv) - step * theta * (by_v + theta * step * by_q)
        last_norm = residual_norm
        change = -np.linalg.solve(residual_jacobian, residual)
        v_end, slope = v_end + change, float(change @ inertia @ residual)
        if linear:
            return pin.integrate(model, q, step * ((1.0 - theta) * v + theta * v_end)), v_end
    raise ComputationError(
        f"a step of {step:g} s does not converge (residual {last_norm:.2g} m/s or rad/s)",
        "implicit_step",
        "shorten the step",
    )


def _rotation_stiffness(knee: Knee, forces: Any, data: KneeData) -> Array:
    """Return the stiffness (6, 6) due to the rotation of the femur, insert frame.

    The derivatives of `pin.aba` hold a force constant in the joint's frame. The knee's force w on
    the femur is constant in the insert frame instead, so that a displacement xi of the femur
    changes it by -xi x* w in the femur's frame.
    """
    bridge, placements = knee.bridge, data.data.oMi
    insert = placements[bridge.insert.joint] * bridge.insert.placement
    joint = bridge.component.joint
    on_femur = insert.actInv(placements[joint]).act(forces[joint])
    force, moment = pin.skew(on_femur.linear), pin.skew(on_femur.angular)
    return -np.block([[np.zeros((3, 3)), force], [force, moment]])
