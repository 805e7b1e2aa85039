"""The columns of results.csv in their order, as docs/results.md lists them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Literal

WITHOUT_MUSCLES = "Without [muscles]"
"""Beginning of notes for a scene without [muscles]."""

Kind = Literal["number", "integer", "text"]


@dataclass(frozen=True)
class Column:
    """One column of results.csv.

    Args:
        meaning: one line. Vectors are in the insert frame unless the line names another.
        needs: scene tables without which the column is empty.
        optional: True: a scene without `needs` has no such column. False: it is empty.
    """

    name: str
    meaning: str
    needs: str = ""
    kind: Kind = "number"
    optional: bool = False


_GROUND = "[ground_reaction]"
_IMPLANT = "[implant.femoral], [implant.insert]"
_SLIP = f"{_IMPLANT}; not with [contact] released"
_PRESSED = "[contact]; not with released"
_CONTACT = "[contact]"
_MUSCLE = "[quadriceps], [patellar_ligament], [patella]"
_COUPLED = "[contact] coupling or released"
_POINTS = "[contact] coupling = 'points'"
_FREE = "[contact] released"
_MUSCLES = "[muscles]"
_RECORDED = "[contact] with adduction not released"
_MARKERS = "[motion.markers]"
_ADJUST = "[contact] with adjust = true"
_MEASURED = "[measured]"
_RELEASED_PATELLA = "[patella] released; without it there is no such column"
BUTTON_NEEDS = "[contact.patellofemoral]; without it there is no such column"
_POST = "[contact] post; without it there is no such column"

LIGAMENT = "ligament_<name>_N"
"""Family with a column per [[ligament]], in the scene's order."""
MUSCLE_FORCE = "muscle_<name>_N"
ACTIVATION = "activation_<name>"
RESERVE = "reserve_<coordinate>_Nm"
JOINT_MOMENT = "joint_moment_<coordinate>_Nm"
ENVELOPE = "envelope_<name>"
CONTRIBUTIONS = {side: f"{side}_from_<name>_N" for side in ("medial", "lateral")}
PATELLA_LINE = "patella_line_<name>_N"
"""Family of columns: one per [[patella.ligament]]."""
FAMILIES = (
    PATELLA_LINE,
    *(LIGAMENT, MUSCLE_FORCE, ACTIVATION, RESERVE, JOINT_MOMENT, ENVELOPE),
    *CONTRIBUTIONS.values(),
)
"""Each family has one column per ligament, muscle or coordinate."""

SECONDS = "_seconds"
"""Ending of computing times, which differ from run to run."""

