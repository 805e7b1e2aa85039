"""Forward dynamics of a model with a knee: one implicit time step, as an example to copy.

With v_m = (1 - theta) v + theta v' the step solves

    v' = v + h a(q + theta h v_m, v_m),    q' = q + h v_m

for v' by Newton's method, where a is the result of `pin.aba` with `Knee.external_forces`. theta =
1/2 is the implicit midpoint rule, of second order, which conserves the energy of a frictionless
contact. theta = 1 is implicit Euler, of first order, which dissipates energy and so converges to
the knee's equilibrium. An explicit step would have to resolve the contact, which oscillates at 100
Hz or more under the mass of a thigh.

Reference: Hairer, Lubich & Wanner, Geometric Numerical Integration, 2nd ed., II.1.1 (2006),
doi:10.1007/3-540-30666-8.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.knee.knee import Knee, KneeData


@dataclass(frozen=True)
class ImplicitStepSettings:
    """An implicit time step of the knee."""

    velocity_tolerance: float = 1e-8
    """m/s and rad/s: residual of the step's equation below which Newton's method has converged.
    Chosen: far below any speed of a knee."""
    max_newton_steps: int = 40
    """Newton steps at most. Chosen: steps that converge need fewer."""


IMPLICIT_STEP = ImplicitStepSettings()

REUSE_BELOW = 0.2
"""1: the Jacobian is used again while each Newton step reduces the residual below this share."""


def implicit_step(
    knee: Knee,
    q: Array,
    v: Array,
    step: float,
    tau: Array | None = None,
    external: Any = None,
    tensions: Mapping[str, float] | None = None,
    theta: float = 0.5,
    friction_of_joints: Array | None = None,
    data: KneeData | None = None,
    linear: bool = False,
) -> tuple[Array, Array]:
    """Return q and v one step later.

    Args:
        knee: the knee, whose model moves.
        q: (nq,) configuration.
        v: (nv,) velocity.
        step: time step, s.
        tau: (nv,) torques and forces of the joints, N·m and N; None: zero.
        external: forces on the joints beside those of the knee, as `fext` of `pin.aba`.
        tensions: muscle -> N, as for `Knee.external_forces`.
        theta: 0.5: implicit midpoint; 1: implicit Euler.
        friction_of_joints: (nv,) viscous friction of the joints, N·s/m or N·m·s/rad; None: zero.
        data: from `Knee.create_data`, to save time.
        linear: True: one Newton step, the linearly implicit method of first order. It takes a third
            of the time or less, and does not check the residual of the step.

    Raises:
        ComputationError: Newton's method does not converge, or the contact model is out of range:
            the step is too long.
    """
    model, data = knee.model, knee.create_data() if data is None else data
    drag = np.zeros(model.nv) if friction_of_joints is None else friction_of_joints
    push = np.zeros(model.nv) if tau is None else tau
    cache, ahead, last = model.createData(), np.array(v, float), np.inf
    change, slope = np.zeros(model.nv), None
    for _ in range(IMPLICIT_STEP.max_newton_steps):
        middle = (1.0 - theta) * v + theta * ahead
        place = pin.integrate(model, q, theta * step * middle)
        try:
            forces = knee.external_forces(place, middle, tensions, data)
        except ComputationError:  # too deep: half of Newton's step
            if not change.any():
                raise
            change = change / 2.0
            ahead = ahead - change
            continue
        own = forces
        if external is not None:
            forces = pin.StdVec_Force([f + e for f, e in zip(forces, external, strict=True)])
        torque = push - drag * middle
        # Residual of the theta rule for the velocity at the end of the step.
        missed = ahead - v - step * pin.aba(model, cache, place, middle, torque, forces)
        size = float(np.abs(missed).max())
        if size < IMPLICIT_STEP.velocity_tolerance or (
            size < 1e3 * IMPLICIT_STEP.velocity_tolerance and size >= last
        ):
            return pin.integrate(model, q, step * middle), ahead
        if slope is None or size > REUSE_BELOW * last:
            jacobian = knee.relative_jacobian(place)
            stiffness = knee.stiffness(place, middle, data, exact=False)
            stiffness = stiffness + _turning(knee, own, data)
            damping = knee.damping(place, middle, data)
            pin.computeABADerivatives(model, cache, place, middle, torque, forces)
            # In Pinocchio's derivatives the forces are constant; the knee's stiffness and damping
            # add their change.
            by_q = cache.ddq_dq - cache.Minv @ jacobian.T @ stiffness @ jacobian
            by_v = cache.ddq_dv - cache.Minv @ (jacobian.T @ damping @ jacobian + np.diag(drag))
            # Derivative of the residual by the end velocity, on which the place depends by
            # theta * step and the velocity by theta.
            slope = np.eye(model.nv) - step * theta * (by_v + theta * step * by_q)
        last = size
        change = -np.linalg.solve(slope, missed)
        ahead = ahead + change
        if linear:
            return pin.integrate(model, q, step * ((1.0 - theta) * v + theta * ahead)), ahead
    raise ComputationError(
        f"a step of {step:g} s does not converge (off by {last:.2g} m/s or rad/s)",
        "implicit_step",
        "shorten the step",
    )


def _turning(knee: Knee, forces: Any, data: KneeData) -> Array:
    """Return the stiffness (6, 6) due to the rotation of the femur, insert frame.

    Derivatives of `pin.aba` hold a force fixed in the joint's frame, while the knee's force on the
    femur is fixed in the insert's: displaced by xi it turns back by xi x* w against the femur.
    """
    bridge, placements = knee.bridge, data.data.oMi
    insert = placements[bridge.insert.joint] * bridge.insert.placement
    joint = bridge.component.joint
    on_femur = insert.actInv(placements[joint]).act(forces[joint])
    force, moment = pin.skew(on_femur.linear), pin.skew(on_femur.angular)
    return -np.block([[np.zeros((3, 3)), force], [force, moment]])
