"""A run into a drawing: geometry of the scene, forces of results.csv, pressure of the maps."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tkamb.output.axis import horizontal_axis
from tkamb.output.metrics import map_rows
from tkamb.scene.case import Case
from tkamb.units import MEGAPASCAL
from tkamb.view.arrows import contact_markers, force_arrows
from tkamb.view.drawing import Drawing, PressureMap
from tkamb.view.foot import standing
from tkamb.view.lattice_lines import lattice_lines
from tkamb.view.readings import places, readings
from tkamb.view.run import Run
from tkamb.view.solids import solids
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


def draw(run: Run, progress: Progress = lambda frames: frames, lattice: bool = False) -> Drawing:
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
    base, pressed = standing(case, geometries, run.frames)
    bundles, limit = ligament_strands(mechanics, states)
    strands = [*bundles, *extensor_strands(mechanics, states)]
    markers = [*contact_markers(geometries), *pressed]
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
        places=places(axis),
        times=results["time_s"],
        statuses=tuple(results.status),
        readings=readings(results, axis),
        solids=solids(case, mechanics.poses[list(run.frames)], states, maps, rows) + base,
        strands=tuple(strands),
        arrows=force_arrows(results, geometries, contact.friction if contact else 0.0),
        markers=tuple(markers),
        map=_pressure_map(results, rows),
        strain_limit=limit,
        lattice=lattice_lines(case) if lattice else np.empty((0, 2, 3)),
        notes=(*_stand_ins(case, bool(base)), *case.scene.output.notes),
    )


def _stand_ins(case: Case, foot: bool) -> tuple[str, ...]:
    words = STAND_INS.format("Tibia and patella are" if case.bone else "Bones are")
    return (words, FOOT) if foot else (words,)


def _title(run: Run) -> str:
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
