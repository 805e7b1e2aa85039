"""The extensor mechanism of a case: the patella over all frames, and its lines of action."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

from tkamb.body.chain import ChainState
from tkamb.body.knee import Extensor
from tkamb.body.lines import StringLine
from tkamb.body.load import PointForces
from tkamb.body.patella import (
    ExtensorMechanism,
    PatellaState,
    patella_at,
    solve_patella,
)
from tkamb.body.patellofemoral import PatellofemoralContact
from tkamb.body.wrapping import TautPath, is_inside
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.geometry.sections import sagittal_outline
from tkamb.inputs.filtering import differentiate_coordinates
from tkamb.inputs.meshes import BONE_SIZE, load_surface, mirrored
from tkamb.scene.tables import Attachment
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface
    from tkamb.scene.case import Case


class ExtensorFrames:
    """Quadriceps, patella and patellar ligament over the frames of a case.

    Args:
        case: a case with [quadriceps], [patellar_ligament] and [patella].
        poses: (f, 4, 4) pose_femur_in_insert.

    Raises:
        InputError: a line starts inside what it wraps, or no patella was recorded.
    """

    def __init__(self, case: "Case", poses: Array) -> None:
        self.case = case
        self.quadriceps, self.ligament = _quadriceps(case), _ligament(case)
        self._check_fixed_ends()
        self._mechanism = mechanism = self._as_mechanism()
        if case.scene.patella is not None and case.scene.patella.motion == "recorded":
            motion = case.motion
            if motion.patella is None:
                raise InputError(
                    "has no patella columns",
                    case.scene.motion.file,
                    "record patella_ap, patella_si, patella_rotation or set [patella] motion = "
                    "'solved'",
                )
            assert motion.patella_velocity is not None and motion.patella_acceleration is not None
            self._joints = np.stack(
                [motion.patella, motion.patella_velocity, motion.patella_acceleration], axis=1
            )
            self.states = [
                patella_at(mechanism, pose, coordinates)
                for pose, coordinates in zip(poses, motion.patella, strict=True)
            ]
        else:
            self.states = _solved(mechanism, poses)
            self._joints = self._differentiated()

    def joints(self, k: int) -> Array:
        """Return patella coordinates, rates and accelerations (3, 3) of frame k; NaN if lost."""
        return np.asarray(self._joints[k])

    def patella(self, k: int, pose: Array, guess: Array | None = None) -> PatellaState:
        """Return the patella of frame k with the femur at another pose (4, 4).

        Recorded coordinates are kept; a solved patella is found anew, from `guess` (3,) or
        from where it was at the recorded pose.
        """
        found = self.states[k].coordinates if guess is None else guess
        if self.case.scene.patella is not None and self.case.scene.patella.motion == "recorded":
            return patella_at(self._mechanism, pose, self.states[k].coordinates)
        return solve_patella(self._mechanism, pose, found)

    def at(
        self, k: int, state: ChainState, patella: PatellaState | None = None
    ) -> tuple[Extensor, float]:
        """Return the loads of unit tensions, and the quadriceps' wrap (rad).

        Args:
            k: frame.
            state: the chain there.
            patella: where it is, if not as at the recorded pose.

        Raises:
            ComputationError: no patella at this frame, or a line's end inside what it wraps.
        """
        patella = self.states[k] if patella is None else patella
        if not patella.status.found:
            flexion = self.case.motion.coordinates[k, 5] / DEGREE
            raise ComputationError(
                f"patella lost at {flexion:.1f} deg of flexion: {patella.status.value}"
            )
        quadriceps, ligament = self.paths(state)
        extensor = Extensor(
            self.quadriceps.loads(quadriceps),
            tuple(_on_tibia(load) for load in self.ligament.loads(ligament)),
            patella.contact_point,
            patella.contact_normal,
        )
        return extensor, quadriceps.wrap_angle

    def paths(self, state: ChainState) -> tuple[TautPath, TautPath]:
        """Return quadriceps and patellar ligament as they run, in the insert frame.

        Raises:
            ComputationError: a line's end inside what it wraps.
        """
        lines = (self.quadriceps, self.ligament)
        links = {link for line in lines for link in (line.start_link, line.end_link)}
        poses = {link: state.pose(link) for link in links | {"femur"}} | {"insert": np.eye(4)}
        quadriceps, ligament = (line.path(poses) for line in lines)
        return quadriceps, ligament

    def _check_fixed_ends(self) -> None:
        """Raise if the end that does not move against an outline lies within it."""
        chain, ends = self.case.chain, []
        if self.quadriceps.outline is not None:
            to_femur = chain.link_in(self.quadriceps.start_link, "femur")
            origin = transform(to_femur, self.quadriceps.start_point)
            femoral = self.case.femoral
            assert femoral is not None
            low, high = femoral.bounds[:, 2]
            whole = sagittal_outline([femoral], 0.95 * np.linspace(low, high, 15))
            ends.append(("[quadriceps] origin", origin, whole, "femur"))
        if self.ligament.outline is not None:
            tuberosity = transform(self._tibia_in_insert(), self.ligament.end_point)
            ends.append(("[patellar_ligament] distal", tuberosity, self.ligament.outline, "insert"))
        for name, point, outline, bone in ends:
            if is_inside(point, outline):
                raise InputError(
                    f"lies inside the outline of the {bone} that the line wraps",
                    name,
                    "move the point, or set wrap = false",
                )

    def _tibia_in_insert(self) -> Array:
        """Return the pose in the insert frame of the link that holds the ligament's end."""
        chain = self.case.chain
        return inverse(chain.insert_in_tibia) @ chain.link_in(self.ligament.end_link, "tibia")

    def _as_mechanism(self) -> ExtensorMechanism:
        case, quadriceps, ligament = self.case, self.quadriceps, self.ligament
        assert case.femoral is not None and case.patella is not None
        chain, table = case.chain, case.scene.patellar_ligament
        assert table is not None
        joint = chain.patella_joint_in_femur
        to_femur = chain.link_in(quadriceps.start_link, "femur")
        return ExtensorMechanism(
            PatellofemoralContact(case.femoral.moved(inverse(joint)), case.patella),
            joint,
            transform(to_femur, quadriceps.start_point),
            transform(chain.link_in(quadriceps.end_link, "patella"), quadriceps.end_point),
            transform(chain.link_in(ligament.start_link, "patella"), ligament.start_point),
            transform(self._tibia_in_insert(), ligament.end_point),
            (table.length_mm or np.nan) * MILLIMETRE,
            quadriceps.outline,
            ligament.outline,
        )

    def _differentiated(self) -> Array:
        """Return the solved coordinates with their rates (f, 3, 3); NaN where it is lost.

        Lost frames between found ones are bridged for the rates of their neighbours (shape-
        preserving cubic): a patella of 0.1 kg turns an acceleration that is wrong by 1 m/s²
        into 0.1 N.
        """
        motion, cutoff = self.case.motion, self.case.scene.motion.cutoff_Hz
        places = np.array([state.coordinates for state in self.states])
        found = np.flatnonzero(np.isfinite(places).all(axis=1))
        if len(found) < 2:
            raise InputError(
                f"no place of the patella is found in {len(places) - len(found)} of "
                f"{len(places)} frames; first: {self.states[0].status.value}",
                "[patella]",
                "check its mesh, the lines' points and length_mm",
            )
        part = slice(found[0], found[-1] + 1)
        time = motion.time[part]
        bridged = PchipInterpolator(motion.time[found], places[found])(time)
        x, v, a = differentiate_coordinates(time, bridged, cutoff, name="places of the patella")
        result = np.full((len(places), 3, 3), np.nan)
        result[part] = np.stack([x, v, a], axis=1)
        result[np.isnan(places).any(axis=1)] = np.nan
        return result


