"""Forward dynamics of a model with a knee: one implicit time step, as an example to copy.

Let v_m = (1 - theta) v + theta v'. Newton's method solves the equations of a step h,

    v' = v + h a(q + theta h v_m, v_m),    q' = q + h v_m,

for v'. The acceleration a is the result of `pin.aba` with `Knee.external_forces`. theta = 1/2 is
the implicit midpoint rule. It is of second order and conserves the energy of a frictionless
contact. theta = 1 is implicit Euler. It is of first order and dissipates energy, so that the knee
converges to equilibrium. An explicit step would have to resolve the oscillation of the contact,
which has 100 Hz or more under the mass of a thigh.

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
    Chosen because it is far below any speed of a knee."""
    max_newton_steps: int = 40
    """Maximum number of Newton steps. Chosen because a time step that converges needs fewer."""


IMPLICIT_STEP = ImplicitStepSettings()

REUSE_BELOW = 0.2
"""1: the Jacobian is reused while each Newton step reduces the residual below this share."""


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
    """Return q and v after one time step.

    Args:
        knee: the knee on the model that moves.
        q: configuration, shape (nq,).
        v: velocity, shape (nv,).
        step: time step, s.
        tau: torques and forces of the joints, shape (nv,), N·m and N; None: zero.
        external: other forces on the joints, as `fext` of `pin.aba`; None: zero.
        tensions: muscle -> tension, N, as for `Knee.external_forces`.
        theta: 0.5: implicit midpoint; 1: implicit Euler.
        friction_of_joints: viscous friction of the joints, shape (nv,), N·s/m or N·m·s/rad; None:
            zero.
        data: data from `Knee.create_data`; they save time.
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
        except ComputationError:  # penetration too large: halve Newton's step
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
            # Pinocchio's derivatives hold the forces constant. The knee's stiffness and damping add
            # the change of the forces.
            by_q = cache.ddq_dq - cache.Minv @ jacobian.T @ stiffness @ jacobian
            by_v = cache.ddq_dv - cache.Minv @ (jacobian.T @ damping @ jacobian + np.diag(drag))
            # Derivative of the residual by the end velocity v'. The derivative of the middle
            # velocity by v' is theta, that of the configuration theta * theta * step.
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

    The derivatives of `pin.aba` hold a force constant in the joint's frame. The knee's force w on
    the femur is constant in the insert frame: a displacement xi of the femur changes w by -xi x* w
    in the femur's frame.
    """
    bridge, placements = knee.bridge, data.data.oMi
    insert = placements[bridge.insert.joint] * bridge.insert.placement
    joint = bridge.component.joint
    on_femur = insert.actInv(placements[joint]).act(forces[joint])
    force, moment = pin.skew(on_femur.linear), pin.skew(on_femur.angular)
    return -np.block([[np.zeros((3, 3)), force], [force, moment]])
