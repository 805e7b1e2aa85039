"""A knee in the frames of a recorded motion: each frame as an instant, and what runs store of it.

A resumed run takes its initial guess from the stored arrays of contact (`frame_arrays`,
`Recording.recalled`). They lack the displacements of the lattice, so it differs from a single run
within the tolerance of the solver.
"""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array, cross, inverse, knee_pose, transform
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.frame import Frame, FrameMethod, FrameStart
from tkamb.knee.instant import Instant
from tkamb.knee.knee import Knee
from tkamb.knee.load import PointForces

if TYPE_CHECKING:
    from tkamb.contact.model import ContactModel
    from tkamb.knee.extensor import ExtensorFrames
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState
    from tkamb.knee.slip import CondyleSlip
    from tkamb.run.muscles.shared_muscles import SharedMuscles


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a Pinocchio model in f frames.

    Args:
        time: times, s, (f,).
        q: configurations, (f, nq).
        v: velocities, (f, nv).
        a: accelerations, (f, nv).
        coordinates: knee coordinates, m and rad, (f, 6).
    """

    time: Array
    q: Array
    v: Array
    a: Array
    coordinates: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Ground(Sequence[Any]):
    """The ground reaction in each frame as external forces on the joints of a model.

    Args:
        forces: one `pin.StdVec_Force` per frame, with a force per joint in the joint's frame.
        points: points of application in the laboratory, m, (f, 3).
    """

    forces: tuple[Any, ...]
    points: Array

    def __len__(self) -> int:
        return len(self.forces)

    def __getitem__(self, k: Any) -> Any:
        return self.forces[k]


class Recording:
    """A knee in the frames of a motion.

    Args:
        method: how a frame of the knee, which is that of a right leg, is computed.
        ground: ground reaction; None: not measured.
        muscles: muscles of [muscles]; None: the quadriceps alone.

    Attributes:
        poses: recorded pose_femur_in_insert, (f, 4, 4).
    """

    def __init__(
        self,
        method: FrameMethod,
        motion: Motion,
        ground: Ground | None = None,
        extensor: "ExtensorFrames | None" = None,
        muscles: "SharedMuscles | None" = None,
        strains: dict[str, tuple[float, ...]] | None = None,
    ) -> None:
        self.method, self.motion, self.ground = method, motion, ground
        self.extensor, self.muscles, self.strains = extensor, muscles, strains or {}
        self.poses = knee_pose(motion.coordinates)
        self._data = self.knee._kinematic_data()

    @property
    def knee(self) -> Knee:
        """The knee."""
        return self.method.knee

    @property
    def ligaments(self) -> "tuple[Ligament, ...]":
        """The ligament bundles with their slack lengths."""
        return self.knee.ligaments

    def with_contact(self, model: "ContactModel") -> "Recording":
        """Return the same recording with another contact model."""
        method = self.method.of(self.knee.with_contact(model))
        return Recording(
            method, self.motion, self.ground, self.extensor, self.muscles, self.strains
        )

    def instant(self, k: int) -> Instant:
        """Return the knee at frame k."""
        motion = self.motion
        instant = self.knee._instant(
            motion.q[k],
            motion.v[k],
            motion.a[k],
            None if self.ground is None else self.ground[k],
            data=self._data,
            patella=None if self.extensor is None else self.extensor.at(k),
            muscles=None if self.muscles is None else self.muscles.frame(k),
        )
        # Joint placements cause rounding errors: restore the recorded coordinates exactly.
        joints = instant.motion.joints.copy()
        joints[0, :6] = motion.coordinates[k]
        if self.extensor is not None:
            joints[0, 6:] = self.extensor.joints(k)[0]
        instant = replace(instant, motion=replace(instant.motion, joints=joints))
        if self.ground is None or instant.ground is None:
            return instant
        insert = instant.motion.tibia @ self.knee.chain.insert_in_tibia
        point = transform(inverse(insert), self.ground.points[k])
        return replace(instant, ground=_acting_at(point, instant.ground))

    def geometry(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return the geometry of frame k without contact, see `Instant.geometry`."""
        return self.instant(k).geometry(coordinates, patella)

    def loads(self, k: int) -> Frame:
        """Return frame k by the equations alone, with contact points on the undeformed meshes."""
        began, instant = clock.perf_counter(), self.instant(k)
        seconds = clock.perf_counter() - began
        frame = self.method.loads(instant)
        return replace(frame, seconds=frame.seconds + seconds)

    def frame(self, k: int, before: Sequence[FrameStart] = ()) -> Frame:
        """Return loads and contact of frame k."""
        began, instant = clock.perf_counter(), self.instant(k)
        seconds = clock.perf_counter() - began
        frame = self.method.frame(instant, before)
        return replace(frame, seconds=frame.seconds + seconds)

    def slips(self, last: int) -> "dict[str, CondyleSlip]":
        """Return side -> rolling and slip of a condyle up to a frame; empty without contact.

        Args:
            last: last frame of the slip. The slip rate uses one more frame.
        """
        if self.knee.contact is None:
            return {}
        from tkamb.knee.slip import condyle_slip

        pair = self.knee.contact.pair
        recorded = self.motion.coordinates[: last + 2]
        result = condyle_slip(pair.femoral, pair.insert, pair.split, recorded)
        sides = zip(SIDES, result, strict=True)
        return {side: slip for side, slip in sides if slip is not None}

    def recalled(self, k: int, arrays: Mapping[str, Array] | None) -> FrameStart:
        """Return the initial guess that a stored frame gives to the next one.

        Args:
            arrays: result of `frame_arrays`; None: the frame had no contact.
        """
        contact = self.knee.contact
        if contact is None or arrays is None:
            return FrameStart()
        from tkamb.contact.result import WarmStart

        pose, pressure, gap = (arrays[name] for name in ("pose", "pressure", "gap"))
        state, equilibrium = contact.state, None
        if "equilibrium_coordinates" in arrays:
            from tkamb.knee.released import stored_equilibrium

            patella = None
            if self.extensor is not None and "equilibrium_patella" in arrays:
                found = self.extensor.states[k]
                patella = replace(found, coordinates=arrays["equilibrium_patella"])
            geometry = self.geometry(k, arrays["equilibrium_coordinates"], patella)
            force, stiffness = arrays["equilibrium_force"], arrays["equilibrium_stiffness"]
            equilibrium = stored_equilibrium(geometry, patella, force, stiffness)
        start, button = WarmStart(state.pair, pose, state.points, pressure, gap), None
        if self.knee.button_contact is not None and BUTTON + "pose" in arrays:
            state = self.knee.button_contact.contact.state
            pose, pressure, gap = (arrays[BUTTON + name] for name in ("pose", "pressure", "gap"))
            button = WarmStart(state.pair, pose, state.points, pressure, gap)
        return FrameStart(start, equilibrium, button, arrays.get("patella_coordinates"))