COLUMNS: tuple[Column, ...] = (
    Column("time_s", "time of the frame"),
    Column("flexion_deg", "knee flexion (Grood-Suntay)"),
    Column("adduction_deg", "knee adduction, positive: varus; by equilibrium where released"),
    Column(
        "axial_rotation_deg",
        "positive: the femur rotates externally on the tibia; by equilibrium where released",
    ),
    Column(
        "force_si_N",
        "contact force on the insert along -y, positive in compression; it includes the force on "
        "a modelled post, but no residuals",
    ),
    Column("force_ap_N", "contact force on the insert, insert x"),
    Column("force_ml_N", "contact force on the insert, insert z"),
    Column("force_total_N", "magnitude of the contact force on the insert"),
    Column("force_total_BW", "force_total_N in body weights (mass x 9.80665 m/s²)"),
    Column("medial_force_N", "normal force on the medial condyle, by deformation", _CONTACT),
    Column("lateral_force_N", "normal force on the lateral condyle, by deformation", _CONTACT),
    Column(
        "medial_share_equilibrium",
        "medial / (medial + lateral) of the condylar forces by coronal equilibrium",
    ),
    Column("medial_area_mm2", "area in contact, medial", _CONTACT),
    Column("lateral_area_mm2", "area in contact, lateral", _CONTACT),
    Column(
        "medial_mean_pressure_MPa",
        "magnitude of the resultant contact force on the medial condyle over medial_area_mm2",
        _CONTACT,
    ),
    Column(
        "lateral_mean_pressure_MPa",
        "magnitude of the resultant contact force on the lateral condyle over lateral_area_mm2",
        _CONTACT,
    ),
    Column("medial_peak_pressure_MPa", "largest pressure of the map, medial", _CONTACT),
    Column("lateral_peak_pressure_MPa", "largest pressure of the map, lateral", _CONTACT),
    Column("medial_cop_ap_mm", "medial centre of pressure, insert x", _CONTACT),
    Column("medial_cop_ml_mm", "medial centre of pressure, insert z", _CONTACT),
    Column("lateral_cop_ap_mm", "lateral centre of pressure, insert x", _CONTACT),
    Column("lateral_cop_ml_mm", "lateral centre of pressure, insert z", _CONTACT),
    Column("approach_mm", "travel of the femoral component along -y since first touch", _CONTACT),
    Column("medial_force_equilibrium_N", "normal force on the medial condyle, by equilibrium"),
    Column("lateral_force_equilibrium_N", "normal force on the lateral condyle, by equilibrium"),
    Column("quadriceps_N", "quadriceps tension", _MUSCLE),
    Column(
        "patellar_ligament_N",
        "patellar-ligament tension; [patella] released: resultant of its ligaments to the tibia",
        _MUSCLE,
    ),
    Column("patellofemoral_N", "patellofemoral force along the contact normal", _MUSCLE),
    Column(
        "patellofemoral_tangential_N",
        "patellofemoral force across the contact normal; near zero; [patella] released: zero",
        _MUSCLE,
    ),
    Column("quadriceps_wrap_deg", "angle over which the quadriceps wraps the femur", _MUSCLE),
    Column(
        "quadriceps_per_dome_mm_N",
        "change of quadriceps_N if the button is mounted 1 mm higher on the patella, at the same "
        "pose of the plane patella",
        _MUSCLE,
    ),
    Column(
        "patellofemoral_per_dome_mm_N",
        "change of patellofemoral_N if the button is mounted 1 mm higher",
        _MUSCLE,
    ),
    Column("hip_force_ap_N", "intersegmental force on the femur at the hip, insert x"),
    Column("hip_force_si_N", "the same, insert y"),
    Column("hip_force_ml_N", "the same, insert z"),
    Column("hip_moment_ap_Nm", "intersegmental moment on the femur at the hip, about insert x"),
    Column("hip_moment_si_Nm", "the same, about insert y"),
    Column("hip_moment_ml_Nm", "the same, about insert z"),
    Column("ground_reaction_ap_N", "ground reaction on the foot, insert x", _GROUND),
    Column("ground_reaction_si_N", "the same, insert y", _GROUND),
    Column("ground_reaction_ml_N", "the same, insert z", _GROUND),
    Column(
        "external_flexion_moment_Nm",
        "external moment that flexes the knee, about the femoral ML axis",
        _GROUND,
    ),
    Column(
        "external_adduction_moment_Nm",
        "external moment that adducts the knee, about the floating axis (normal to the femoral "
        "ML and the tibial SI axis); both moments are about the femoral origin",
        _GROUND,
    ),
    Column(LIGAMENT, "tension of the ligament bundle <name>", "[[ligament]]"),
    Column(
        "medial_slip_mm",
        "slip of the medial condyle since the first frame, from arc lengths; the slip that axial "
        "rotation alone would cause is subtracted",
        _SLIP,
    ),
    Column(
        "lateral_slip_mm",
        "slip of the lateral condyle since the first frame, from arc lengths; the slip that axial "
        "rotation alone would cause is subtracted",
        _SLIP,
    ),
    Column("adjust_translation_mm", "femoral adjustment along insert y", _ADJUST),
    Column("adjust_coronal_deg", "femoral adjustment in the coronal plane", _ADJUST),
    Column("adjust_restored", "1: the adjustment was undone after the contact", _ADJUST, "integer"),
    Column("residual_ap_N", "force that equilibrium needs beyond the modelled loads, insert x"),
    Column("residual_ml_N", "the same, insert z"),
    Column(
        "residual_axial_Nm",
        "moment that equilibrium needs beyond the modelled loads, about insert y",
    ),
    Column("medial_area_above_yield", "share of the medial area above the yield stress", _CONTACT),
    Column(
        "lateral_area_above_yield", "share of the lateral area above the yield stress", _CONTACT
    ),
    Column(
        "medial_thickness_mm",
        "thickness of the insert under the medial centre of pressure",
        _CONTACT,
    ),
    Column(
        "lateral_thickness_mm",
        "thickness of the insert under the lateral centre of pressure",
        _CONTACT,
    ),
    Column(
        "condition_number",
        "condition number of the equilibrium equations with scaled columns: the largest factor by "
        "which a relative error of the inputs grows in the solution",
    ),
    Column("body_seconds", "computing time of the rigid-body equations"),
    Column("query_seconds", "computing time of the closest points on the meshes", _IMPLANT),
    Column("contact_seconds", "computing time of the contact", _CONTACT),
    Column("iterations", "iterations of the contact solver", _CONTACT, "integer"),
    Column("status", "ok, or reason words joined by ;", kind="text"),
    Column(
        "cycle_percent",
        "per cent of the cycle; NaN outside the cycle",
        "[motion] cycle_s, [output] cycle_s or two foot strikes",
    ),
    Column(
        "residual_coronal_Nm", "residual moment about insert x, where one condyle has lifted off"
    ),
    Column("residual_flexion_Nm", "residual moment about insert z, where no quadriceps acts"),
    Column(
        "residual_sensitivity_N",
        "largest change of force_total_N when the residuals act 10 mm higher or lower",
    ),
    *(
        Column(f"{side}_{name}_velocity_mm_per_s", meaning.replace("<side>", side), needs)
        for name, meaning, needs in (
            ("slip", "rate of <side>_slip_mm; positive: the femur slides forwards", _SLIP),
            (
                "sliding",
                "forward sliding velocity (insert x) at the <side> contact point: the rigid-body "
                "velocity without the part of axial rotation about the component's centre; "
                "positive: the femur slides forwards",
                _PRESSED,
            ),
            (
                "normal",
                "velocity at which the femur leaves the insert at the <side> contact point; zero: "
                "contact is maintained",
                _PRESSED,
            ),
        )
        for side in ("medial", "lateral")
    ),
    Column("ap_mm", "femoral origin at the pose of the contact, insert x", _CONTACT),
    Column("si_mm", "the same, insert y", _CONTACT),
    Column("ml_mm", "the same, insert z", _CONTACT),
    Column(
        "coupling_iterations",
        "iterations between the equations of the body and the contact until convergence",
        _COUPLED,
        "integer",
    ),
    Column("coupling_change_N", "change of the contact force by the last iteration", _COUPLED),
    Column(
        "coupling_change_mm",
        "largest change of a centre of pressure by the last iteration",
        _POINTS,
    ),
    Column(
        "contact_trials",
        "poses at which contact was evaluated to find the released coordinates",
        _FREE,
        "integer",
    ),
    Column(
        "smallest_stiffness_N_per_mm",
        "smallest stiffness of the equilibrium of the released coordinates; rotations count with "
        "a lever of 25 mm",
        _FREE,
    ),
    Column(
        "adjust_force_change_BW",
        "force_total_BW minus its value at the recorded pose",
        _ADJUST,
    ),
    Column(
        "adjust_share_change",
        "medial_share_equilibrium minus its value at the recorded pose",
        _ADJUST,
    ),
    Column(
        "medial_force_per_adduction_N_per_deg",
        "change of medial_force_N with adduction at constant load; zero while only one condyle "
        "is in contact",
        _RECORDED,
    ),
    Column(
        "split_determined",
        "1: the recorded adduction determines medial_force_N and lateral_force_N. 0: it does not; "
        "either 0.5 deg of adduction shifts more than a quarter of the load, or contact loads one "
        "condyle only, and coronal equilibrium loads both",
        _RECORDED,
        "integer",
    ),
    Column(
        "marker_rms_segments_mm",
        "root mean square residual of the markers of shank and thigh, each segment fitted by "
        "itself",
        _MARKERS,
    ),
    Column(
        "marker_rms_chain_mm",
        "root mean square residual of all markers, the segments joined by the model's joints",
        _MARKERS,
    ),
    Column("flexion_segments_deg", "flexion by fits of single segments, unfiltered", _MARKERS),
    Column("flexion_chain_deg", "flexion by the fit of the jointed segments, unfiltered", _MARKERS),
    Column(
        "knee_centre_distance_mm",
        "distance between the knee centre of the thigh's markers and that of the shank's markers",
        _MARKERS,
    ),
    Column(
        "muscle_lines_turned_deg",
        "rotation of the knee from the pose of the model at which the ends of the muscle lines on "
        "shank and thigh were computed; the direction of a line that wraps errs by up to this "
        "angle",
        _MUSCLES,
    ),
    Column(MUSCLE_FORCE, "force of the muscle <name> of the model", _MUSCLES),
    Column(ACTIVATION, "activation of the muscle <name>, 0 to 1", _MUSCLES),
    Column(
        RESERVE,
        "reserve: moment about <coordinate> that the muscles lack; the knee's reserve acts on the "
        "tibia about insert z, in addition to residual_flexion_Nm",
        _MUSCLES,
    ),
    Column(
        JOINT_MOMENT,
        "moment about <coordinate> of muscles and reserve together; for the knee, the equivalent "
        "moment on the tibia about insert z",
        _MUSCLES,
    ),
    *(
        Column(
            family,
            f"contribution of the muscle <name> to {side}_force_equilibrium_N with fixed pose, "
            "contact points and lines; <name> may also be quadriceps, ligaments or external "
            f"(weight, inertia, ground); the contributions sum to {side}_force_equilibrium_N",
            _MUSCLES,
        )
        for side, family in CONTRIBUTIONS.items()
    ),
    Column(ENVELOPE, "normalised EMG envelope of the muscle <name>", "[muscles.emg]"),
    Column("measured_total_N", "measured axial force, to compare with force_si_N", _MEASURED),
    Column("measured_medial_N", "measured axial force on the medial condyle", _MEASURED),
    Column("measured_lateral_N", "measured axial force on the lateral condyle", _MEASURED),
    *(
        Column(f"button_{name}", meaning, BUTTON_NEEDS, optional=True)
        for name, meaning in (
            (
                "force_N",
                "contact force on the patellar button, magnitude; its vector is patellofemoral_N "
                "along the contact normal, except for a force along a plane patella's z axis",
            ),
            ("medial_force_N", "normal force on the medial facet of the button"),
            ("lateral_force_N", "normal force on the lateral facet of the button"),
            ("area_mm2", "area in contact of the button"),
            ("mean_pressure_MPa", "sum of the facets' forces over button_area_mm2"),
            ("peak_pressure_MPa", "largest pressure of the button's map"),
            ("cop_si_mm", "centre of pressure, superior of the middle of the button's back"),
            ("cop_ml_mm", "centre of pressure, z of the button frame from the same point"),
            ("approach_mm", "travel of the button along its axis since first touch"),
            (
                "imbalance_N",
                "sagittal difference of the contact's force and the patellofemoral force of the "
                "equations, at the patella's pose; zero in exact equilibrium; [patella] released: "
                "force on coordinates that are not released",
            ),
            (
                "thickness_mm",
                "thickness of the button, mean of its facets under their centres of pressure",
            ),
            ("contact_seconds", "computing time of the button's contact"),
        )
    ),
    *(
        Column(f"patella_{name}", meaning, _RELEASED_PATELLA, optional=True)
        for name, meaning in (
            ("ap_mm", "position of the patella's origin in its joint's frame, anterior"),
            ("si_mm", "the same, superior"),
            ("shift_mm", "the same, lateral"),
            ("flexion_deg", "flexion of the patella on the femur, about the femur's ML axis"),
            ("tilt_deg", "tilt, positive: the lateral edge is nearer to the femur"),
            ("rotation_deg", "rotation in its own plane, positive: the superior pole is lateral"),
            ("residual_N", "largest residual force on a released coordinate"),
        )
    ),
    Column(PATELLA_LINE, "tension of the ligament <name> of the patella", "[[patella.ligament]]"),
    *(
        Column(f"post_{name}", meaning, _POST, optional=True)
        for name, meaning in (
            ("force_N", "normal force of the cam on the insert's post, zero without contact"),
            ("force_ap_N", "the same, insert x"),
            ("force_si_N", "the same, along -y"),
            ("force_ml_N", "the same, insert z"),
            ("area_mm2", "area in contact of cam and post"),
            ("peak_pressure_MPa", "largest pressure of cam and post"),
            ("cop_si_mm", "centre of pressure on the post, insert y"),
            ("cop_ml_mm", "the same, insert z"),
            (
                "gap_mm",
                "gap of cam and post along insert x; negative: penetration; empty where the cam "
                "is not behind the post",
            ),
        )
    ),
)

