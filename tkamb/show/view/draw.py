"""Drawing of a run: bodies of the scene, forces and numbers of results.csv, pressure maps."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import SIDES, Array, Mask, inverse
from tkamb.io.scene.case import Case
from tkamb.knee.chain import ChainState
from tkamb.run.claims import split_of
from tkamb.run.metrics import body_weight, map_rows, medial_share
from tkamb.show.axis import HorizontalAxis, horizontal_axis
from tkamb.show.headline import run_title
from tkamb.show.view.drawing import Drawing, PressureMap, Reading
from tkamb.show.view.lines import (
    centre_markers,
    centres_of_pressure,
    contact_markers,
    extensor_strands,
    force_arrows,
    ligament_strands,
    muscle_strands,
    path_strands,
)
from tkamb.show.view.run import CaseResults, Progress
from tkamb.show.view.solids import (
    contact_poses,
    floor_and_foot,
    patella_solids,
    solids,
    worn_insert,
)
from tkamb.units import MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.maps import ContactMaps
    from tkamb.run.results import Results

STAND_INS = "{} plain stand-ins between the joint centres; they carry no load."
FOOT = "The foot is a stand-in too, drawn level with the floor whatever it did."


def draw(
    run: CaseResults, progress: Progress = lambda frames: frames, lattice: bool = False
) -> Drawing:
    """Return the drawing of a run.

    Args:
        progress: function that wraps the frame indices, for example a progress bar.
        lattice: whether the cells of the lattice are drawn too.
    """
    case, recording, results = run.case, run.recording, run.results
    geometries = run.geometries(progress)
    states = [one.state for one in geometries]
    maps, result = results.maps, map_rows(results)
    rows = [result.get(k, -1) for k in range(len(results))]
    button = button_poses(run, states, rows)
    contact = case.scene.contact
    floor, centre = floor_and_foot(case, geometries, run.frames)
    others = floor + worn_insert(results, case.scene.patient.side)
    bundles, limit = ligament_strands(recording, states, results)
    muscles, most_active = muscle_strands(geometries)
    extensor = extensor_strands(recording, geometries, results)
    strands = [*bundles, *extensor, *muscles]
    markers = [*contact_markers(geometries), *centre]
    if maps is not None and result:
        assert case.insert is not None
        centres = centres_of_pressure(results, case.insert)
        strands += path_strands(centres)
        markers += centre_markers(centres)
    axis = horizontal_axis(results)
    return Drawing(
        title=_title(run),
        side=case.scene.patient.side,
        body_weight=case.body_weight,
        contact=contact.model if contact else "",
        labels=frame_labels(axis),
        times=results["time_s"],
        statuses=tuple(results.status),
        readings=readings(results, axis),
        solids=solids(case, recording.poses[list(run.frames)], states, maps, rows)
        + patella_solids(recording.knee, _patella_poses(run, states, button))
        + others,
        strands=tuple(strands),
        arrows=force_arrows(results, geometries, contact.friction if contact else 0.0),
        markers=tuple(markers),
        map=_pressure_map(maps, rows),
        button_map=_button_map(results, button),
        strain_limit=limit,
        activation_limit=most_active,
        lattice=lattice_lines(case) if lattice else np.empty((0, 2, 3)),
        notes=(*_stand_ins(case, bool(floor)), *case.scene.output.notes),
    )


def _stand_ins(case: Case, foot: bool) -> tuple[str, ...]:
    words = STAND_INS.format("Tibia and patella are" if case.bone else "Bones are")
    return (words, FOOT) if foot else (words,)


def _title(run: CaseResults) -> str:
    name, contact = run_title(run.results.summary), run.case.scene.contact
    if contact is None:
        return f"{name} (contact not modelled)"
    return f"{name}, contact: {contact.model} at {contact.resolution_mm:g} mm"


def button_poses(run: CaseResults, states: Sequence[ChainState], rows: Sequence[int]) -> Array:
    """Return the pose (f, 4, 4) of the patellar button in its contact, in the insert frame.

    It is NaN in a frame without a map of the button.

    Args:
        states: state of the chain in each frame.
        rows: row of the insert's map of each frame; -1: the frame has no map.
    """
    results = run.results
    maps, poses = results.button_maps, np.full((len(states), 4, 4), np.nan)
    femur = contact_poses(np.stack([one.pose("femur") for one in states]), results.maps, rows)
    if maps is not None:
        for frame, row in map_rows(results, maps).items():
            poses[frame] = femur[frame] @ inverse(maps.femoral_pose[row])
    return poses


def _patella_poses(run: CaseResults, states: Sequence[ChainState], button: Array) -> Array:
    """Return the pose (f, 4, 4) of the patella: that of its contact, or of the equations."""
    poses = np.stack([state.pose("patella") for state in states]) if _has_patella(run) else button
    contact, mapped = run.recording.knee.button_contact, np.isfinite(button).all(axis=(1, 2))
    if contact is not None:
        poses[mapped] = button[mapped] @ inverse(contact.in_patella)
    return poses


def _has_patella(run: CaseResults) -> bool:
    return run.case.scene.patella is not None and run.case.patella is not None


def _button_map(results: "Results", poses: Array) -> PressureMap | None:
    maps, rows = results.button_maps, map_rows(results, results.button_maps)
    if maps is None or not rows:
        return None
    pressure = _pressure_map(maps, [rows.get(k, -1) for k in range(len(results))])
    return None if pressure is None else replace(pressure, poses=poses)


def _pressure_map(maps: "ContactMaps | None", rows: list[int]) -> PressureMap | None:
    if maps is None or all(row < 0 for row in rows):
        return None
    missing = np.full(len(maps.points_m), np.nan)
    pressure, gap = (
        np.stack([maps.rows(name, [row])[0] if row >= 0 else missing for row in rows])
        for name in ("pressure_Pa", "gap_m")
    )
    return PressureMap(maps.points_m, maps.triangles, pressure / MEGAPASCAL, gap)


def lattice_lines(case: Case) -> Array:
    """Return the edges (s, 2, 3) of the lattice's outer cell faces, m, insert frame.

    The cells have the scene's resolution, for any contact model. The result is empty without
    contact.
    """
    if case.scene.contact is None or case.insert is None:
        return np.empty((0, 2, 3))
    from tkamb.contact.lattice.meshing.cells import FACES
    from tkamb.contact.lattice.meshing.quality import whole_lattice

    lattice = whole_lattice(case.insert, case.scene.contact.resolution_mm * MILLIMETRE)
    faces = lattice.cells[:, FACES].reshape(-1, 4)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = faces[first[count == 1]]
    edges = np.stack([outer, np.roll(outer, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.asarray(lattice.nodes[np.unique(np.sort(edges, axis=1), axis=0)])


def readings(results: "Results", axis: HorizontalAxis) -> tuple[Reading, ...]:
    """Return the numbers to display. Numbers that are NaN in all frames are left out."""
    weight = body_weight(results)

    def number(name: str, values: Array, unit: str, digits: int = 0) -> Reading:
        return _reading(name, lambda value: _text(value, digits) + unit, values)

    def force(name: str, values: Array) -> Reading:
        return _reading(name, lambda value: f"{value / weight:.2f} BW ({value:.0f} N)", values)

    def both(name: str, column: str, unit: str, digits: int = 0, scale: float = 1.0) -> Reading:
        def write(medial: float, lateral: float) -> str:
            return f"M {_text(medial, digits)} · L {_text(lateral, digits)}{unit}"

        return _reading(name, write, *(scale * results[f"{side}_{column}"] for side in SIDES))

    rows = [
        _reading("time", lambda value: f"{value:.2f} s", results["time_s"]),
        number("flexion", results["flexion_deg"], "°", 1),
        _reading("adduction", _direction("varus", "valgus"), results["adduction_deg"]),
        _reading("axial rotation", _direction("ext.", "int."), results["axial_rotation_deg"]),
        force("contact force", results["force_total_N"]),
        *_split_readings(results, both, number),
        both("peak pressure", "peak_pressure_MPa", " MPa", 1),
        both("contact area", "area_mm2", " mm²"),
        force("quadriceps", results["quadriceps_N"]),
        force("patellar ligament", results["patellar_ligament_N"]),
        force("patellofemoral", results["patellofemoral_N"]),
        *_button_readings(results, number),
        force("hip", _magnitude(results, "hip_force")),
        force("ground reaction", _magnitude(results, "ground_reaction")),
    ]
    return tuple(row for row in rows if any(value != "–" for value in row.values))


def _button_readings(results: "Results", number: Callable[..., Reading]) -> list[Reading]:
    """Return the numbers of button and released patella that the run has."""
    rows = (
        ("· button, peak pressure", "button_peak_pressure_MPa", " MPa", 1),
        ("· button, contact area", "button_area_mm2", " mm²", 0),
        ("· patella, lateral tilt", "patella_tilt_deg", "°", 1),
        ("· patella, lateral shift", "patella_shift_mm", " mm", 1),
    )
    return [
        number(name, results[column], unit, digits)
        for name, column, unit, digits in rows
        if column in results.columns
    ]


def _split_readings(
    results: "Results", both: Callable[..., Reading], number: Callable[..., Reading]
) -> list[Reading]:
    """Return forces and medial share by each estimate, the one that the run may state first.

    Numbers by deformation carry "?" in frames in which adduction does not determine them.
    """
    split, weight = split_of(results.columns), body_weight(results)
    names = {"equilibrium": "force_equilibrium_N", "deformation": "force_N"}
    short = {"equilibrium": "equil.", "deformation": "deform."}
    rows = []
    for estimate in sorted(names, key=lambda name: name != split.estimate):
        pair = [
            both(f"· by {estimate}", names[estimate], " BW", 2, 1.0 / weight),
            number(
                f"· medial share, {short[estimate]}", 100 * medial_share(results, estimate), " %"
            ),
        ]
        if estimate == "deformation":
            pair = [replace(row, values=_doubted(row.values, split.undetermined)) for row in pair]
        rows += pair
    return rows


def _doubted(values: Sequence[str], doubtful: Mask) -> tuple[str, ...]:
    return tuple(
        f"{text} ?" if doubt and text != "–" else text
        for text, doubt in zip(values, doubtful, strict=True)
    )


def frame_labels(axis: HorizontalAxis) -> tuple[str, ...]:
    """Return the position of each frame in the motion as text."""
    words = {"flexion": "{} of flexion", "cycle": "{} of the cycle", "time": "{}"}[axis.kind]
    return tuple(words.format(axis.at(k)) for k in range(len(axis.values)))


def _reading(name: str, write: Callable[..., str], *columns: Array) -> Reading:
    """Return a text per frame. It is "–" if all columns are NaN in the frame."""
    return Reading(
        name,
        tuple(
            write(*values) if np.isfinite(values).any() else "–"
            for values in zip(*columns, strict=True)
        ),
    )


def _magnitude(results: "Results", stem: str) -> Array:
    return np.sqrt(sum(results[f"{stem}_{axis}_N"] ** 2 for axis in ("ap", "si", "ml")))


def _direction(positive: str, negative: str) -> Callable[[float], str]:
    """Return a function that writes an angle (deg) without sign, with its direction as a word."""
    return lambda angle: f"{abs(angle):.1f}° {positive if round(angle, 1) >= 0 else negative}"


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if np.isfinite(value) else "–"