RESULT_ARRAYS = ("pose", "pressure", "gap", "nodal_force")
"""Arrays of a contact result that maps and warm starts need."""
BUTTON = "button_"
"""Beginning of the same arrays' names for the button."""
CONTACT_PLACES = ("contact_points", "contact_normals")
"""Arrays (3, 3) of contact points, m, and unit normals of medial condyle, lateral condyle and
patella; NaN without contact."""


def frame_arrays(frame: Frame) -> dict[str, Array] | None:
    """Return the arrays of a frame to store, by name; None without a contact."""
    result, geometry, knee = frame.contact, frame.geometry, frame.equilibrium
    if result is None:
        return None
    arrays = {name: np.asarray(getattr(result, name), float) for name in RESULT_ARRAYS}
    points, normals = np.full((2, 3, 3), np.nan)
    for side, condyle in geometry.condyles.items():
        points[SIDES.index(side)], normals[SIDES.index(side)] = condyle.point, condyle.normal
    if geometry.extensor is not None:
        points[2] = geometry.extensor.contact_point
        normals[2] = geometry.extensor.contact_normal
    arrays |= zip(CONTACT_PLACES, (points, normals), strict=True)
    if frame.button is not None and frame.button.contact is not None:
        for name in RESULT_ARRAYS:
            arrays[BUTTON + name] = np.asarray(getattr(frame.button.contact, name), float)
    if frame.next.patella is not None:
        arrays["patella_coordinates"] = frame.next.patella
    if knee is not None:
        arrays["equilibrium_coordinates"] = knee.coordinates
        arrays["equilibrium_force"] = knee.balance.force
        arrays["equilibrium_stiffness"] = knee.balance.stiffness
        if knee.patella is not None:
            arrays["equilibrium_patella"] = knee.patella.coordinates
    return arrays


def _acting_at(point: Array, load: PointForces) -> PointForces:
    moment = load.moment - np.asarray(cross(point, load.forces[0]))
    return PointForces(load.link, point[None], load.forces, moment)