RENAMED = {"softest_N_per_mm": "smallest_stiffness_N_per_mm"}
"""Column of earlier releases -> its present name."""

KINDS: dict[str, Kind] = {column.name: column.kind for column in COLUMNS}


def _ends(family: str) -> tuple[str, str]:
    """Return a family's name before and after the inserted one."""
    return family[: family.index("<")], family[family.index(">") + 1 :]


def belongs(column: str, family: str) -> bool:
    """Return whether a column belongs to a family."""
    before, after = _ends(family)
    inside = len(column) > len(before) + len(after)
    return inside and column.startswith(before) and column.endswith(after)


@cache
def family_column(family: str, name: str) -> str:
    """Return the column of a family for one ligament, muscle or coordinate."""
    before, after = _ends(family)
    return f"{before}{name}{after}"


def name_in(column: str, family: str) -> str:
    """Return the ligament, muscle or coordinate of a family's column."""
    before, after = _ends(family)
    return column.removeprefix(before).removesuffix(after)


def is_ligament(name: str) -> bool:
    """Return whether the column holds a ligament's tension."""
    return belongs(name, LIGAMENT)


def in_a_family(name: str) -> bool:
    """Return whether the column belongs to any family."""
    return any(belongs(name, family) for family in FAMILIES)


@cache
def ligament_column(name: str) -> str:
    """Return the column of the ligament bundle `name`."""
    return family_column(LIGAMENT, name)


def ligament_of(column: str) -> str:
    """Return the bundle of a ligament's column."""
    return name_in(column, LIGAMENT)


def ordered_names(present: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of a file in order, with members of families and optional ones if
    `present` names them.
    """
    present = list(present)
    names: list[str] = []
    for column in COLUMNS:
        if column.name in FAMILIES:
            names.extend(name for name in present if belongs(name, column.name))
        elif column.name in present or not column.optional:
            names.append(column.name)
    return tuple(names)


def columns_as_markdown() -> str:
    """Return the table of columns in docs/results.md."""
    lines = ["| column | meaning | empty without |", "| --- | --- | --- |"]
    for column in COLUMNS:
        lines.append(f"| `{column.name}` | {column.meaning} | {column.needs} |")
    return "\n".join(lines) + "\n"
