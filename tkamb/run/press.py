"""A press of two meshes at a given pose with a given load (`tkamb press`)."""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.contact.materials import Material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.pressing import check_load
from tkamb.contact.registry import contact_model_in_mm
from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus
from tkamb.errors import InputError
from tkamb.files import read_text
from tkamb.geometry.adjustment import Adjustment, AdjustmentSettings, RestoreRule
from tkamb.geometry.adjustment import adjust as adjusted
from tkamb.geometry.closest import ClosestPointQuery
from tkamb.geometry.condyles import condyle_split, orientation
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import MIRROR, Array, Index, mirrored_pose
from tkamb.geometry.frames import pose as pose_matrix
from tkamb.geometry.memory import peak_rss
from tkamb.geometry.surface import Surface
from tkamb.io import CONTACT_MODEL
from tkamb.io.given_material import (
    material_as_json,
    material_in_words,
    named_material,
)
from tkamb.io.recordings.meshes import axes_rotation, check_same_space, load_surface
from tkamb.knee.adjustment import press_adjusted
from tkamb.run.known_errors import (
    NOT_MEASURED,
    ContactSituation,
    KnownError,
    as_json,
    known_error_words,
    left_out,
    stated_error,
)
from tkamb.units import DEGREE, LENGTH, MEGAPASCAL, MILLIMETRE

# N: largest load. It exceeds a hundred body weights.
MAX_LOAD = 1e5
# rad: largest rotation of the femoral component about the vertical without a note.
# No knee rotates farther.
MAX_TURN = 30.0 * DEGREE
# rad: range of flexion in which the component is upside down. The flexion is estimated from the
# shape, with an error of 10 deg. No knee flexes beyond 160 deg.
UPSIDE_DOWN = (170.0 * DEGREE, 250.0 * DEGREE)
# rad: flexion below which the flange faces the insert and a note is given. No knee
# extends as far.
MIN_FLEXION = -60.0 * DEGREE
# rad: largest angle of the component's medial-lateral axis from the horizontal. No
# knee tilts as far.
MAX_TILT = 45.0 * DEGREE


Side = Literal["right", "left"]

_CONDYLE = (
    "{force_N:8.1f} N {area_mm2:7.1f} mm2  mean {mean_pressure_MPa:5.2f}  "
    "peak {peak_pressure_MPa:5.2f} MPa  centre ({:.1f}, {:.1f}, {:.1f}) mm"
)
_ERRORS_TOLD = ("peak_pressure", "mean_pressure", "area", "approach")


