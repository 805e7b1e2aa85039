"""Frames in SI into the columns of results.csv."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.case import Case
from tkamb.columns import ligament_column
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.mechanics import FrameLoads
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.equilibrium import FrameContact

NAN = float("nan")

Columns = dict[str, Any]


def tabulate(
    case: Case,
    indices: range,
    body: Sequence[FrameLoads],
    contact: "Sequence[FrameContact]",
    slips: dict[str, Array],
    statuses: Sequence[str],
) -> Columns:
    """Return the columns of results.csv, one entry per frame.

    Args:
        case: the case.
        indices: frames of the motion.
        body: body side of each frame.
        contact: contact side of each frame; empty when not modelled.
        slips: side -> slip (m) since the first frame of the motion, over all its frames.
        statuses: text per frame.
    """
    columns = _motion_columns(case, indices)
    columns |= _collected([_body_row(case, frame) for frame in body])
    for side, slip in slips.items():
        columns[f"{side}_slip_mm"] = slip[list(indices)] / MILLIMETRE
    if contact:
        limit = case.scene.output.yield_stress_MPa * MEGAPASCAL
        columns |= _collected([_contact_row(frame, limit) for frame in contact])
    columns["body_seconds"] = np.array([frame.seconds for frame in body])
    columns["query_seconds"] = np.array([frame.query_seconds for frame in body])
    columns["status"] = list(statuses)
    return columns


def _collected(rows: Sequence[dict[str, float]]) -> Columns:
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, NAN) for row in rows], float) for name in names}


def _motion_columns(case: Case, indices: range) -> Columns:
    motion = case.motion
    chosen = list(indices)
    coordinates = dict(zip(KNEE_COORDINATES, motion.coordinates[chosen].T, strict=True))
    columns = {"time_s": motion.time[chosen]}
    if motion.cycle_percent is not None:
        columns["cycle_percent"] = motion.cycle_percent[chosen]
    for name in ("flexion", "adduction", "axial_rotation"):
        columns[f"{name}_deg"] = coordinates[name] / DEGREE
    return columns


def _body_row(case: Case, frame: FrameLoads) -> dict[str, float]:
    loads, values = frame.loads, frame.loads.values
    on_insert = -loads.contact_force
    total = float(np.linalg.norm(on_insert))
    normal = {side: _normal(frame, side) for side in ("medial", "lateral")}
    row = {
        "force_si_N": -on_insert[1],
        "force_ap_N": on_insert[0],
        "force_ml_N": on_insert[2],
        "force_total_N": total,
        "force_total_BW": total / case.body_weight,
        "medial_force_equilibrium_N": normal["medial"],
        "lateral_force_equilibrium_N": normal["lateral"],
        "medial_share_equilibrium": _share(normal["medial"], normal["lateral"]),
        "quadriceps_wrap_deg": frame.wrap / DEGREE,
        "external_flexion_moment_Nm": loads.external_flexion,
        "external_adduction_moment_Nm": loads.external_adduction,
        "residual_sensitivity_N": loads.sensitivity,
        "condition_number": loads.condition,
    }
    for name in ("quadriceps", "patellar_ligament", "patellofemoral", "patellofemoral_tangential"):
        row[f"{name}_N"] = values.get(name, NAN)
    for axis in ("ap", "si", "ml"):
        row[f"hip_force_{axis}_N"] = values.get(f"hip_force_{axis}", NAN)
        row[f"hip_moment_{axis}_Nm"] = values.get(f"hip_moment_{axis}", NAN)
    row["residual_ap_N"] = values.get("residual_ap", NAN)
    row["residual_ml_N"] = values.get("residual_ml", NAN)
    row["residual_axial_Nm"] = values.get("residual_axial", NAN)
    row["residual_coronal_Nm"] = values.get("residual_coronal", NAN)
    row["residual_flexion_Nm"] = values.get("residual_flexion", NAN)
    if frame.geometry.ground:
        ground = frame.geometry.ground.forces[0]
        row |= {
            f"ground_reaction_{a}_N": g for a, g in zip(("ap", "si", "ml"), ground, strict=True)
        }
    return row | {ligament_column(name): tension for name, tension in frame.tensions.items()}


def _normal(frame: FrameLoads, side: str) -> float:
    if side in frame.loads.lifted and not np.isnan(frame.loads.contact_force).any():
        return 0.0
    return frame.loads.values.get(f"{side}_normal", NAN)


def _share(medial: float, lateral: float) -> float:
    total = medial + lateral
    return medial / total if total > 0 else NAN


def _contact_row(frame: "FrameContact", yield_stress: float) -> dict[str, float]:
    result = frame.result
    row = {
        "approach_mm": result.approach / MILLIMETRE if result else NAN,
        "contact_seconds": frame.seconds,
        "iterations": result.iterations if result else NAN,
    }
    if frame.adjustment:
        row["adjust_translation_mm"] = frame.adjustment.translation / MILLIMETRE
        row["adjust_coronal_deg"] = frame.adjustment.coronal_angle / DEGREE
        row["adjust_restored"] = float(frame.adjustment.restored)
    for side in ("medial", "lateral"):
        row |= _condyle_row(side, frame, yield_stress)
    return row


def _condyle_row(side: str, frame: "FrameContact", limit: float) -> dict[str, float]:
    result = frame.result
    carried = getattr(result, side) if result else None
    if result is not None and carried is None:
        values = {"force_N": 0.0, "area_mm2": 0.0}
    elif carried is None:
        values = {}
    else:
        values = {
            "force_N": carried.force,
            "area_mm2": carried.area / MILLIMETRE**2,
            "mean_pressure_MPa": carried.mean_pressure / MEGAPASCAL,
            "peak_pressure_MPa": carried.peak_pressure / MEGAPASCAL,
            "cop_ap_mm": carried.centre_of_pressure[0] / MILLIMETRE,
            "cop_ml_mm": carried.centre_of_pressure[2] / MILLIMETRE,
            "area_above_yield": frame.area_above(side, limit),
            "thickness_mm": carried.thickness / MILLIMETRE,
        }
    names = (
        "force_N area_mm2 mean_pressure_MPa peak_pressure_MPa cop_ap_mm cop_ml_mm "
        "area_above_yield thickness_mm"
    )
    return {f"{side}_{name}": values.get(name, NAN) for name in names.split()}
