"""The summary of a run: its inputs, versions, assumptions and largest values."""

import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tkamb import __version__
from tkamb.geometry.frames import SIDES
from tkamb.io import texts
from tkamb.io.recordings.gait_cycle import CONTACT_FORCE_N, cycle_percent
from tkamb.io.scene.case import Case
from tkamb.io.scene.scene import Scene
from tkamb.io.scene.tables import ContactTable
from tkamb.run.claims import claims_summary
from tkamb.run.columns import (
    ACTIVATION,
    JOINT_MOMENT,
    RESERVE,
    WITHOUT_MUSCLES,
    belongs,
    family_column,
    name_in,
)
from tkamb.run.discrepancy import discrepancy_summary
from tkamb.run.identity import relative_paths, scene_hash
from tkamb.run.known_errors import NOT_MEASURED, ContactSituation, as_json, left_out, stated_error
from tkamb.run.read_scene import STRAIN_FLEXIONS
from tkamb.run.status import FAILED
from tkamb.settings import changed_settings
from tkamb.units import DEGREE, MILLIMETRE

RESIDUALS = (
    "Residuals are the forces along AP (anterior–posterior) and ML (medial–lateral) and the moment "
    "about the tibia's long axis that equilibrium needs beyond the modelled loads. They act at the "
    "midpoint of the contact points. An exact model has none. Results also contain the largest "
    "change of the total force if they act 10 mm above or below this midpoint."
)


# 1: share of a coordinate's largest moment above which a reserve is counted as large.
# Smaller reserves hardly change muscle forces.
NOTABLE_RESERVE = 0.05
# 1: largest relative difference between longest and shortest time step of a motion with a frame
# rate. Clocks and rounding cause smaller differences.
UNEVEN_SHARE = 0.01


SATURATED = 0.99
"""1: activation above which a muscle counts as saturated."""

LIBRARIES = ("pin", "numpy", "scipy", "trimesh", "python-fcl")


def summary_of(
    case: Case,
    columns: dict[str, Any],
    seconds: dict[str, float],
    path: Path | None,
    strains: Mapping[str, Sequence[float]],
) -> dict[str, Any]:
    """Return the content of summary.json (docs/results.md).

    Args:
        seconds: part of the computation -> computing time, s.
        path: path of the scene file; None: the scene is not from a file.
        strains: ligament bundle -> strains at `STRAIN_FLEXIONS`.
    """
    scene = case.scene
    summary = _origin(case, path) | {"seconds": seconds} | _subject(case) | _counts(columns)
    summary["not_modelled"] = not_modelled(case)
    summary["assumptions"] = assumptions(case)
    summary["notes"] = notes_of(scene)
    tables = scene.model_dump(exclude_none=True, exclude={"output"})
    summary["scene_tables"] = relative_paths(
        tables, None if path is None else path.absolute().parent
    )
    if changed := changed_settings():
        summary["changed_settings"] = changed
    if strains:
        summary["ligament_strain"] = {"flexion_deg": STRAIN_FLEXIONS, "strain": strains}
    if scene.patella:
        summary["first_wrapping_flexion_deg"] = _first_wrapping(columns)
    if scene.muscles:
        summary["reserves"] = reserves(columns)
        summary["saturated_muscles"] = saturated_muscles(columns)
    summary |= claims_summary(columns, case.body_weight)
    summary["measures"] = measures(case, columns)
    if scene.contact or scene.muscles:
        summary["discrepancy"] = discrepancy_summary(summary)
    if case.measured is not None or case.emg is not None:
        from tkamb.run.recorded import compare_recorded

        summary |= compare_recorded(case, columns)
    if scene.contact:
        table = scene.contact
        from tkamb.io.given_material import given_material, material_as_json

        material = given_material(scene.insert_material)
        chosen = material_as_json(material)
        sag = sum(body.facet_sag() for body in (case.femoral, case.insert) if body is not None)
        peak = ContactSituation.of_run(columns, columns["status"], material.poisson_ratio, sag)
        error = stated_error(table.model, table.resolution_mm, material.name, table.options, peak)
        summary["contact"] = table.model_dump(mode="json", exclude={"patellofemoral"})
        if (button := table.patellofemoral) is not None:
            summary["patellofemoral_contact"] = button.model_dump(mode="json") | {
                "known_error": NOT_MEASURED,
                "peak_pressure_MPa": _peak(columns.get("button_peak_pressure_MPa", np.nan)),
            }
        if scene.material is not None:
            del summary["contact"]["material"]  # [material] replaces it
        summary["material"] = chosen
        summary["known_error"] = as_json(error)
        summary["split_not_determined_frames"] = int((columns["split_determined"] == 0).sum())
        summary["residuals"] = RESIDUALS
    if case.motion.cycle_percent is not None:
        percent, time = case.motion.cycle_percent, case.motion.time
        slope = (time[-1] - time[0]) / (percent[-1] - percent[0])
        start = time[0] - percent[0] * slope
        summary["cycle_percent_s"] = [start, start + 100.0 * slope]
    return summary | _gait(case)


