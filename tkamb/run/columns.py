"""The columns of results.csv: one ordered table, from which the documentation is made too."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

WITHOUT_MUSCLES = "Without [muscles]"
"""How a note begins that holds only while the scene has no table [muscles]; `tkamb import` writes
one."""

Kind = Literal["number", "integer", "text"]


@dataclass(frozen=True)
class Column:
    """One column of results.csv.

    Args:
        name: the column's name in the file, with its unit.
        meaning: one line; vectors are in the insert frame unless the line says otherwise.
        needs: scene tables without which the column is empty.
        kind: how its cells are written.
        optional: whether the column is left out of the file, instead of empty, where it is not
        needed.
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
_POST = "[contact] post; then there is no such column"

LIGAMENT = "ligament_<name>_N"
"""Stands for one column per [[ligament]], in the scene's order."""
MUSCLE_FORCE = "muscle_<name>_N"
ACTIVATION = "activation_<name>"
RESERVE = "reserve_<coordinate>_Nm"
JOINT_MOMENT = "joint_moment_<coordinate>_Nm"
ENVELOPE = "envelope_<name>"
CONTRIBUTIONS = {side: f"{side}_from_<name>_N" for side in ("medial", "lateral")}
FAMILIES = (
    *(LIGAMENT, MUSCLE_FORCE, ACTIVATION, RESERVE, JOINT_MOMENT, ENVELOPE),
    *CONTRIBUTIONS.values(),
)
"""Each stands for one column per ligament, muscle or coordinate."""

