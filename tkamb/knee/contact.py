"""The femorotibial contact of a knee at one pose: wrench, friction, stiffness and damping.

All vectors are in the insert frame of a right knee. A twist or a small displacement (6,) of the
femoral component has the linear part at the insert's origin (m/s or m), then the rotation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.contact.model import CondyleWrench, ContactModel, ProbedContact
from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactStatus, Guess
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, cross, cross_matrix, displaced, pose
from tkamb.knee.load import wrench_of
from tkamb.knee.unknowns import CONTACT_POINT


@dataclass(frozen=True)
class DifferenceSettings:
    """Central differences, for the stiffness of a model without an exact tangent."""

    step: float = 4e-6
    """m: step of a translation. It is large against the solver's residual error, and
    small against the radius of the contact."""
    exact_step: float = 1e-9
    """m: step of a translation for a model without an iterative solver. It is far
    above rounding errors and far below the size of a facet."""
    arm: float = 0.025
    """m: lever arm; the step of a rotation is the step of a translation over this arm.
    Half the distance of the condyles."""
    tolerance: float = 1e-6
    """1: solver tolerance for these evaluations, if the model has a tolerance. A
    finite difference divides the solver's error by the step."""


CONTACT_DIFFERENCE = DifferenceSettings()


class KneeContact:
    """A contact model of one pair of bodies, with friction.

    Args:
        friction: Coulomb coefficient.
        state: state that the model's `prepare` returned for the pair; None: prepared at first use.
    """

    def __init__(
        self, model: ContactModel, pair: ContactPair, friction: float, state: Any = None
    ) -> None:
        self.model, self.pair, self.friction = model, pair, friction
        self._state = state
        self._settings = CONTACT_DIFFERENCE

    @property
    def state(self) -> Any:
        """State that the model's `prepare` returned."""
        if self._state is None:
            self._state = self.model.prepare(self.pair)
        return self._state

    def changed(self, friction: float, modulus_factor: float = 1.0) -> "KneeContact":
        """Return the same contact with another friction and another modulus of the insert.

        The prepared state is shared if the modulus does not change.
        """
        if modulus_factor == 1.0:
            return KneeContact(self.model, self.pair, friction, self._state)
        material = self.pair.material
        stiffer = replace(material, young_modulus=material.young_modulus * modulus_factor)
        return KneeContact(self.model, self.pair.of_material(stiffer), friction)

    def probe(self, start: Guess | None = None) -> Any:
        """Return a new probe (`tkamb.contact.model.Probe`). The caller reuses it as warm start."""
        return self.model.probe(self.state, start)

    def precise_probe(self, start: Guess | None = None) -> Any:
        """Return a new probe that is precise enough for finite differences."""
        names = {field.name for field in fields(self.model)}  # type: ignore[arg-type]
        if "tolerance" not in names:
            return self.probe(start)
        model = replace(self.model, tolerance=self._settings.tolerance)  # type: ignore[type-var]
        return model.probe(self.state, start)

    def at(self, probe: Any, femur_pose: Array) -> ProbedContact:
        """Return the contact at a pose (4, 4).

        Raises:
            ComputationError: the model is out of its range at the pose, or has not converged.
        """
        if not np.isfinite(femur_pose).all():
            raise ComputationError("the pose of the femur is not finite", "contact")
        contact: ProbedContact = probe.at(femur_pose)
        if not contact.known:
            raise ComputationError(self._why(femur_pose), "contact")
        return contact

    def with_exact_tangent(self, probe: Any, contact: ProbedContact) -> ProbedContact:
        """Return a contact of a probe with the model's exact tangent, if it has one."""
        # A probe of another package needs no such method.
        tangent = getattr(probe, "exact_tangent", None)
        return contact if tangent is None else tangent(contact)

    def check_differentiable(self) -> None:
        """Raise an error unless the model's forces have derivatives.

        Raises:
            InputError: they jump from facet to facet.
        """
        if not self.model.differentiable:
            raise InputError(
                f"the forces of contact model '{self.model.name}' jump from facet to facet",
                "derivatives",
                "take the foundation or a lattice; Knee.stiffness is the slope over 8 µm",
            )

    def _why(self, femur_pose: Array) -> str:
        result = self.model.evaluate(self.state, femur_pose)
        reason = "; ".join(result.flags) or result.status.value.replace("_", " ")
        if result.status is ContactStatus.OK:
            reason = "not converged"
        depth = self.pair.approach(femur_pose)
        return f"{self.model.name}: {reason} (approach {depth * 1e3:.3g} mm)"

    def wrench(self, contact: ProbedContact, twist: Array) -> Array:
        """Return the wrench (6,) on the insert, including friction.

        Args:
            contact: the contact at the pose.
            twist: twist of the femur relative to the insert, shape (6,).
        """
        total = np.zeros(6)
        for load in contact.loads:
            total += load.wrench
            if self.friction:
                total += load.force * self._friction_wrench(load, twist)
        return total

    def _friction_wrench(self, load: CondyleWrench, twist: Array) -> Array:
        """Return the wrench (6,) of friction on the insert per unit force of a condyle."""
        sliding = twist[:3] + cross(twist[3:], load.point)
        tangential = sliding - (sliding @ load.normal) * load.normal
        speed = math.sqrt(tangential @ tangential + CONTACT_POINT.standstill_speed**2)
        return wrench_of(load.point, self.friction / speed * tangential)

    def _friction_stiffness(self, load: CondyleWrench, twist: Array) -> Array:
        """Return the derivative (6, 6) of a condyle's friction by a displacement, at a twist.

        The force is mu N t/s in the notation of `damping`. N, the normal n and the contact point p
        change with the wrench (f, m) and the centre c of the pressure: with m_c = m - c x f,

            dN = -n . df,    dn = -(df + n dN)/N,    p = c + f x m_c/N².
        """
        assert load.stiffness is not None and load.centre_slope is not None
        force, size, normal, point = load.wrench[:3], load.force, load.normal, load.point
        by_force, by_moment, centre = load.stiffness[:3], load.stiffness[3:], load.centre_slope
        by_size = load.force_slope
        by_normal = -(by_force + normal[:, None] * by_size) / size
        moment = load.wrench[3:] - cross(load.centre, force)
        by_moment = by_moment + cross_matrix(force) @ centre - cross_matrix(load.centre) @ by_force
        turned = cross_matrix(force) @ by_moment - cross_matrix(moment) @ by_force
        by_point = (
            centre + turned / size**2 - 2.0 / size**3 * cross(force, moment)[:, None] * by_size
        )
        sliding = twist[:3] + cross(twist[3:], point)
        by_sliding = cross_matrix(twist[3:]) @ by_point
        along = float(sliding @ normal)
        tangential = sliding - along * normal
        # Product rule for t = s - (s . n) n.
        by_tangential = (
            by_sliding
            - normal[:, None] * (normal @ by_sliding + sliding @ by_normal)
            - along * by_normal
        )
        speed = float(np.sqrt(tangential @ tangential + CONTACT_POINT.standstill_speed**2))
        direction = self.friction * tangential / speed
        by_direction = self.friction * (
            by_tangential / speed - tangential[:, None] * (tangential @ by_tangential) / speed**3
        )
        change = direction[:, None] * by_size + size * by_direction
        by_moment = cross_matrix(point) @ change - size * cross_matrix(direction) @ by_point
        return np.vstack([change, by_moment])

    def damping(self, contact: ProbedContact, twist: Array) -> Array:
        """Return the derivative (6, 6) of the wrench on the insert with respect to the twist.

        Only friction depends on the femur's twist. Let v be the sliding velocity at a contact
        point, t its tangential part, s = sqrt(t.t + v0²) and P the projector on the tangent plane.
        The derivative of the friction force mu N t/s by v is mu N (P/s - t t^T/s³).
        """
        total = np.zeros((6, 6))
        for load in contact.loads if self.friction else ():
            normal, point = load.normal, load.point
            point_jacobian = np.hstack([np.eye(3), -cross_matrix(point)])
            sliding = point_jacobian @ twist
            tangential = sliding - (sliding @ normal) * normal
            speed = float(np.sqrt(tangential @ tangential + CONTACT_POINT.standstill_speed**2))
            projector = np.eye(3) - normal[:, None] * normal
            derivative = projector / speed - tangential[:, None] * tangential / speed**3
            # Chain rule: the twist gives the velocity of the contact point, and this the friction.
            total += self.friction * load.force * point_jacobian.T @ derivative @ point_jacobian
        return total

    def stiffness(
        self, probe: Any, femur_pose: Array, contact: ProbedContact, twist: Array, exact: bool
    ) -> Array:
        """Return the derivative (6, 6) of the wrench on the insert by a displacement of the femur.

        Args:
            probe: probe of the model; its state is the warm start.
            femur_pose: pose of the femoral component, shape (4, 4).
            contact: the contact at this pose.
            twist: constant twist of the femur, shape (6,).
            exact: True: central differences replace an approximate tangent of the model.
        """
        if exact:
            if not contact.exact:
                probe = self.precise_probe(getattr(probe, "start", None))
                contact = self.at(probe, femur_pose)
            contact = self.with_exact_tangent(probe, contact)
        has_friction = bool(self.friction and np.any(twist) and contact.loads)
        # The friction force moves with the centre of pressure. If its derivative is unknown, the
        # exact stiffness needs finite differences.
        moves = all(load.centre_slope is not None for load in contact.loads)
        if contact.tangent and not (exact and ((has_friction and not moves) or not contact.exact)):
            total = np.zeros((6, 6))
            for load in contact.loads:
                assert load.stiffness is not None
                total += load.stiffness
                if has_friction and load.centre_slope is not None:
                    total += self._friction_stiffness(load, twist)
                elif has_friction:
                    total += np.outer(self._friction_wrench(load, twist), load.force_slope)
            return total
        precise = self.precise_probe(getattr(probe, "start", None))
        self.at(precise, femur_pose)
        settings = self._settings
        if contact.tangent and contact.exact and not hasattr(self.model, "tolerance"):
            settings = replace(settings, step=settings.exact_step)
        return differences(
            lambda displaced_pose: self.wrench(self.at(precise, displaced_pose), twist),
            femur_pose,
            settings,
        )