def _solved(mechanism: ExtensorMechanism, poses: Array) -> list[PatellaState]:
    """Solve frame after frame, each from the one before."""
    states: list[PatellaState] = []
    for pose in poses:
        guess = states[-1].coordinates if states else None
        states.append(solve_patella(mechanism, pose, guess))
    return states


def _quadriceps(case: "Case") -> StringLine:
    table = case.scene.quadriceps
    assert table is not None and case.femoral is not None
    outline = None
    ends = (_point(table.origin), _point(table.insertion))
    if table.wrap:
        surfaces = [case.femoral]
        bone = quadriceps_bone(case)
        if bone is not None:
            surfaces.append(bone)
        outline = sagittal_outline(
            surfaces,
            _band(table.band_mm) + case.chain.patella_joint_in_femur[2, 3],
            table.half_thickness_mm * MILLIMETRE,
            below=float(transform(case.chain.link_in(table.origin.link, "femur"), ends[0])[1]),
        )
    return StringLine(
        "quadriceps", table.origin.link, ends[0], table.insertion.link, ends[1], outline, "femur"
    )


def _ligament(case: "Case") -> StringLine:
    table = case.scene.patellar_ligament
    assert table is not None
    outline = None
    ends = (_point(table.proximal), _point(table.distal))
    if table.wrap and case.insert is not None:
        place = transform(
            inverse(case.chain.insert_in_tibia) @ case.chain.link_in(table.distal.link, "tibia"),
            ends[1],
        )
        outline = sagittal_outline(
            [case.insert],
            _band(table.band_mm) + place[2],
            table.half_thickness_mm * MILLIMETRE,
        )
    return StringLine(
        "patellar_ligament",
        table.proximal.link,
        ends[0],
        table.distal.link,
        ends[1],
        outline,
        "insert",
    )


def _band(half_width_mm: float) -> Array:
    """Return the sagittal planes (n,) m, about the line's own, whose sections are wrapped."""
    return np.linspace(-half_width_mm, half_width_mm, 7) * MILLIMETRE


def _on_tibia(load: PointForces) -> PointForces:
    """Return the load with the insert, which the tibia carries, named as the tibia."""
    return replace(load, link="tibia") if load.link == "insert" else load


def _point(end: Attachment) -> Array:
    return np.array(end.point_mm) * MILLIMETRE


def quadriceps_bone(case: "Case") -> "Surface | None":
    """Return the bone that the quadriceps may wrap, in the femur's frame; None without one.

    Raises:
        InputError: the mesh cannot be read.
    """
    table = case.scene.quadriceps.bone if case.scene.quadriceps else None
    if table is None:
        return None
    surface = load_surface(table.mesh, table.unit, table.axes, name="bone", size=BONE_SIZE)
    if case.scene.patient.side == "left":
        surface = mirrored(surface)
    return surface.moved(case.chain.link_in(table.link, "femur"))