COLUMNS: tuple[Column, ...] = (
    Column("time_s", "time of the frame"),
    Column("flexion_deg", "knee flexion (Grood-Suntay)"),
    Column("adduction_deg", "knee adduction, positive: varus; as solved where released"),
    Column(
        "axial_rotation_deg",
        "positive: the femur rotates externally on the tibia; as solved where released",
    ),
    Column(
        "force_si_N",
        "contact force on the insert, a modelled post's among it, no residuals: along -y, "
        "compression > 0",
    ),
    Column("force_ap_N", "the same, insert x"),
    Column("force_ml_N", "the same, insert z"),
    Column("force_total_N", "magnitude of that force"),
    Column("force_total_BW", "the same in body weights (mass x 9.80665 m/s²)"),
    Column("medial_force_N", "normal force on the medial condyle, by deformation", _CONTACT),
    Column("lateral_force_N", "normal force on the lateral condyle, by deformation", _CONTACT),
    Column("medial_share_equilibrium", "medial / (medial + lateral), by coronal equilibrium"),
    Column("medial_area_mm2", "area in contact, medial", _CONTACT),
    Column("lateral_area_mm2", "area in contact, lateral", _CONTACT),
    Column(
        "medial_mean_pressure_MPa",
        "medial force / area: the magnitude of the summed forces over the area",
        _CONTACT,
    ),
    Column(
        "lateral_mean_pressure_MPa",
        "lateral force / area: the magnitude of the summed forces over the area",
        _CONTACT,
    ),
    Column("medial_peak_pressure_MPa", "largest pressure of the map, medial", _CONTACT),
    Column("lateral_peak_pressure_MPa", "largest pressure of the map, lateral", _CONTACT),
    Column("medial_cop_ap_mm", "medial centre of pressure, insert x", _CONTACT),
    Column("medial_cop_ml_mm", "medial centre of pressure, insert z", _CONTACT),
    Column("lateral_cop_ap_mm", "lateral centre of pressure, insert x", _CONTACT),
    Column("lateral_cop_ml_mm", "lateral centre of pressure, insert z", _CONTACT),
    Column("approach_mm", "travel of the femoral component since first touch", _CONTACT),
    Column("medial_force_equilibrium_N", "normal force on the medial condyle, by equilibrium"),
    Column("lateral_force_equilibrium_N", "normal force on the lateral condyle, by equilibrium"),
    Column("quadriceps_N", "quadriceps tension", _MUSCLE),
    Column("patellar_ligament_N", "patellar-ligament tension", _MUSCLE),
    Column("patellofemoral_N", "patellofemoral force along the contact normal", _MUSCLE),
    Column("patellofemoral_tangential_N", "the same across the normal; near zero", _MUSCLE),
    Column("quadriceps_wrap_deg", "angle over which the quadriceps wraps the femur", _MUSCLE),
    Column(
        "quadriceps_per_dome_mm_N",
        "change of quadriceps_N if the button, and its dome, sits 1 mm higher on the patella, "
        "and the patella stays where it is",
        _MUSCLE,
    ),
    Column("patellofemoral_per_dome_mm_N", "the same, of patellofemoral_N", _MUSCLE),
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
        "ML and the tibial SI axis); both at the femoral origin",
        _GROUND,
    ),
    Column(LIGAMENT, "tension of the ligament bundle <name>", "[[ligament]]"),
    Column(
        "medial_slip_mm",
        "slip of the medial condyle since the first frame, by arc lengths, without what axial "
        "rotation "
        "alone would do",
        _SLIP,
    ),
    Column(
        "lateral_slip_mm",
        "slip of the lateral condyle since the first frame, by arc lengths, without what axial "
        "rotation "
        "alone would do",
        _SLIP,
    ),
    Column("adjust_translation_mm", "femoral adjustment along insert y", _ADJUST),
    Column("adjust_coronal_deg", "femoral adjustment in the coronal plane", _ADJUST),
    Column("adjust_restored", "1: the adjustment was undone after the contact", _ADJUST, "integer"),
    Column("residual_ap_N", "force that balance needs beyond the modelled loads, insert x"),
    Column("residual_ml_N", "the same, insert z"),
    Column("residual_axial_Nm", "moment that balance needs beyond them, about insert y"),
    Column("medial_area_above_yield", "share of the medial area above the yield stress", _CONTACT),
    Column("lateral_area_above_yield", "share of the lateral area above yield", _CONTACT),
    Column("medial_thickness_mm", "insert under the medial centre of pressure", _CONTACT),
    Column("lateral_thickness_mm", "insert under the lateral centre of pressure", _CONTACT),
    Column(
        "condition_number",
        "of the equilibrium system with scaled columns: how much a relative error of the inputs "
        "may grow in the solution",
    ),
    Column("body_seconds", "computing time of the rigid-body equations"),
    Column("query_seconds", "computing time of the closest points on the meshes", _IMPLANT),
    Column("contact_seconds", "computing time of the contact", _CONTACT),
    Column("iterations", "of the contact solver", _CONTACT, "integer"),
    Column("status", "ok, or reason words joined by ;", kind="text"),
    Column(
        "cycle_percent",
        "per cent of the cycle; NaN outside it",
        "[motion] cycle_s, [output] cycle_s or two foot strikes",
    ),
    Column("residual_coronal_Nm", "residual moment about insert x, where one condyle is off"),
    Column("residual_flexion_Nm", "residual moment about insert z, where no quadriceps acts"),
    Column(
        "residual_sensitivity_N",
        "largest change of force_total_N when the residuals act 10 mm higher or lower",
    ),
    *(
        Column(f"{side}_{name}_velocity_mm_per_s", meaning.replace("<side>", side), needs)
        for name, meaning, needs in (
            ("slip", "rate of <side>_slip_mm, by arcs; positive: femur slides forwards", _SLIP),
            ("sliding", "the same by rigid-body velocity at the <side> contact point", _PRESSED),
            ("normal", "<side> contact point leaves the insert; zero: touch is kept", _PRESSED),
        )
        for side in ("medial", "lateral")
    ),
    Column("ap_mm", "femoral origin, insert x, at which the contact holds", _CONTACT),
    Column("si_mm", "the same, insert y", _CONTACT),
    Column("ml_mm", "the same, insert z", _CONTACT),
    Column("coupling_iterations", "iterations until body and contact agreed", _COUPLED, "integer"),
    Column("coupling_change_N", "change of the contact force by the last iteration", _COUPLED),
    Column("coupling_change_mm", "the same, of the centres of pressure", _POINTS),
    Column("contact_trials", "contacts computed to find the released pose", _FREE, "integer"),
    Column(
        "smallest_stiffness_N_per_mm",
        "smallest stiffness of the released pose (lever 25 mm)",
        _FREE,
    ),
    Column(
        "adjust_force_change_BW",
        "force_total_BW less what the equations give at the recorded pose",
        _ADJUST,
    ),
    Column("adjust_share_change", "the same, of medial_share_equilibrium", _ADJUST),
    Column(
        "medial_force_per_adduction_N_per_deg",
        "change of medial_force_N with adduction at constant load, the foundation's tangent, or a "
        "finite difference; zero where one condyle carries all, until the other touches",
        _RECORDED,
    ),
    Column(
        "split_determined",
        "1: the recorded adduction determines medial_force_N and lateral_force_N; 0: not, 0.5 deg "
        "moves more than a quarter of the load, or one condyle carries all and equilibrium "
        "says otherwise",
        _RECORDED,
        "integer",
    ),
    Column(
        "marker_rms_segments_mm",
        "root mean square distance of shank and thigh markers, each segment fitted rigidly",
        _MARKERS,
    ),
    Column("marker_rms_chain_mm", "the same of all segments held together by joints", _MARKERS),
    Column("flexion_segments_deg", "flexion by rigid fits, unfiltered", _MARKERS),
    Column("flexion_chain_deg", "flexion by the chain, unfiltered", _MARKERS),
    Column(
        "knee_centre_distance_mm",
        "distance of the knee centre by the shank's markers from that by the thigh's",
        _MARKERS,
    ),
    Column(
        "muscle_lines_turned_deg",
        "by how much the knee is turned from the model's pose at which the muscles' ends on shank "
        "and thigh were found; they stay on their links, so that lines which wrap err by up to it",
        _MUSCLES,
    ),
    Column(MUSCLE_FORCE, "force of the muscle <name> of the model", _MUSCLES),
    Column(ACTIVATION, "its activation, 0 to 1", _MUSCLES),
    Column(
        RESERVE,
        "moment about <coordinate> that no muscle carries; the knee's acts on the tibia about "
        "insert z, beside residual_flexion_Nm",
        _MUSCLES,
    ),
    Column(
        JOINT_MOMENT,
        "moment about <coordinate> that muscles and reserve carry together; the knee's about the "
        "axis on which contact and patella leave it",
        _MUSCLES,
    ),
    *(
        Column(
            family,
            f"what the muscle <name> adds to {side}_force_equilibrium_N with pose, contact points "
            "and lines held; also of quadriceps, ligaments, external (weight, inertia, ground): "
            "they sum up to it",
            _MUSCLES,
        )
        for side, family in CONTRIBUTIONS.items()
    ),
    Column(ENVELOPE, "normalised EMG envelope of the muscle <name>", "[muscles.emg]"),
    Column("measured_total_N", "axial force that was measured, as force_si_N", _MEASURED),
    Column("measured_medial_N", "the same of the medial condyle", _MEASURED),
    Column("measured_lateral_N", "the same of the lateral condyle", _MEASURED),
    *(
        Column(f"post_{name}", meaning, _POST, optional=True)
        for name, meaning in (
            ("force_N", "normal force of the cam on the insert's post, zero where apart"),
            ("force_ap_N", "the same, insert x"),
            ("force_si_N", "the same, along -y"),
            ("force_ml_N", "the same, insert z"),
            ("area_mm2", "area in contact of cam and post"),
            ("peak_pressure_MPa", "largest pressure there"),
            ("cop_si_mm", "centre of pressure on the post, insert y"),
            ("cop_ml_mm", "the same, insert z"),
            (
                "gap_mm",
                "clearance of cam and post along insert x; negative: they overlap; empty where "
                "the cam is not behind the post",
            ),
        )
    ),
)