def batch_differences(
    wrenches: Callable[[Array], Array], femur_pose: Array, settings: DifferenceSettings
) -> Array:
    """Return the result of `differences` for a function of many poses (n, 4, 4) at once."""
    sizes = settings.step * np.array([1.0, 1.0, 1.0, *np.full(3, 1.0 / settings.arm)])
    steps = np.concatenate([np.diag(sizes), -np.diag(sizes)])
    rotations = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    values = wrenches(
        pose(rotations @ femur_pose[:3, :3], rotations @ femur_pose[:3, 3] + steps[:, :3])
    )
    return ((values[:6] - values[6:]) / (2.0 * sizes[:, None])).T


def differences(
    wrench: Callable[[Array], Array], femur_pose: Array, settings: DifferenceSettings
) -> Array:
    """Return the derivative (6, 6) of a wrench by a small displacement, by central differences.

    Args:
        wrench: function of a pose (4, 4) that returns a wrench (6,).
        femur_pose: pose at which the wrench is differentiated, shape (4, 4).
        settings: steps of the differences.
    """
    columns = []
    for k in range(6):
        size = settings.step if k < 3 else settings.step / settings.arm
        wrenches = [
            wrench(displaced(femur_pose, sign * size * np.eye(6)[k])) for sign in (1.0, -1.0)
        ]
        columns.append((wrenches[0] - wrenches[1]) / (2.0 * size))
    return np.array(columns).T