@dataclass(frozen=True, eq=False)
class PressReport:
    """The result of a press, with its computing time and memory.

    Args:
        resolution_mm: spacing of the map points, mm.
        nodes: number of nodes of lattice or mesh; of map points for a model without nodes.
        load: load, N.
        result: contact result in the insert frame (mirrored for a left knee).
        adjustment: femoral adjustment before contact; None: without.
        triangles: indices of neighbouring map points, (k, 3).
        peak_rss_MB: largest resident memory of the process, MB.
        known_error: known error of the contact model at this resolution, or "not measured" with
            the reason.
    """

    contact: str
    resolution_mm: float
    nodes: int
    load: float
    result: ContactResult
    adjustment: Adjustment | None
    triangles: Index
    pair: ContactPair
    side: Side
    prepare_seconds: float
    solve_seconds: float
    peak_rss_MB: float
    known_error: KnownError | str = NOT_MEASURED

    def __repr__(self) -> str:
        """Return a line with contact model, load and result."""
        return (
            f"<tkamb.PressReport: {self.contact} at {self.resolution_mm:g} mm, "
            f"{self.load:g} N; {self.result!r}>"
        )

    @property
    def carried(self) -> bool:
        """Whether the contact carries the load."""
        return self.result.status is ContactStatus.OK

    def write_map(self, path: Path) -> None:
        """Write the pressure map as .vtp: metres, insert frame, z to the subject's right.

        A left knee's is mirrored back to the side of the given meshes.
        """
        from tkamb.io.mesh_files import write_triangles

        result, triangles = self.result, self.triangles
        points, force = result.points, result.nodal_force
        if self.side == "left":
            points, force, triangles = points @ MIRROR, force @ MIRROR, triangles[:, ::-1]
        data = {"pressure_Pa": result.pressure, "gap_m": result.gap, "nodal_force_N": force}
        write_triangles(path, points, triangles, data)

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        result = self.as_dict()
        lines = [
            f"{self.contact} at {self.resolution_mm:g} mm, {self.nodes} nodes: {result['status']}",
            f"load {self.load:g} N, reaction {_text(result['reaction_N'])} N, "
            f"approach {_text(result['approach_mm'])} mm",
            f"material {material_in_words(result['material'])}",
        ]
        for name in ("medial", "lateral"):
            if result[name] is not None:
                lines.append(
                    f"{name:8s}" + _CONDYLE.format(*result[name].pop("cop_mm"), **result[name])
                )
        if self.adjustment is not None:
            adjustment = self.adjustment
            restored = ", recorded rotation restored" if adjustment.restored else ""
            lines.append(
                f"adjusted {adjustment.translation / MILLIMETRE:.3f} mm along y, "
                f"{adjustment.coronal_angle / DEGREE:.3f} deg coronal{restored}"
            )
        lines.append(known_error_words(result["known_error"], _ERRORS_TOLD))
        lines += [f"note: {flag}" for flag in result["flags"]]
        took = f"prepared in {self.prepare_seconds:.3g} s, solved in {self.solve_seconds:.3g} s"
        return [*lines, f"{took}, {self.result.iterations} iterations"]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `tkamb press --json`; None: unknown.

        Vectors are in the insert frame, z to the subject's right for both sides. Only an adjusted
        pose has the key "adjustment".
        """
        result = self.result
        return {
            "contact": self.contact,
            "resolution_mm": self.resolution_mm,
            "nodes": self.nodes,
            "load_N": self.load,
            "reaction_N": _known(-result.wrench_on_insert[1]),
            "approach_mm": _known(result.approach / MILLIMETRE),
            "medial": _condyle(result.medial, self.side),
            "lateral": _condyle(result.lateral, self.side),
            "prepare_seconds": self.prepare_seconds,
            "solve_seconds": self.solve_seconds,
            "peak_rss_MB": self.peak_rss_MB,
            "iterations": result.iterations,
            "residual": _known(result.residual),
            "status": result.status.value,
            "flags": [
                *left_out(self.contact, self.pair.bearing),
                *_naming_remarks(self.pair, result.pose),
                *result.flags,
            ],
            "known_error": as_json(self.known_error),
            "material": material_as_json(self.pair.material),
        } | ({} if self.adjustment is None else {"adjustment": _adjustment(self.adjustment)})


def _naming_remarks(pair: ContactPair, pose: Array) -> list[str]:
    shape = orientation(pair.femoral, pose)
    remarks = []
    if shape is not None and shape.flexion < MIN_FLEXION:
        remarks.append(
            "the flange of the femoral component, not its condyles, faces the insert: check the "
            "axes and the pose"
        )
    elif shape is not None and shape.forward < 0.0 < pose[2, 2]:
        remarks.append(
            "the flange of the femoral component points backward on the insert: check the axes"
        )
    if pair.split is None:
        return [
            *remarks,
            "the femoral component has one condyle: its contact is called medial",
        ]
    turn = abs(math.atan2(pose[0, 2], pose[2, 2]))
    if turn <= MAX_TURN:
        return remarks
    return [
        *remarks,
        f"the pose turns the femoral component by {turn / DEGREE:.0f} deg on the insert: medial "
        "and lateral are the condyles of this component, wherever they lie on the insert",
    ]


def _check_orientation(femoral: Surface, pose: Array, path: str | Path) -> None:
    shape = orientation(femoral, pose)
    if shape is None:
        return
    lowest, highest = UPSIDE_DOWN
    if shape.tilt > MAX_TILT:
        fault = "the femoral component lies on its side: its bone side does not open upward"
    elif lowest < shape.flexion % (2 * math.pi) < highest:
        fault = "the femoral component stands upside down: its bone side faces the insert"
    else:
        return
    raise InputError(fault, path, "check the axes of both meshes, and the pose")


def _adjustment(adjustment: Adjustment) -> dict[str, Any]:
    return {
        "translation_mm": adjustment.translation / MILLIMETRE,
        "coronal_deg": adjustment.coronal_angle / DEGREE,
        "penetration_mm": _known(adjustment.penetration / MILLIMETRE),
        "final_angle_deg": _known(adjustment.final_angle / DEGREE),
        "restore_when": adjustment.settings.restore_when,
        "restored": adjustment.restored,
    }


def _condyle(condyle: CondyleContact | None, side: Side) -> dict[str, Any] | None:
    if condyle is None:
        return None
    to_right = np.array([1.0, 1.0, -1.0 if side == "left" else 1.0])
    return {
        "force_N": condyle.force,
        "area_mm2": condyle.area / MILLIMETRE**2,
        "mean_pressure_MPa": condyle.mean_pressure / MEGAPASCAL,
        "peak_pressure_MPa": condyle.peak_pressure / MEGAPASCAL,
        "cop_mm": (condyle.centre_of_pressure * to_right / MILLIMETRE).tolist(),
    }


def _text(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def press_meshes(
    femoral: str | Path,
    insert: str | Path,
    load: float,
    *,
    units: str = "mm",
    pose: Sequence[float] | None = None,
    contact: str = CONTACT_MODEL,
    resolution_mm: float = 1.0,
    bearing: Bearing = "fixed",
    material: str | Path | Material = "polyethylene",
    axes: str = "+x,+y,+z",
    side: Side = "right",
    adjust: bool = False,
    restore_when: RestoreRule | None = None,
    options: dict[str, Any] | None = None,
) -> PressReport:
    """Press a femoral component into an insert until it carries the load.

    Args:
        femoral: mesh file of the femoral component.
        insert: mesh file of the insert, closed.
        load: load along the normal of the insert's bottom, N.
        units: unit of length of both files and of the pose, "mm", "cm", "m" or "inch".
        pose: pose of the femoral mesh in the axes of the insert's mesh, x, y, z (units), rx, ry, rz
            (deg, intrinsic x-y-z). The height above the insert is not used. None: both files
            share one origin.
        contact: name from `tkamb contact list`.
        resolution_mm: spacing of the map points, mm.
        bearing: "fixed" or "mobile".
        material: name in `tkamb.contact.materials`, path of a .toml file with the keys of
            [material], or a `Material`.
        axes: mesh axes that point anterior, superior and right.
        side: side of the knee. A left knee is computed as its mirror image.
        adjust: whether the femoral component is adjusted before contact
            (`tkamb.geometry.adjustment`). At `pose`, a condyle must be within 3 mm of the insert.
        restore_when: rule of the adjustment to restore the recorded rotation after the press:
            penetration and coronal angle exceed the adjustment ("both", Sharma 2008, the default),
            or one of them does ("either").
        options: options of the contact model.

    Raises:
        InputError: a file, unit, axis, name or load cannot be used, the femoral component is not
            over the insert (with `adjust`: not near it), or `restore_when` is given without
            `adjust`.
    """
    _check_load(load)
    settings = _adjustment_settings(adjust, restore_when)
    model = contact_model_in_mm(contact, resolution_mm, options or {})
    pair, femoral_pose = load_pair(femoral, insert, units, pose, bearing, material, axes, side)
    if not math.isfinite(pair.first_touch_height(femoral_pose)):
        raise InputError(
            "neither condyle lies over the insert",
            femoral,
            "check the pose, the axes and the unit",
        )
    started = time.perf_counter()
    state = model.prepare(pair)
    prepared = time.perf_counter()
    result, adjustment = _press(model, state, load, femoral_pose, settings)
    solved = time.perf_counter()
    return PressReport(
        contact=contact,
        resolution_mm=resolution_mm,
        nodes=state.node_count,
        load=load,
        result=result,
        adjustment=adjustment,
        triangles=state.triangles,
        pair=pair,
        side=side,
        prepare_seconds=prepared - started,
        solve_seconds=solved - prepared,
        peak_rss_MB=peak_rss(),
        known_error=stated_error(
            contact, resolution_mm, pair.material.name, options, ContactSituation.of(result)
        ),
    )


def _check_load(load: float) -> None:
    check_load(load)
    if load > MAX_LOAD:
        most = f"give the force in N, at most {MAX_LOAD:,.0f} N"
        raise InputError(f"{load:g} N is more than any knee carries", "load", most)


def _adjustment_settings(
    adjust: bool, restore_when: RestoreRule | None
) -> AdjustmentSettings | None:
    if restore_when not in (None, *get_args(RestoreRule)):
        raise InputError(
            f"'{restore_when}' is not a rule",
            "restore_when",
            f"one of {', '.join(get_args(RestoreRule))}",
        )
    if not adjust:
        if restore_when is not None:
            raise InputError("needs the femoral adjustment", "restore_when", "give adjust=True too")
        return None
    return (
        AdjustmentSettings()
        if restore_when is None
        else AdjustmentSettings(restore_when=restore_when)
    )


def _press(
    model: ContactModel,
    state: Any,
    load: float,
    femoral_pose: Array,
    settings: AdjustmentSettings | None,
) -> tuple[ContactResult, Adjustment | None]:
    if settings is None:
        return model.press(state, load, femoral_pose), None
    pair: ContactPair = state.pair
    query = ClosestPointQuery(pair.femoral, pair.insert, condyle_split(pair.femoral))
    adjustment = adjusted(query, femoral_pose, settings)
    result, adjustment, _ = press_adjusted(model, state, load, adjustment, query)
    return result, adjustment


def load_pair(
    femoral: str | Path,
    insert: str | Path,
    units: str,
    pose: Sequence[float] | None,
    bearing: Bearing,
    material: str | Path | Material,
    axes: str,
    side: Side,
) -> tuple[ContactPair, Array]:
    """Return femoral component, insert and pose_femoral_in_insert (4, 4); see `press_meshes`."""
    rotation = axes_rotation(axes)
    femoral_pose = mesh_pose(pose, units, rotation)
    if os.path.isfile(femoral) and os.path.isfile(insert):  # `load_surface` names a missing file
        check_same_space(femoral, insert)
    femoral_surface = load_surface(femoral, units, axes, name="femoral")
    insert_surface = load_surface(insert, units, axes, name="insert", closed=True)
    if side == "left":
        femoral_surface, insert_surface = femoral_surface.mirrored(), insert_surface.mirrored()
        femoral_pose = mirrored_pose(femoral_pose)
    elif side != "right":
        raise InputError(f"'{side}' is no side", "side", "give right or left")
    if bearing not in ("fixed", "mobile"):
        raise InputError(f"'{bearing}' is no bearing", "bearing", "give fixed or mobile")
    try:
        in_frame = insert_placement(insert_surface, rotation)
    except InputError as error:
        if orientation(insert_surface, np.eye(4)) is None:
            raise
        raise InputError(
            "has the shape of a femoral component, not of an insert",
            insert,
            "give the femoral component first, then the insert",
        ) from error
    _check_orientation(femoral_surface, in_frame @ femoral_pose, femoral)
    pair = ContactPair(
        femoral_surface, insert_surface.moved(in_frame), named_material(material), bearing
    )
    return pair, in_frame @ femoral_pose


def mesh_pose(pose: Sequence[float] | None, units: str, rotation: Array) -> Array:
    """Return the pose (4, 4) of the femoral mesh in the insert's, in anatomical axes.

    Args:
        pose: x, y, z (units), rx, ry, rz (deg, intrinsic x-y-z) in mesh axes; None: identity.
        rotation: rotation from mesh to anatomical axes, (3, 3).
    """
    if pose is None:
        return np.eye(4)
    values = np.asarray(pose, float)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise InputError("is not six finite numbers", "pose", "give x y z rx ry rz")
    if units not in LENGTH:
        raise InputError(f"unknown unit '{units}'", "units", f"one of {', '.join(LENGTH)}")
    turn = Rotation.from_euler("XYZ", values[3:] * DEGREE).as_matrix()
    return pose_matrix(rotation @ turn @ rotation.T, rotation @ values[:3] * LENGTH[units])


def read_pose(path: str | Path) -> tuple[float, ...]:
    """Read x y z rx ry rz from a text file with blanks, commas or line breaks between them."""
    try:
        words = read_text(path, what="pose file").replace(",", " ").split()
        values = tuple(float(word) for word in words)
    except ValueError as error:
        raise InputError(f"cannot be read ({error})", path, _SIX) from None
    if len(values) != 6:
        raise InputError(f"holds {len(values)} numbers", path, _SIX)
    return values


_SIX = "give a text file of six numbers: x y z (mesh units) rx ry rz (deg)"