def measures(case: Case, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return numbers for a Methods section that are not in the scene.

    - frame rate of an evenly sampled motion;
    - number of triangles, and median of their longest edges, of each mesh;
    - least and largest thickness of the insert below the centres of pressure;
    - tolerances of the contact solver.

    Unknown numbers are missing.
    """
    time = case.motion.time
    result: dict[str, Any] = {}
    steps = np.diff(time)
    if len(steps) and steps.max() < (1.0 + UNEVEN_SHARE) * steps.min():
        result["frame_rate_Hz"] = float(1.0 / steps.mean())
    surfaces = {"femoral": case.femoral, "insert": case.insert, "patella": case.patella}
    result["meshes"] = {
        name: {
            "triangles": len(surface.faces),
            "edge_mm": float(np.median(surface.longest_edges)) / MILLIMETRE,
        }
        for name, surface in surfaces.items()
        if surface is not None
    }
    if case.scene.contact is not None:
        result |= _thickness(columns) | {"tolerances": _tolerances(case.scene.contact)}
    return result


def _thickness(columns: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the range of the insert's thickness below the centres of pressure, mm."""
    sides = [columns[f"{side}_thickness_mm"] for side in SIDES]
    thickness = np.concatenate(sides).astype(float)
    thickness = thickness[np.isfinite(thickness)]
    if not len(thickness):
        return {}
    return {"insert_thickness_mm": [float(thickness.min()), float(thickness.max())]}


def _tolerances(table: ContactTable) -> dict[str, float]:
    """Return a built-in model's relative tolerances; empty for a plug-in."""
    if table.model in ("foundation", "foundation-linear"):
        from tkamb.contact.pressing import PRESS

        return {"load": PRESS.load_tolerance}
    if table.model not in ("lattice", "lattice-linear", "fe"):
        return {}
    from tkamb.contact.lattice.model import CellContact
    from tkamb.contact.registry import contact_model_in_mm

    model = contact_model_in_mm(table.model, table.resolution_mm, table.options)
    assert isinstance(model, CellContact)
    settings = model.settings
    return {"force": settings.force_tolerance, "gap": settings.gap_tolerance}


def _gait(case: Case) -> dict[str, Any]:
    inputs: dict[str, Any] = {}
    cycle = case.gait_cycle_s
    if cycle is None and case.motion.cycle_percent is None and case.scene.output.axis == "cycle":
        # Without a known cycle the whole motion is one, even if only some frames are computed.
        cycle = (float(case.motion.time[0]), float(case.motion.time[-1]))
    if cycle is not None:
        inputs["cycle_percent_s"] = list(cycle)
    gait = None if case.ground is None else case.ground.gait
    if (
        gait is None
        or not gait.foot_strikes + gait.toe_offs
        or case.motion.cycle_percent is not None
    ):
        return inputs
    toe_offs = [] if cycle is None else [off for off in gait.toe_offs if cycle[0] < off < cycle[1]]
    inputs["gait"] = {
        "foot_strike_s": gait.foot_strikes,
        "toe_off_s": gait.toe_offs,
        "stance_s": gait.spans(),
        "threshold_N": CONTACT_FORCE_N,
        "toe_off_percent": [
            float(cycle_percent(np.array(off), cycle)) for off in toe_offs if cycle
        ],
    }
    return inputs


def notes_of(scene: Scene) -> list[str]:
    """Return the scene's notes, without those on missing [muscles] if it has them."""
    return [
        note
        for note in scene.output.notes
        if scene.muscles is None or not note.startswith(WITHOUT_MUSCLES)
    ]


def _origin(case: Case, path: Path | None) -> dict[str, Any]:
    return {
        "scene": None if path is None else str(path.absolute()),
        "scene_sha256": scene_hash(case.scene),
        "overrides": case.scene.overrides,
        "preset": None if case.scene.preset is None else case.scene.preset.as_dict(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(["tkamb", *sys.argv[1:]]),
        "versions": _versions(),
    }


def _subject(case: Case) -> dict[str, Any]:
    patient, output = case.scene.patient, case.scene.output
    words = "lateral (a left knee, computed as its mirror image)"
    lateral = words if patient.side == "left" else "right (lateral)"
    return {
        "side": patient.side,
        "frame": f"insert frame: x anterior, y superior, z {lateral}",
        "body_mass_kg": case.body_mass,
        "height_mm": case.height_mm,
        "yield_stress_MPa": case.scene.yield_stress_MPa,
        "axis": output.axis,
        "activity": output.activity,
        "licence": output.licence,
    }


def _counts(columns: dict[str, Any]) -> dict[str, Any]:
    statuses, times = columns["status"], columns["time_s"]
    return {
        "frames": len(statuses),
        "failed_frames": [
            {"frame": k, "time_s": float(times[k]), "status": status}
            for k, status in enumerate(statuses)
            if status.startswith(FAILED)
        ],
        "flagged_frames": sum(s != "ok" and not s.startswith(FAILED) for s in statuses),
        "peak_force_total_BW": _peak(columns["force_total_BW"]),
    }


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    versions = {"python": sys.version.split()[0], "tkamb": __version__}
    return versions | {name: version(name) for name in LIBRARIES}


def not_modelled(case: Case) -> list[str]:
    """Return the parts of a knee that the scene does not model."""
    scene = case.scene
    parts = {
        "ground reaction": scene.ground_reaction,
        "ligaments": scene.ligament or scene.generic_ligaments,
        "quadriceps, patella and patellar ligament": scene.patella,
        "femorotibial contact": scene.contact,
    }
    return [name for name, part in parts.items() if not part]


def assumptions(case: Case) -> list[str]:
    """Return the assumptions of a run as sentences (`assets/assumptions.txt`)."""
    scene, insert = case.scene, case.scene.implant.insert
    has_bearing = scene.contact is not None and insert is not None
    return texts.lines(
        "tkamb.run",
        "assumptions.txt",
        scene=scene,
        preset=[] if scene.preset is None else scene.preset.sentences(),
        level_assumed=case.ground is not None and case.ground.level_assumed,
        unrecorded=case.motion.unrecorded,
        markers=_marker_facts(case) if case.motion.markers else None,
        emg=scene.muscles.emg.sentence if scene.muscles and scene.muscles.emg else "",
        bearing=left_out(scene.contact.model, insert.bearing) if has_bearing else (),  # type: ignore[union-attr]
        post=case.post is not None,
    )


def _marker_facts(case: Case) -> dict[str, Any]:
    markers = case.motion.markers
    assert markers is not None and case.scene.motion.markers is not None
    time = case.motion.time
    distance = markers.at(np.nan_to_num(markers.centre_distance), time).max() / MILLIMETRE
    difference = np.abs(markers.flexion["segments"] - markers.flexion["chain"])
    return {
        "names": case.scene.motion.markers.coordinates,
        "method": markers.method,
        "distance": distance,
        "difference": markers.at(np.nan_to_num(difference), time).max() / DEGREE,
    }


def reserves(columns: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return coordinate -> largest reserve, and frames with a large one."""
    result = {}
    for column in columns:
        if not belongs(column, RESERVE):
            continue
        name = name_in(column, RESERVE)
        reserve = np.abs(columns[column])
        moment = np.abs(columns[family_column(JOINT_MOMENT, name)])
        if not np.isfinite(moment).any():
            continue
        largest = float(np.nanmax(moment))
        result[name] = {
            "largest_Nm": float(np.nanmax(reserve)),
            "percent_of_largest_moment": 100.0 * float(np.nanmax(reserve)) / largest,
            "frames_above_5_percent": int((reserve > NOTABLE_RESERVE * largest).sum()),
        }
    return result


def saturated_muscles(columns: Mapping[str, Any]) -> dict[str, int]:
    """Return saturated muscle -> number of frames."""
    result = {}
    for column, values in columns.items():
        if belongs(column, ACTIVATION):
            frames = int((np.asarray(values) > SATURATED).sum())
            if frames:
                result[name_in(column, ACTIVATION)] = frames
    return result


def _first_wrapping(columns: dict[str, Any]) -> float | None:
    """Return the least flexion, deg, of a wrapping quadriceps, or None."""
    flexion = columns["flexion_deg"][columns["quadriceps_wrap_deg"] > 0.0]
    return float(flexion.min()) if len(flexion) else None


def _peak(values: Any) -> float | None:
    return float(np.nanmax(values)) if np.isfinite(values).any() else None
