"""Rows and columns of results.csv from the frames, which are in SI units."""

from array import array
from collections.abc import Mapping, Sequence
from copy import deepcopy
from sys import intern
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    PATELLA_BODY_COORDINATES,
    SIDES,
    Array,
    knee_coordinates,
)
from tkamb.io.recordings.gait_cycle import cycle_percent
from tkamb.io.scene.case import Case
from tkamb.knee.crossing import condyle_contributions
from tkamb.knee.equations import dome_sensitivity
from tkamb.run.columns import (
    ACTIVATION,
    BUTTON_NEEDS,
    COLUMNS,
    CONTRIBUTIONS,
    JOINT_MOMENT,
    MUSCLE_FORCE,
    PATELLA_LINE,
    RESERVE,
    family_column,
    ligament_column,
)
from tkamb.run.status import FAILED, normal_force, share_by_equilibrium, split_determined
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.cam_post import PostContact
    from tkamb.io.recordings.marker_motion import MarkerKinematics
    from tkamb.knee.button import ButtonPress
    from tkamb.knee.crossing import MuscleShare
    from tkamb.knee.found_patella import FoundPatella
    from tkamb.knee.frame import Frame
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.slip import CondyleSlip
    from tkamb.knee.unknowns import CondylePoint

NAN = float("nan")
WHY_IT_FAILED = (
    *("body_seconds", "query_seconds", "contact_seconds", "condition_number", "contact_trials"),
    *("coupling_iterations", "smallest_stiffness_N_per_mm"),
)
"""Columns of a failed frame with numbers, which show how far it was computed."""

Columns = dict[str, Any]


def frame_row(
    case: Case,
    k: int,
    frame: "Frame",
    slips: "Mapping[str, CondyleSlip]",
    status: str,
) -> dict[str, Any]:
    """Return the row of results.csv of frame k: column -> number, and the status.

    A failed frame has numbers only for its motion and `WHY_IT_FAILED`.

    Args:
        slips: side -> slip in the frames up to k + 1, see `Recording.slips`.
    """
    motion = _motion_row(case, k)
    row = motion | _body_row(case, frame)
    for side, slip in slips.items():
        row |= _slip_row(case, k, side, slip, frame.geometry.condyles.get(side))
    if case.scene.contact is not None and case.scene.contact.patellofemoral is not None:
        row |= button_row(frame.button)
    if case.patella_ligaments:
        row |= patella_row(case.patella_ligaments, frame.patella)
    if frame.pressed:
        row |= _contact_row(frame, case.yield_stress)
        row |= _pose_row(frame)
        row["medial_force_per_adduction_N_per_deg"] = frame.sensitivity * DEGREE
        row["split_determined"] = split_determined(frame)
    row |= {"body_seconds": frame.seconds, "query_seconds": frame.query_seconds}
    if status.startswith(FAILED):
        columns_kept = {*motion, *WHY_IT_FAILED}
        row = {name: value if name in columns_kept else NAN for name, value in row.items()}
    return {name: float(value) for name, value in row.items()} | {"status": status}


class RowTable:
    """The rows of the finished frames, stored as columns of numbers."""

    def __init__(self) -> None:
        self._columns: dict[str, array[float]] = {}
        self._statuses: list[str] = []
        self._row_of: dict[int, int] = {}

    def add(self, frame: int, row: Mapping[str, Any]) -> None:
        """Add the row of a frame (`frame_row`)."""
        count = len(self._row_of)
        for name in row:
            if name not in self._columns and name != "status":
                self._columns[name] = array("d", [NAN]) * count
        for name, column in self._columns.items():
            column.append(row.get(name, NAN))
        self._statuses.append(intern(row["status"]))
        self._row_of[frame] = count

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, frame: object) -> bool:
        return frame in self._row_of

    def columns(self, case: Case, frames: range) -> Columns:
        """Return the columns of results.csv, one entry per frame.

        A frame without a row has its motion, NaN and the status "failed: not computed".
        """
        whole, rest = self, [k for k in frames if k not in self]
        if rest:
            whole = deepcopy(self)
            for k in rest:
                whole.add(k, _motion_row(case, k) | {"status": FAILED + "not computed"})
        places = [whole._row_of[k] for k in frames]
        columns: Columns = {name: np.array(each)[places] for name, each in whole._columns.items()}
        return columns | {"status": [whole._statuses[place] for place in places]}