RENAMED = {"softest_N_per_mm": "smallest_stiffness_N_per_mm"}
"""Name in results of earlier releases -> name of this release."""

KINDS: dict[str, Kind] = {column.name: column.kind for column in COLUMNS}


def _ends(family: str) -> tuple[str, str]:
    """Return the text before and after the name in the columns of a family."""
    return family[: family.index("<")], family[family.index(">") + 1 :]


def belongs(column: str, family: str) -> bool:
    """Return whether a column is one of a family's."""
    before, after = _ends(family)
    inside = len(column) > len(before) + len(after)
    return inside and column.startswith(before) and column.endswith(after)


def family_column(family: str, name: str) -> str:
    """Return the column of a family that stands for `name`."""
    before, after = _ends(family)
    return f"{before}{name}{after}"


def name_in(column: str, family: str) -> str:
    """Return the name in a family's column."""
    before, after = _ends(family)
    return column.removeprefix(before).removesuffix(after)


def is_ligament(name: str) -> bool:
    """Return whether the column holds a ligament's tension."""
    return belongs(name, LIGAMENT)


def in_a_family(name: str) -> bool:
    """Return whether the column is one of a family's."""
    return any(belongs(name, family) for family in FAMILIES)


def ligament_column(name: str) -> str:
    """Return the column of the ligament bundle `name`."""
    return family_column(LIGAMENT, name)


def ligament_of(column: str) -> str:
    """Return the bundle's name of a ligament column."""
    return name_in(column, LIGAMENT)


def ordered_names(present: Iterable[str]) -> tuple[str, ...]:
    """Return every fixed column in order, with families' and optional ones of `present`."""
    given = list(present)
    names: list[str] = []
    for column in COLUMNS:
        if column.name in FAMILIES:
            names.extend(name for name in given if belongs(name, column.name))
        elif column.name in given or not column.optional:
            names.append(column.name)
    return tuple(names)


def columns_as_markdown() -> str:
    """Return the table of the columns for the documentation."""
    lines = ["| column | meaning | empty without |", "| --- | --- | --- |"]
    for column in COLUMNS:
        lines.append(f"| `{column.name}` | {column.meaning} | {column.needs} |")
    return "\n".join(lines) + "\n"
