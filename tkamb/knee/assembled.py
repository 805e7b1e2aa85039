"""The parts of a knee on a user's model, and their poses at a configuration."""

import copy
import math
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import NoneType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import pinocchio as pin

from tkamb.errors import (
    ComputationError,
    InputError,
    all_of,
    must_be,
    names_among,
    real_number,
    real_numbers,
)
from tkamb.geometry.frames import (
    PATELLA_BODY_COORDINATES,
    Array,
    inverse,
    knee_pose,
    mirrored_pose,
    sagittal_pose,
)
from tkamb.knee.anatomy import check_not_exchanged, find_anatomy
from tkamb.knee.canonical import Bridge, CanonicalChain, KneePose, se3
from tkamb.knee.load import PointForces
from tkamb.knee.muscles import Muscle, checked_tensions, tension_lines
from tkamb.knee.parts import (
    Extensor,
    Implant,
    as_model,
    bundle_on_chain,
    check_names,
    crossing_and_others,
    extensor_lines,
    placed_insert,
    prepared_button,
    prepared_contact,
    surfaces_of,
)

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel, ProbedContact
    from tkamb.contact.result import Guess
    from tkamb.geometry.closest import ClosestPointQuery
    from tkamb.knee.button import Button
    from tkamb.knee.contact import KneeContact
    from tkamb.knee.extensor import ExtensorLines
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState
    from tkamb.knee.patella_frame import PatellaMethod


# 1: largest error of a quaternion's norm. An error of this size changes a force by
# a millionth.
UNIT_TOLERANCE = 1e-6
# m: largest distance of the components. The ligaments of a knee tear at 20 mm of
# distraction.
MAX_DISTANCE = 0.1
# rad: largest angle of a joint of the knee; a larger one is probably in degrees. No
# joint of a knee makes a full turn.
MAX_TURN = 2.0 * np.pi


PATELLAR_LIGAMENT = "patellar_ligament"
"""Name of the patellar ligament among the tensions."""


@dataclass(eq=False)
class KneeData:
    """Data that a caller passes from call to call to save time; `Knee.create_data` makes it.

    Results change at most within the solver's tolerance.

    Args:
        data: Pinocchio data of the user's model.
        probe: probe of the contact model, with the last contact as warm start; None: no contact
            model.
        patella: state of the patella from the last call; None: not computed yet.
        seen: bytes of the last pose, and the contact at that pose; None: not computed yet.
        start: warm start of the next press, from the last press or evaluation; None: there was
            none.
        button_start: warm start of the next press of the button; None: there was none.
        patella_coordinates: coordinates (6,) of the last equilibrium of the patella; None: there
            was none.
        knee: identity of the knee that made the data.
    """

    data: Any
    probe: Any = None
    patella: "PatellaState | None" = None
    seen: "tuple[bytes, ProbedContact] | None" = None
    start: "Guess | None" = None
    button_start: "Guess | None" = None
    patella_coordinates: Array | None = None
    knee: str = ""

    def __repr__(self) -> str:
        """Return the knee that made the data."""
        return f"<tkamb.KneeData of {self.knee}>"


