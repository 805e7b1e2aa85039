"""The femorotibial contact of a knee at one pose: wrench, friction, stiffness and damping.

All vectors are in the insert frame of a right knee. A twist or a small displacement (6,) of the
femoral component has the linear part at the insert's origin (m/s or m), then the rotation.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from tkamb.contact.model import CondyleWrench, ContactModel, ProbedContact
from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactStatus, Guess
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.compiled import compiled_as_written, compiled_for_microseconds
from tkamb.geometry.frames import Array, displaced
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
UNCHANGED = np.zeros((15, 0))
BY_TWIST = np.vstack([np.zeros((9, 6)), np.eye(6)])
"""Changes of `_friction_wrench` by the twist."""


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
        """Return a contact with the model's exact tangent, if it has one."""
        # A probe of another package needs no such method.
        tangent = getattr(probe, "exact_tangent", None)
        return contact if tangent is None else tangent(contact)

    def check_differentiable(self) -> None:
        """Raise an error unless the model's forces have derivatives."""
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

        `twist` (6,) is that of the femur relative to the insert.
        """
        total = np.zeros(6)
        for load in contact.loads:
            total += load.wrench
            if self.friction:
                total += self._friction(load, twist, UNCHANGED)[:, 0]
        return total

    def _friction(self, load: CondyleWrench, twist: Array, changes: Array) -> Array:
        still = CONTACT_POINT.standstill_speed
        return _friction_wrench(load.wrench, load.centre, twist, changes, self.friction, still)

    def damping(self, contact: ProbedContact, twist: Array) -> Array:
        """Return the derivative (6, 6) of the wrench on the insert by the twist: of friction."""
        total = np.zeros((6, 6))
        for load in contact.loads if self.friction else ():
            total += self._friction(load, twist, BY_TWIST)[:, 1:]
        return total

    def stiffness(
        self, probe: Any, femur_pose: Array, contact: ProbedContact, twist: Array, exact: bool
    ) -> Array:
        """Return the derivative (6, 6) of the wrench on the insert by a displacement of the femur.

        Args:
            probe: probe of the model; its state is the warm start.
            twist: constant twist of the femur, (6,).
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
                    changes = np.concatenate([load.stiffness, load.centre_slope, np.zeros((6, 6))])
                    total += self._friction(load, twist, changes)[:, 1:]
                elif has_friction:
                    wrench = self._friction(load, twist, UNCHANGED)[:, 0]
                    total += np.outer(wrench / load.force, load.force_slope)
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


Vector = tuple[float, float, float]


@compiled_for_microseconds
def _friction_wrench(
    wrench: Array, centre: Array, twist: Array, changes: Array, friction: float, still: float
) -> Array:
    """Return the wrench of a condyle's friction on the insert, and its changes (6, 1 + k).

    The resultant f of size N acts along the normal n = -f/N, at the point p = c + f x m_c/N² with
    the moment m_c = m - c x f about the centre c. With the sliding velocity s = v + w x p and its
    tangential part t = s - (s . n) n, the friction is mu N t/sqrt(t . t + v0²), at p.

    `wrench` is f and m on the insert, `twist` v and w of the femur against it, `changes` (15, k)
    are those of wrench, centre and twist, `friction` is mu and `still` v0 (m/s).
    """
    f, m, c = _three(wrench, 0), _three(wrench, 3), _three(centre, 0)
    v, w = _three(twist, 0), _three(twist, 3)
    result, size = np.empty((6, 1 + changes.shape[1])), np.sqrt(_dot(f, f))
    n, free = _plus((0.0, 0.0, 0.0), -1.0 / size, f), _plus(m, -1.0, _cross(c, f))
    arm = _cross(f, free)
    p = _plus(c, 1.0 / size**2, arm)
    s = _plus(v, 1.0, _cross(w, p))
    along = _dot(s, n)
    t = _plus(s, -along, n)
    speed = np.sqrt(_dot(t, t) + still**2)
    ratio = friction * size / speed
    force = _plus((0.0, 0.0, 0.0), ratio, t)
    moment = _cross(p, force)
    for i in range(3):
        result[i, 0], result[3 + i, 0] = force[i], moment[i]
    for k in range(changes.shape[1]):
        column = changes[:, k]
        df, dm, dc = _three(column, 0), _three(column, 3), _three(column, 6)
        dv, dw = _three(column, 9), _three(column, 12)
        dsize = -_dot(n, df)
        dn = _plus((0.0, 0.0, 0.0), -1.0 / size, _plus(df, dsize, n))
        dfree = _plus(_plus(dm, -1.0, _cross(dc, f)), -1.0, _cross(c, df))
        darm = _plus(_cross(df, free), 1.0, _cross(f, dfree))
        dp = _plus(_plus(dc, 1.0 / size**2, darm), -2.0 * dsize / size**3, arm)
        ds = _plus(_plus(dv, 1.0, _cross(dw, p)), 1.0, _cross(w, dp))
        dt = _plus(_plus(ds, -_dot(ds, n) - _dot(s, dn), n), -along, dn)
        dratio = friction * dsize / speed - ratio * _dot(t, dt) / speed**2
        dforce = _plus(_plus((0.0, 0.0, 0.0), ratio, dt), dratio, t)
        dmoment = _plus(_cross(dp, force), 1.0, _cross(p, dforce))
        for i in range(3):
            result[i, 1 + k], result[3 + i, 1 + k] = dforce[i], dmoment[i]
    return result


@compiled_as_written
def _three(values: Array, first: int) -> Vector:
    return values[first], values[first + 1], values[first + 2]


@compiled_as_written
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled_as_written
def _plus(a: Vector, factor: float, b: Vector) -> Vector:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@compiled_as_written
def _cross(a: Vector, b: Vector) -> Vector:
    x, y, z = a
    return y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]


def differences(
    wrench: Callable[[Array], Array], femur_pose: Array, settings: DifferenceSettings
) -> Array:
    """Return the derivative (6, 6) of a wrench by a small displacement, by central differences.

    `wrench` is a function of a pose (4, 4) that returns a wrench (6,).
    """
    columns = []
    for k in range(6):
        size = settings.step if k < 3 else settings.step / settings.arm
        wrenches = [
            wrench(displaced(femur_pose, sign * size * np.eye(6)[k])) for sign in (1.0, -1.0)
        ]
        columns.append((wrenches[0] - wrenches[1]) / (2.0 * size))
    return np.array(columns).T
