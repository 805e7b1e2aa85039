"""A leg's muscles from files: model, coordinates or markers, ground reaction."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.importing.links import Links, find_links
from tkamb.io.importing.model_fit import fit_model
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import CoordinateMotion, coordinate_motion, read_coordinates
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.filtering import Cutoff
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.recording_tables import GroundReactionTable, Side
from tkamb.io.recordings.tables import read_table
from tkamb.run.muscles.knee_trial import KneeTrial, knee_trial
from tkamb.run.muscles.leg import foot_loads, leg_bones, leg_muscles, muscle_groups
from tkamb.run.muscles.sharing import Sharing


@dataclass(frozen=True, eq=False)
class LegRecording:
    """The files and options from which a leg and its muscles are read.

    Args:
        model: the .osim file.
        side: of the knee.
        coordinates: .mot or .sto of the model's coordinates; None: they are fitted to markers.
        markers: recording of markers, where they are.
        laboratory_axes: the markers' axes that point forward, up and right.
        cutoff: Hz, of the coordinates.
        ground: what the ground exerts on the foot; None: nothing.
        insert_placement: (4, 4) of the insert's mesh in the insert frame, see `find_links`; None
            without an implant.
        mesh_axes: the mesh's axes that point anterior, superior and right.
        sharing: options.
    """

    model: Path
    side: Side
    coordinates: Path | None
    markers: Path | None
    laboratory_axes: str
    cutoff: Cutoff
    ground: GroundReactionTable | None
    insert_placement: Array | None
    mesh_axes: str
    sharing: Sharing


def load_knee_trial(source: LegRecording, time: Array) -> tuple[Links, KneeTrial]:
    """Return where the links stand in the model's bodies, and the trial at some times.

    Args:
        source: what is read.
        time: (f,) s, on the recordings' clock.

    Raises:
        InputError: whatever cannot be used.
    """
    leg = _read_leg(source.model, source.side)
    model = leg.model
    links = find_links(leg, source.insert_placement, source.mesh_axes, {}, False)
    motion = _motion(source, Kinematics(model), time)
    loads = {}
    if source.ground is not None:
        # the model's own side, so that nothing is mirrored
        reaction = load_ground_reaction(source.ground, time, "right")
        loads = foot_loads(model, {source.side: reaction})
    return links, knee_trial(links, motion, loads, source.sharing)


def group_names(model: Path, side: Side) -> tuple[str, ...]:
    """Return the names of the groups of a leg's muscles, see `muscle_groups`.

    Args:
        model: the .osim file.
        side: of the leg.

    Raises:
        InputError: whatever cannot be used.
    """
    leg = _read_leg(model, side)
    return tuple(muscle_groups(leg, [leg.model.muscles[name] for name in leg_muscles(leg)]))


def _read_leg(path: Path, side: Side) -> Leg:
    """Return a leg of a model whose joints and constraints, and this leg's muscles, were read.

    Raises:
        InputError: one of them was not.
    """
    leg = find_leg(read_osim(path, partial=True), side)
    bodies = {body for group in leg_bones(leg).values() for body in group}
    for one in leg.model.unread:
        if one.constrains or (one.concerns & bodies and one.kind != "Marker"):
            raise InputError(one.reason)
    return leg


def _motion(source: LegRecording, kinematics: Kinematics, time: Array) -> CoordinateMotion:
    if source.coordinates is not None:
        recorded = read_table(source.coordinates)
        q, _ = read_coordinates(kinematics, recorded)
        stamps = recorded.time()
    else:
        if source.markers is None:
            raise InputError("is missing", "[muscles] coordinates", "name a .mot or .sto file")
        recorded = read_table(source.markers)
        stamps = recorded.time()
        _, fit = fit_model(kinematics.model, recorded, laboratory_axes=source.laboratory_axes)
        if not fit.solved.all():
            raise InputError(
                f"the model's chain is not found in {int((~fit.solved).sum())} frames",
                source.markers,
                "give [muscles] coordinates",
            )
        q = fit.state
    if time[0] < stamps[0] - 1e-9 or time[-1] > stamps[-1] + 1e-9:
        raise InputError(
            f"covers {stamps[0]:g} to {stamps[-1]:g} s, the frames {time[0]:g} to {time[-1]:g} s",
            recorded.path,
        )
    return coordinate_motion(
        kinematics, stamps, np.asarray(q), source.cutoff, time, "coordinates of the model"
    )
