"""A run into a drawing: geometry of the scene, forces and numbers of results.csv, the maps."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tkamb.contact.lattice.meshing.cells import FACES
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.geometry.frames import Array
from tkamb.output.axis import HorizontalAxis, horizontal_axis
from tkamb.output.metrics import body_weight, map_rows, medial_share
from tkamb.scene.case import Case
from tkamb.units import MEGAPASCAL, MILLIMETRE
from tkamb.view.arrows import contact_markers, force_arrows
from tkamb.view.drawing import Drawing, PressureMap, Reading
from tkamb.view.run import CaseResults
from tkamb.view.solids import floor_and_foot, solids
from tkamb.view.strands import (
    centre_markers,
    centres_of_pressure,
    extensor_strands,
    ligament_strands,
    path_strands,
)

if TYPE_CHECKING:
    from tkamb.results import Results

Progress = Callable[[Iterable[int]], Iterable[int]]

STAND_INS = "{} plain stand-ins between the joint centres; they carry no load."
FOOT = "The foot is a stand-in too, drawn level with the floor whatever it did."


def draw(
    run: CaseResults, progress: Progress = lambda frames: frames, lattice: bool = False
) -> Drawing:
    """Return what is drawn of a run.

    Args:
        run: case, mechanics and results that belong together.
        progress: wraps the frame indices, a progress bar for example.
        lattice: whether the contact model's grid is drawn too.
    """
    case, mechanics, results = run.case, run.mechanics, run.results
    geometries = [body.geometry for body in run.bodies(progress)]
    states = [one.state for one in geometries]
    maps, found = results.maps, map_rows(results)
    rows = [found.get(k, -1) for k in range(len(results))]
    contact = case.scene.contact
    floor, centre = floor_and_foot(case, geometries, run.frames)
    bundles, limit = ligament_strands(mechanics, states)
    strands = [*bundles, *extensor_strands(mechanics, states)]
    markers = [*contact_markers(geometries), *centre]
    if maps is not None and found:
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
        solids=solids(case, mechanics.poses[list(run.frames)], states, maps, rows) + floor,
        strands=tuple(strands),
        arrows=force_arrows(results, geometries, contact.friction if contact else 0.0),
        markers=tuple(markers),
        map=_pressure_map(results, rows),
        strain_limit=limit,
        lattice=lattice_lines(case) if lattice else np.empty((0, 2, 3)),
        notes=(*_stand_ins(case, bool(floor)), *case.scene.output.notes),
    )


def _stand_ins(case: Case, foot: bool) -> tuple[str, ...]:
    words = STAND_INS.format("Tibia and patella are" if case.bone else "Bones are")
    return (words, FOOT) if foot else (words,)


def _title(run: CaseResults) -> str:
    path = Path(str(run.results.summary.get("scene") or "scene"))
    name = path.parent.name if path.stem == "scene" and path.parent.name else path.stem
    name = name.upper() if len(name) <= 3 else name.replace("_", " ").capitalize()
    contact = run.case.scene.contact
    if contact is None:
        return f"{name} (contact not modelled)"
    return f"{name}, contact: {contact.model} at {contact.resolution_mm:g} mm"


def _pressure_map(results: "Results", rows: list[int]) -> PressureMap | None:
    maps = results.maps
    if maps is None or all(row < 0 for row in rows):
        return None
    nothing = np.full(len(maps.points_m), np.nan)
    pressure, gap = (
        np.stack([stored[row] if row >= 0 else nothing for row in rows])
        for stored in (maps.pressure_Pa / MEGAPASCAL, maps.gap_m)
    )
    return PressureMap(maps.points_m, maps.triangles, pressure, gap)


def lattice_lines(case: Case) -> Array:
    """Return the edges (s, 2, 3) m of the lattice's outer cell faces, insert frame.

    The grid is the lattice models' at the scene's resolution, whichever model was run; without
    [contact] there is none.

    Raises:
        InputError: the insert cannot be meshed.
    """
    if case.scene.contact is None or case.insert is None:
        return np.empty((0, 2, 3))
    lattice = build_grid(case.insert, case.scene.contact.resolution_mm * MILLIMETRE)
    faces = lattice.cells[:, FACES].reshape(-1, 4)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = faces[first[count == 1]]
    edges = np.stack([outer, np.roll(outer, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.asarray(lattice.nodes[np.unique(np.sort(edges, axis=1), axis=0)])


def readings(results: "Results", axis: HorizontalAxis) -> tuple[Reading, ...]:
    """Return the lines of numbers; what no frame has is left out."""
    weight = body_weight(results)
    hip = np.sqrt(sum(results[f"hip_force_{a}_N"] ** 2 for a in ("ap", "si", "ml")))
    ground = np.sqrt(sum(results[f"ground_reaction_{a}_N"] ** 2 for a in ("ap", "si", "ml")))
    rows = [
        _number("flexion", results["flexion_deg"], "°", 1),
        _direction("adduction", results["adduction_deg"], "varus", "valgus"),
        _direction("axial rotation", results["axial_rotation_deg"], "ext.", "int."),
        _force("contact force", results["force_total_N"], weight),
        _both_sides("· by deformation", results, "{}_force_N", " BW", 2, 1.0 / weight),
        _both_sides("· by equilibrium", results, "{}_force_equilibrium_N", " BW", 2, 1.0 / weight),
        _number("· medial share, deform.", 100 * medial_share(results, "deformation"), " %", 0),
        _number("· medial share, equil.", 100 * medial_share(results, "equilibrium"), " %", 0),
        _both_sides("peak pressure", results, "{}_peak_pressure_MPa", " MPa", 1),
        _both_sides("contact area", results, "{}_area_mm2", " mm²", 0),
        _force("quadriceps", results["quadriceps_N"], weight),
        _force("patellar ligament", results["patellar_ligament_N"], weight),
        _force("patellofemoral", results["patellofemoral_N"], weight),
        _force("hip", hip, weight),
        _force("ground reaction", ground, weight),
    ]
    time = tuple(f"{t:.2f} s" for t in results["time_s"])
    shown = [row for row in rows if any(value != "–" for value in row.values)]
    return (Reading("time", time), *shown)


def frame_labels(axis: HorizontalAxis) -> tuple[str, ...]:
    """Return where in the motion each frame is, in words."""
    words = {"flexion": "{} of flexion", "cycle": "{} of the cycle", "time": "{}"}[axis.kind]
    return tuple(words.format(axis.at(k)) for k in range(len(axis.values)))


def _number(name: str, values: Array, unit: str, digits: int) -> Reading:
    return Reading(name, tuple(_text(value, unit, digits) for value in values))


def _force(name: str, values: Array, weight: float) -> Reading:
    return Reading(
        name,
        tuple(
            f"{value / weight:.2f} BW ({value:.0f} N)" if np.isfinite(value) else "–"
            for value in values
        ),
    )


def _direction(name: str, angles: Array, positive: str, negative: str) -> Reading:
    """Return angles without a sign, with the word for their direction."""
    words = (positive if angle >= 0 else negative for angle in np.round(angles, 1))
    return Reading(
        name,
        tuple(
            f"{abs(angle):.1f}° {word}" if np.isfinite(angle) else "–"
            for angle, word in zip(angles, words, strict=True)
        ),
    )


def _both_sides(
    name: str, results: "Results", pattern: str, unit: str, digits: int, scale: float = 1.0
) -> Reading:
    """Return medial and lateral values in one line."""
    medial, lateral = (scale * results[pattern.format(side)] for side in ("medial", "lateral"))
    return Reading(
        name,
        tuple(
            f"M {_text(m, '', digits)} · L {_text(x, '', digits)}{unit}"
            if np.isfinite(m) or np.isfinite(x)
            else "–"
            for m, x in zip(medial, lateral, strict=True)
        ),
    )


def _text(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f}{unit}".replace("-", "−") if np.isfinite(value) else "–"