def _motion_row(case: Case, k: int) -> dict[str, Any]:
    motion = case.motion
    coordinates = dict(zip(KNEE_COORDINATES, motion.coordinates[k], strict=True))
    row = {"time_s": motion.time[k]}
    if motion.cycle_percent is not None:
        row["cycle_percent"] = motion.cycle_percent[k]
    elif case.gait_cycle_s is not None:
        row["cycle_percent"] = float(cycle_percent(motion.time[k], case.gait_cycle_s))
    for name in ("flexion", "adduction", "axial_rotation"):
        row[f"{name}_deg"] = coordinates[name] / DEGREE
    if motion.markers is not None:
        row |= _marker_row(motion.markers, motion.time[k : k + 1])
    if case.measured is not None or case.emg is not None:
        from tkamb.run.recorded import recorded_row

        row |= recorded_row(case, k)
    return row


def _marker_row(markers: "MarkerKinematics", time: Array) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for method in ("segments", "chain"):
        row[f"marker_rms_{method}_mm"] = markers.at(markers.rms[method], time)[0] / MILLIMETRE
        row[f"flexion_{method}_deg"] = markers.at(markers.flexion[method], time)[0] / DEGREE
    row["knee_centre_distance_mm"] = markers.at(markers.centre_distance, time)[0] / MILLIMETRE
    return row


def _body_row(case: Case, frame: "Frame") -> dict[str, float]:
    loads, values, extensor = frame.loads, frame.loads.values, frame.geometry.extensor
    on_insert = -loads.contact_force
    for push in frame.geometry.post[:1]:  # the load on the tibia; the second is on the femur
        on_insert = on_insert + push.forces[0]
    total = float(np.linalg.norm(on_insert))
    normal = {side: normal_force(frame, side) for side in SIDES}
    row = {
        "force_si_N": -on_insert[1],
        "force_ap_N": on_insert[0],
        "force_ml_N": on_insert[2],
        "force_total_N": total,
        "force_total_BW": total / case.body_weight,
        "medial_force_equilibrium_N": normal["medial"],
        "lateral_force_equilibrium_N": normal["lateral"],
        "medial_share_equilibrium": share_by_equilibrium(frame),
        "quadriceps_wrap_deg": (extensor.wrap if extensor else NAN) / DEGREE,
        "quadriceps_N": extensor.tension(values) if extensor else NAN,
        "external_flexion_moment_Nm": loads.external_flexion,
        "external_adduction_moment_Nm": loads.external_adduction,
        "residual_sensitivity_N": loads.sensitivity,
        "condition_number": loads.condition,
    }
    if frame.effect is not None:
        row["adjust_force_change_BW"] = frame.effect.force / case.body_weight
        row["adjust_share_change"] = frame.effect.share
    for name in ("patellar_ligament", "patellofemoral", "patellofemoral_tangential"):
        row[f"{name}_N"] = values.get(name, NAN)
    for axis in ("ap", "si", "ml"):
        row[f"hip_force_{axis}_N"] = values.get(f"hip_force_{axis}", NAN)
        row[f"hip_moment_{axis}_Nm"] = values.get(f"hip_moment_{axis}", NAN)
    row["residual_ap_N"] = values.get("residual_ap", NAN)
    row["residual_ml_N"] = values.get("residual_ml", NAN)
    row["residual_axial_Nm"] = values.get("residual_axial", NAN)
    row["residual_coronal_Nm"] = values.get("residual_coronal", NAN)
    row["residual_flexion_Nm"] = values.get("residual_flexion", NAN)
    friction = case.scene.contact.friction if case.scene.contact else 0.0
    dome = None if loads.problems else dome_sensitivity(frame.geometry, loads, friction)
    for name, slope in zip(("quadriceps", "patellofemoral"), dome or (), strict=False):
        row[f"{name}_per_dome_mm_N"] = slope * MILLIMETRE
    if frame.geometry.ground:
        ground = frame.geometry.ground.forces[0]
        row |= {
            f"ground_reaction_{a}_N": g for a, g in zip(("ap", "si", "ml"), ground, strict=True)
        }
    share = frame.geometry.share
    if share is not None and not loads.problems:
        row |= _muscle_row(share)
        row["muscle_lines_turned_deg"] = share.lines.turned(frame.geometry.state) / DEGREE
        parts = condyle_contributions(frame.geometry, loads, friction)
        for side, causes in parts.items():
            row |= {family_column(CONTRIBUTIONS[side], name): n for name, n in causes.items()}
    return row | {
        ligament_column(name): tension for name, tension in frame.geometry.tensions.items()
    }