class AssembledKnee:
    """The parts of a knee on a Pinocchio model, and their poses; see `tkamb.Knee`, which adds the
    loads.
    """

    def __init__(
        self,
        model: pin.Model,
        side: Literal["right", "left"] = "right",
        *,
        implant: Implant | None = None,
        ligaments: "Iterable[Ligament]" = (),
        extensor: Extensor | None = None,
        contact: "ContactModel | KneeContact | str | None" = None,
        friction: float = 0.0,
        muscles: Iterable[Muscle] = (),
        frames: Mapping[str, str | None] | None = None,
        joints: Sequence[str] = (),
        cache: bool = False,
        patellofemoral_contact: "ContactModel | str | None" = None,
        released_patella: Sequence[str] = (),
        head_shares: Mapping[str, float] | None = None,
    ) -> None:
        must_be(model, pin.Model, "Knee: model", "give a pin.Model")
        must_be(implant, (Implant, NoneType), "Knee: implant", "give a tkamb.Implant")
        must_be(extensor, (Extensor, NoneType), "Knee: extensor", "give a tkamb.Extensor")
        must_be(frames, (Mapping, NoneType), "Knee: frames", "give part -> name of a frame")
        must_be(head_shares, (Mapping, NoneType), "Knee: head_shares", "give head -> share")
        if side not in ("right", "left"):
            raise InputError(f"side {side!r}", "Knee", "give 'right' or 'left'")
        self.friction = real_number(friction, "Knee: friction", "give 0 to 1")
        if not 0.0 <= self.friction <= 1.0:
            raise InputError(f"friction {friction}", "Knee", "give 0 to 1")
        self.model, self.side = model, side
        self.implant, is_left = implant or Implant(), side == "left"
        self.anatomy = find_anatomy(
            model, frames or {}, joints, _placement(extensor.plane) if extensor else None
        )
        check_not_exchanged(self.anatomy)
        surfaces = surfaces_of(self.implant, is_left, contact is not None, extensor is not None)
        insert, insert_surface = placed_insert(self.anatomy, self.implant, surfaces.insert, is_left)
        self._surfaces = replace(surfaces, insert=insert_surface)
        component = self.anatomy.femoral
        self.chain = CanonicalChain(self.anatomy, is_left, extensor is not None, component, insert)
        self.bridge = Bridge(self.anatomy, is_left, self.chain, component, insert)
        self.extensor = extensor
        self.muscles = muscles = all_of(Muscle, muscles, "muscles", "give a list of tkamb.Muscle")
        check_names("muscles", [*self._extensor_names, *(muscle.name for muscle in muscles)])
        self._lines = tension_lines(muscles, self.anatomy)
        self._set_ligaments(ligaments)
        self.extensor_lines: ExtensorLines | None = None
        if extensor is not None:
            self.extensor_lines = extensor_lines(self.bridge, extensor, self._surfaces)
        self.contact: KneeContact | None = None
        if contact is not None:
            # Another knee with the same implant and model shares it, as long as one of them lives.
            self._prepared = prepared_contact(contact, self.implant, self._surfaces, cache)
            self.contact = self._prepared.changed(self.friction)
        self.button_contact: Button | None = None
        if patellofemoral_contact is not None:
            if extensor is None:
                raise InputError("needs extensor=", "patellofemoral_contact", "give it to the knee")
            self.button_contact = prepared_button(
                patellofemoral_contact, self.implant, self._surfaces, self.chain, cache
            )
        self.patella: PatellaMethod | None = None
        kind = "coordinate of the patella"
        released = names_among(released_patella, PATELLA_BODY_COORDINATES, "released_patella", kind)
        self._has_own_patella_lines = bool(released)
        if released:
            from tkamb.knee.patella_equilibrium import released_method

            self.patella = released_method(self, released, head_shares)
        elif head_shares is not None:
            raise InputError("needs released_patella=", "head_shares", "give it to the knee")
        self._identity = _identity(self)

    def _set_ligaments(self, bundles: "Iterable[Ligament]") -> None:
        if not (isinstance(bundles, tuple) and not bundles):  # a knee without any imports no law
            from tkamb.knee.ligaments import Ligament

            bundles = all_of(Ligament, bundles, "ligaments", "give a list of tkamb.Ligament")
        self.ligaments = tuple(bundle_on_chain(self.bridge, bundle) for bundle in bundles)
        check_names("ligaments", [bundle.name for bundle in self.ligaments])
        self._crossing, self._others = crossing_and_others(self.chain, self.ligaments)

    def with_ligaments(self, ligaments: "Iterable[Ligament]") -> Self:
        """Return the same knee with other ligaments; everything else is shared."""
        other = copy.copy(self)
        other._set_ligaments(ligaments)
        if other.patella is not None and other._has_own_patella_lines:
            other.patella = replace(other.patella, lines=other._others)
        return other

    @property
    def _instant_ligaments(self) -> "tuple[Ligament, ...]":
        """The ligaments of the equations, without those of a released patella."""
        if self.patella is None or not self._has_own_patella_lines:
            return self.ligaments
        return tuple(bundle for bundle in self.ligaments if bundle not in self._others)

    def _with_patella(self, patella: "PatellaMethod") -> Self:
        other = copy.copy(self)
        other.patella = patella
        return other

    def with_contact(self, model: "ContactModel | str") -> Self:
        """Return the same knee with another contact model, which is prepared at its first use."""
        from tkamb.knee.contact import KneeContact

        other, model = copy.copy(self), as_model(model, "with_contact")
        other.contact = KneeContact(model, self._need_contact().pair, self.friction)
        other._identity = _identity(other)
        return other

    @property
    def left(self) -> bool:
        """Whether this is a left knee."""
        return self.side == "left"

    @property
    def femoral(self) -> Any:
        """The femoral component in its own frame, mirrored for a left knee; None: not given."""
        return self._surfaces.femoral

    @property
    def insert(self) -> Any:
        """The insert in the insert frame, mirrored for a left knee; None: not given."""
        return self._surfaces.insert

    @property
    def button(self) -> Any:
        """The patellar button in the patella's frame, mirrored for a left knee; None: not given."""
        return self._surfaces.button

    @property
    def _query(self) -> "ClosestPointQuery":
        """Query for closest points of femoral component and insert, prepared at the first use."""
        return self._need_contact().pair.closest_points

    def create_data(self) -> KneeData:
        """Return data that a caller passes from call to call to save time."""
        probe = None if self.contact is None else self.contact.probe()
        return KneeData(self.model.createData(), probe, knee=self._identity)

    def _kinematic_data(self) -> KneeData:
        return KneeData(self.model.createData(), knee=self._identity)

    def _data(self, data: KneeData | None, contact: bool = True) -> KneeData:
        """Return data of this knee; None: new data, without a probe if not `contact`.

        Raises:
            InputError: the data are those of Pinocchio, or of another knee.
        """
        if data is None:
            return self.create_data() if contact else self._kinematic_data()
        if not isinstance(data, KneeData):
            raise InputError(
                f"a {type(data).__name__} is no data of a tkamb.Knee",
                "data",
                "give knee.create_data(); Pinocchio's data is its attribute data",
            )
        if data.knee != self._identity:
            raise InputError(
                f"the data belong to another knee, {data.knee}, not to this one, {self._identity}",
                "data",
                "give the result of create_data() of this knee",
            )
        return data

    def pose(self, q: Array) -> pin.SE3:
        """Return the pose of the femoral component in the insert frame."""
        kinematics = self._kinematics(self._kinematic_data(), q)
        return se3(mirrored_pose(kinematics.pose) if self.left else kinematics.pose)

    def coordinates(self, q: Array) -> Array:
        """Return the knee coordinates (6,) in the order of `KNEE_COORDINATES`, m and rad.

        ap, si and ml are translations along x, y and z of the insert frame, with z to the patient's
        right for both knees. The rotations are Grood and Suntay's (`tkamb.geometry.frames`), with
        clinical signs for both knees.
        """
        kinematics = self._kinematics(self._kinematic_data(), q)
        return self._coordinate_signs * kinematics.coordinates

    @property
    def _coordinate_signs(self) -> Array:
        """Signs (6,) between the coordinates of the equations and those of the user's knee."""
        return np.array([1.0, 1.0, -1.0 if self.left else 1.0, 1.0, 1.0, 1.0])

    def _loads_patella(self, tensions: Mapping[str, float]) -> bool:
        """Return whether the extensor mechanism pulls, or a ligament ends on the patella."""
        return bool(self._plane_lines) or self._pulls(tensions)

    @property
    def _plane_lines(self) -> "tuple[Ligament, ...]":
        """The ligaments that end on the patella, unless it is released."""
        return self._others if self.patella is None else ()

    def _loads_beside(
        self,
        kinematics: KneePose,
        patella: "PatellaState | None",
        tensions: Mapping[str, float],
    ) -> list[PointForces]:
        """Return the loads of the extensor mechanism, and of ligaments that end on the patella.

        Args:
            patella: the patella at this pose; None: not modelled.
            tensions: muscle -> tension, N.
        """
        poses, total = self._link_poses(kinematics, patella), list[PointForces]()
        if self._plane_lines:
            from tkamb.knee.ligaments import ligament_loads

            total += ligament_loads(self._plane_lines, poses)[1]
        if self._pulls(tensions):
            assert patella is not None and self.extensor_lines is not None
            quadriceps = tensions[self._extensor_names[0]]
            total += self.extensor_lines.pull(
                poses,
                patella,
                kinematics.coordinates[5],
                quadriceps,
                tensions.get(PATELLAR_LIGAMENT),
            )
        return total

    def relative_jacobian(self, q: Array, data: KneeData | None = None) -> Array:
        """Return J (6, nv): J v is the femoral component's twist against the insert.

        The twist is at the insert's origin, in the insert frame. The generalised force of a wrench
        w on the insert and -w on the femur is -J^T w. A stiffness K of the knee changes the
        generalised force by -J^T K J per displacement.
        """
        data = self._data(data, contact=False)
        return self.bridge.relative_jacobian(data.data, self._check_q(q))

    def _drawn_links(self, q: Array, femur: Array, data: KneeData) -> tuple[dict[str, Array], bool]:
        """Return link -> pose (4, 4) in the insert frame, of a left knee mirrored.

        Args:
            q: configuration, (nq,); it gives the pose of a patella of the model.
            femur: pose of the femoral component in the insert frame, (4, 4).

        Returns:
            Whether they include the patella, which is missing if its search failed or
            the knee has no extensor mechanism.
        """
        kinematics, patella = replace(self._kinematics(data, q), pose=femur), None
        if self.extensor is not None:
            try:
                patella = self._find_patella(kinematics, data)
            except ComputationError:
                patella = None
        return self._link_poses(kinematics, patella), patella is not None

    def _extensor_paths(self, poses: dict[str, Array]) -> dict[str, Array]:
        """Return (n, 3), m, of quadriceps and patellar ligament, insert frame.

        It is empty without an extensor mechanism or a pose of the patella.
        """
        if self.extensor_lines is None or "patella" not in poses:
            return {}
        muscle, ligament = self.extensor_lines.paths_at(poses)
        return {self.extensor_lines.muscle.name: muscle.points, PATELLAR_LIGAMENT: ligament.points}

    def _nearest_points(self, coordinates: Array) -> dict[str, Array]:
        """Return side -> point (3,), m, where the undeformed condyle is nearest to the insert."""
        gaps = self._query.at(knee_pose(coordinates))
        centres = {"medial": gaps.medial.centre}
        return centres | ({"lateral": gaps.lateral.centre} if gaps.lateral else {})

    def _check(self, values: Array, name: str, size: int) -> Array:
        array = real_numbers(values, f"Knee: {name}", f"give ({size},)")
        if array.shape != (size,):
            raise InputError(f"{name} has the shape {array.shape}", "Knee", f"give ({size},)")
        if np.isfinite(array).all():
            return array
        # Comparisons with NaN are false: a NaN in v would give forces without friction. The patella
        # of a recorded motion is NaN in a frame in which its equilibrium was not found.
        patella = self.anatomy.patella_q if name == "q" else self.anatomy.patella_v
        for k in np.flatnonzero(~np.isfinite(array)):
            if k not in patella:
                raise InputError(f"{name}[{k}] is {array[k]}", "Knee", "give finite numbers")
        return array

    def _check_q(self, q: Array) -> Array:
        """Check size, quaternions and angles of the knee."""
        q = self._check(q, "q", self.model.nq)
        # 60 rad have a valid pose, of another flexion: the result would look right.
        for k, joint in self.anatomy.angles.items():
            if abs(q[k]) > MAX_TURN:
                words = f"joint '{joint}' is at {q[k]:.4g} rad; is it in degrees?"
                raise InputError(words, "Knee", "give q in radians")
        if not pin.isNormalized(self.model, q, UNIT_TOLERANCE) and np.isfinite(q).all():
            unit = q.copy()
            pin.normalize(self.model, unit)
            error = float(np.abs(q - unit).max())
            raise InputError(
                f"q is not normalised: a component of a quaternion is off by {error:.3g}",
                "Knee",
                "call pin.normalize(model, q)",
            )
        return q

    def _check_place(self, pose: Array) -> None:
        """Raise if the components are nowhere near each other.

        Raises:
            ComputationError: the femoral component is far from the insert, or below it.
        """
        if self.femoral is None or self.insert is None or not np.isfinite(pose).all():
            return
        (low, high), (first, last) = self.insert.bounds, self.femoral.bounds
        centre = pose[:3, :3] @ (0.5 * (first + last)) + pose[:3, 3]
        nearest = np.minimum(np.maximum(centre, low), high)
        apart = math.dist(centre, nearest) - 0.5 * math.dist(first, last)
        if apart > MAX_DISTANCE:
            words = f"the femoral component is {apart:.3g} m or more away from the insert"
        elif centre[1] < low[1]:
            words = (
                f"the femoral component lies {low[1] - centre[1]:.3g} m below the insert's bottom"
            )
        else:
            return
        raise ComputationError(words, "q", "check q and the frames femur, tibia, femoral, insert")

    def _kinematics(self, data: KneeData, q: Array, v: Array | None = None) -> KneePose:
        q = self._check_q(q)
        if v is None:
            pin.forwardKinematics(self.model, data.data, q)
        else:
            v = self._check(v, "v", self.model.nv)
            pin.forwardKinematics(self.model, data.data, q, v)
        return self.bridge.knee_pose(data.data)

    def _need_contact(self) -> "KneeContact":
        if self.contact is None:
            raise InputError("has no contact model", "Knee", "give contact= and implant=")
        return self.contact

    @property
    def _finds_patella(self) -> bool:
        """Whether equilibrium determines the patella's pose, because the model has no patella."""
        return self.anatomy.patella is None

    @property
    def _extensor_names(self) -> tuple[str, ...]:
        return (self.extensor.quadriceps.name, PATELLAR_LIGAMENT) if self.extensor else ()

    def _pulls(self, tensions: Mapping[str, float]) -> bool:
        names = self._extensor_names[:1]
        if self.patella is not None:
            names += tuple(head.name for head in self.patella.heads)
        return any(tensions.get(name, 0.0) != 0 for name in names)

    def _tensions(self, tensions: Mapping[str, float] | float | None) -> dict[str, float]:
        if self.patella is None:
            return checked_tensions(tensions, self._extensor_names, self._lines)
        heads = tuple(head.name for head in self.patella.heads)
        (main,) = self._extensor_names[:1]
        is_total = tensions is not None and not isinstance(tensions, Mapping)
        given = checked_tensions(tensions, (main,), dict.fromkeys((*heads, *self._lines)))
        if not is_total and main in heads:
            return given
        # A number is the tension of the whole quadriceps, and so is the name of a line that is no
        # head: the heads share it.
        total = given.pop(main, 0.0)
        shared = self.patella.head_tensions(total)
        return {name: given.get(name, 0.0) + shared.get(name, 0.0) for name in (*heads, *given)}

    def _find_patella(self, kinematics: KneePose, data: KneeData) -> "PatellaState":
        lines = self.extensor_lines
        assert lines is not None
        if self._finds_patella:
            data.patella = solution = lines.solved(kinematics.pose, data.patella)
        else:
            assert kinematics.patella is not None
            solution = lines.given(kinematics.pose, kinematics.patella)
        if not solution.status.found:
            raise ComputationError(f"patella lost: {solution.status.value}", "extensor")
        return solution

    def _link_poses(self, kinematics: KneePose, patella: "PatellaState | None") -> dict[str, Array]:
        poses = {
            "femur": kinematics.pose,
            "tibia": inverse(self.chain.insert_in_tibia),
            "insert": np.eye(4),
        }
        if patella is not None:
            joint = self.chain.patella_joint_in_femur
            poses["patella"] = kinematics.pose @ joint @ sagittal_pose(patella.coordinates)
        return poses

    def _with_lines(self, data: KneeData, tensions: Mapping[str, float], forces: Any) -> Any:
        """Return forces on the joints with the forces of the muscle lines added.

        Args:
            data: data with joint placements up to date.
            tensions: muscle -> tension, N.
            forces: one force per joint; None: zero.
        """
        pulling = [name for name in self._lines if tensions.get(name, 0.0)]
        if not pulling:
            return forces
        loads = [pin.Force.Zero()] * self.model.njoints if forces is None else forces
        total = [pin.Force(force) for force in loads]
        for name in pulling:
            for joint, force in self._lines[name].forces(data.data, tensions[name]):
                total[joint] += force
        return pin.StdVec_Force(total)


def _placement(pose: Any) -> pin.SE3 | None:
    """Return `pin.SE3` for `pin.SE3` or (4, 4)."""
    if pose is None or isinstance(pose, pin.SE3):
        return pose
    return se3(np.asarray(pose, float))


def _identity(knee: AssembledKnee) -> str:
    """Return words for a knee, with a random number of its own."""
    contact = "no contact" if knee.contact is None else knee.contact.model.name
    return f"'{knee.model.name}, {knee.side}, {contact}, {uuid.uuid4().hex[:8]}'"