def _muscle_row(share: "MuscleShare") -> dict[str, float]:
    row: dict[str, float] = {}
    for family, names, values in (
        (MUSCLE_FORCE, share.muscles, share.force),
        (ACTIVATION, share.muscles, share.activation),
        (RESERVE, share.coordinates, share.reserve),
        (JOINT_MOMENT, share.coordinates, share.moment),
    ):
        row |= {family_column(family, n): float(v) for n, v in zip(names, values, strict=True)}
    return row


def _slip_row(
    case: Case, k: int, side: str, slip: "CondyleSlip", contact: "CondylePoint | None"
) -> dict[str, float]:
    """- Slip and slip rate, from the arcs between successive lowest points (`tkamb.knee.slip`).
    - Sliding velocity: forward rigid-body velocity of the femur's contact point relative to the
      insert, minus the part from axial rotation.
    - Normal velocity: relative velocity of that point along the contact normal. It shows by how
      much the recorded motion violates the contact constraint.
    """
    values = {
        "slip_mm": slip.slip[k],
        "slip_velocity_mm_per_s": slip.slip_velocity(case.motion.time)[k],
    }
    if contact is not None:
        from tkamb.knee.slip import forward_sliding

        assert case.femoral is not None
        centre, motion = case.femoral.bounds.mean(axis=0), case.motion
        values["sliding_velocity_mm_per_s"] = forward_sliding(
            motion.coordinates[k], motion.velocity[k], centre, contact.point
        )
        values["normal_velocity_mm_per_s"] = contact.sliding @ contact.normal
    return {f"{side}_{name}": float(value) / MILLIMETRE for name, value in values.items()}


def _contact_row(frame: "Frame", yield_stress: float) -> dict[str, float]:
    result = frame.contact
    row = {
        "approach_mm": result.approach / MILLIMETRE if result else NAN,
        "contact_seconds": frame.contact_seconds,
        "iterations": result.iterations if result else NAN,
    }
    if frame.adjustment:
        row["adjust_translation_mm"] = frame.adjustment.translation / MILLIMETRE
        row["adjust_coronal_deg"] = frame.adjustment.coronal_angle / DEGREE
        row["adjust_restored"] = float(frame.adjustment.restored)
    for side in SIDES:
        row |= _condyle_row(side, frame, yield_stress)
    return row if frame.post is None else row | _post_row(frame.post)


def _post_row(post: "PostContact") -> dict[str, float]:
    force, centre, factor = post.force, post.centre, NAN if post.problem else 1.0
    return {
        "post_force_N": float(np.linalg.norm(force)),
        "post_force_ap_N": force[0],
        "post_force_si_N": -force[1],
        "post_force_ml_N": force[2],
        "post_area_mm2": factor * post.area / MILLIMETRE**2,
        "post_peak_pressure_MPa": factor * post.peak_pressure / MEGAPASCAL,
        "post_cop_si_mm": centre[1] / MILLIMETRE,
        "post_cop_ml_mm": centre[2] / MILLIMETRE,
        "post_gap_mm": post.gap / MILLIMETRE,
    }


def button_row(press: "ButtonPress | None") -> dict[str, float]:
    """Return the columns of a press of the button; NaN without a contact."""
    names = [each.name.removeprefix("button_") for each in COLUMNS if each.needs == BUTTON_NEEDS]
    values = dict.fromkeys(names, NAN)
    if press is not None:
        values["contact_seconds"] = press.seconds
    if press is not None and press.contact is not None:
        facets = [facet for facet in press.facets.values() if facet is not None]
        force, area = (sum(getattr(f, name) for f in facets) for name in ("force", "area"))
        weights = [facet.force / force for facet in facets]
        centre = sum(w * f.centre_of_pressure for w, f in zip(weights, facets, strict=True))
        values |= {
            "force_N": float(np.linalg.norm(press.on_patella[:3])),
            "area_mm2": area / MILLIMETRE**2,
            "mean_pressure_MPa": force / area / MEGAPASCAL,
            "peak_pressure_MPa": max(f.peak_pressure for f in facets) / MEGAPASCAL,
            "cop_si_mm": centre[0] / MILLIMETRE,
            "cop_ml_mm": centre[2] / MILLIMETRE,
            "approach_mm": press.contact.approach / MILLIMETRE,
            "imbalance_N": press.imbalance,
            "thickness_mm": sum(w * f.thickness for w, f in zip(weights, facets, strict=True))
            / MILLIMETRE,
        }
        for side, facet in press.facets.items():
            values[f"{side}_force_N"] = 0.0 if facet is None else facet.force
    return {f"button_{name}": value for name, value in values.items()}


def patella_row(lines: "Sequence[Ligament]", found: "FoundPatella | None") -> dict[str, float]:
    """Return the columns of a released patella with its ligaments; NaN without an equilibrium."""
    lost = found is None or bool(found.problem)
    balance = None if found is None or lost else found.balance
    places = np.full(6, NAN) if balance is None else balance.coordinates
    row = {"patella_residual_N": NAN if balance is None else balance.residual}
    for name, value in zip(PATELLA_BODY_COORDINATES, places, strict=True):
        is_place = name in ("ap", "si", "shift")
        unit, size = ("mm", MILLIMETRE) if is_place else ("deg", DEGREE)
        row[f"patella_{name}_{unit}"] = value / size
    tensions = found.tensions if found else {}
    for bundle in lines:
        row[family_column(PATELLA_LINE, bundle.name)] = tensions.get(bundle.name, NAN)
    return row


def _pose_row(frame: "Frame") -> dict[str, float]:
    place = knee_coordinates(frame.contact.pose) if frame.contact else np.full(6, NAN)
    named = dict(zip(KNEE_COORDINATES, place.tolist(), strict=True))
    row = {f"{axis}_mm": named[axis] / MILLIMETRE for axis in ("ap", "si", "ml")}
    if frame.iterations:
        row["coupling_iterations"] = frame.iterations
        row["coupling_change_N"] = frame.load_change
    if frame.equilibrium is None:
        return row | {"coupling_change_mm": frame.point_change / MILLIMETRE}
    angles = ("adduction", "axial_rotation")
    return (
        row
        | {f"{angle}_deg": named[angle] / DEGREE for angle in angles}
        | {
            "contact_trials": frame.equilibrium.trials,
            "smallest_stiffness_N_per_mm": frame.equilibrium.balance.smallest_stiffness
            * MILLIMETRE,
        }
    )


def _condyle_row(side: str, frame: "Frame", limit: float) -> dict[str, float]:
    result = frame.contact
    condyle = getattr(result, side) if result else None
    if result is not None and condyle is None:
        values = {"force_N": 0.0, "area_mm2": 0.0}
    elif condyle is None:
        values = {}
    else:
        values = {
            "force_N": condyle.force,
            "area_mm2": condyle.area / MILLIMETRE**2,
            "mean_pressure_MPa": condyle.mean_pressure / MEGAPASCAL,
            "peak_pressure_MPa": condyle.peak_pressure / MEGAPASCAL,
            "cop_ap_mm": condyle.centre_of_pressure[0] / MILLIMETRE,
            "cop_ml_mm": condyle.centre_of_pressure[2] / MILLIMETRE,
            "area_above_yield": frame.area_above(side, limit),
            "thickness_mm": condyle.thickness / MILLIMETRE,
        }
    names = (
        "force_N area_mm2 mean_pressure_MPa peak_pressure_MPa cop_ap_mm cop_ml_mm "
        "area_above_yield thickness_mm"
    )
    return {f"{side}_{name}": values.get(name, NAN) for name in names.split()}
