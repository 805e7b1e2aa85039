"""A knee on a bench: one pose, an axial load, placement and ligaments changed by hand.

What `tkamb live` computes. A `BenchRequest` is turned into a case that stands still: no muscles,
no patella; the axial load presses along the tibia's long axis through the insert's origin. It is
computed by the same code as a frame of a run, so that the scene which `write_bench` writes gives
the same numbers by `tkamb run`.
"""

import csv
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    inverse,
    knee_coordinates,
    knee_pose,
    pose,
    transform,
)
from tkamb.io.recordings.ground_reaction import GroundReaction
from tkamb.io.recordings.motion import KneeMotion
from tkamb.io.recordings.tibia import BodyMotion
from tkamb.io.scene.case import Case
from tkamb.knee.load import LinkPoint
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament

ROWS = 6
"""Equal rows of the tables: accelerations need as many."""
ANGLES = ("flexion_deg", "adduction_deg", "axial_rotation_deg")
LENGTHS = ("ap_mm", "ml_mm")


@dataclass(frozen=True)
class BenchLimitSettings:
    """How far the sliders of `tkamb live` go."""

    angle_deg: float = 180.0
    """deg; largest angle of the knee that is accepted. Chosen: half a turn."""
    length_mm: float = 60.0
    """mm; largest translation of the knee that is accepted. Chosen: the femur is then beside the
    insert."""
    placement_deg: float = 20.0
    """deg; largest change of a component's orientation. Chosen: no component is placed as far
    off."""
    placement_mm: float = 20.0
    """mm; largest change of a component's position. Chosen: no component is placed as far off."""
    load_N: float = 20_000.0
    """N; largest axial load. Chosen: more than twenty body weights."""
    slack_percent: float = 20.0
    """%; largest change of the ligaments' slack length, either way. Chosen: ligaments of the knee
    rupture at 12 to 20 %."""
    finest_mm: float = 0.5
    """mm; finest map. Chosen: a finer one takes too long to follow a slider."""
    first_penetration: float = 5e-5
    """m; penetration at which a search for released coordinates begins. Chosen: as in
    `initial_pose.first_penetration`."""


BENCH_LIMIT = BenchLimitSettings()


@dataclass(frozen=True)
class Placement:
    """A component moved on its bone, in its own axes: x anterior, y superior, z lateral.

    Args:
        ap_mm: forwards.
        ml_mm: laterally.
        varus_deg: about the anterior axis; positive turns the component into varus.
        rotation_deg: about the superior axis; positive turns it externally.
        slope_deg: about the lateral axis; positive: posterior slope of an insert, flexion of a
            femoral component.
    """

    ap_mm: float = 0.0
    ml_mm: float = 0.0
    varus_deg: float = 0.0
    rotation_deg: float = 0.0
    slope_deg: float = 0.0

    def matrix(self) -> Array:
        """Return pose_moved_in_original (4, 4) of a right knee."""
        turn = Rotation.from_euler(
            "ZXY", [self.slope_deg, -self.varus_deg, -self.rotation_deg], degrees=True
        ).as_matrix()
        return pose(turn, np.array([self.ap_mm, 0.0, self.ml_mm]) * MILLIMETRE)


@dataclass(frozen=True)
class BenchRequest:
    """One state of the bench. Angles and translations are those of a right knee.

    Args:
        flexion_deg: Grood and Suntay's, as `adduction_deg` (varus) and `axial_rotation_deg`
            (femur external).
        ap_mm: of the femoral component in the insert frame, as `ml_mm`.
        load_N: axial, along the tibia, through the insert's origin.
        femoral: placement of the femoral component on the femur.
        tibial: placement of the insert on the tibia.
        slack_percent: change of all ligaments' slack lengths.
        released: coordinates that find their equilibrium.
        contact: name of the contact model; resolution_mm its spacing.
    """

    flexion_deg: float = 0.0
    adduction_deg: float = 0.0
    axial_rotation_deg: float = 0.0
    ap_mm: float = 0.0
    ml_mm: float = 0.0
    load_N: float = 1000.0
    femoral: Placement = field(default_factory=Placement)
    tibial: Placement = field(default_factory=Placement)
    slack_percent: float = 0.0
    released: tuple[str, ...] = ()
    contact: str = "foundation"
    resolution_mm: float = 2.0

    @staticmethod
    def read(values: Mapping[str, Any]) -> "BenchRequest":
        """Return the request that a page's JSON object makes.

        Raises:
            InputError: an unknown key, a value that is no number or out of its range.
        """
        known = {one.name for one in fields(BenchRequest)}
        for key in values:
            if key not in known:
                raise InputError(f"no '{key}' on the bench", None, names_near(key, known))
        made: dict[str, Any] = {}
        for key, value in values.items():
            if key in ("femoral", "tibial"):
                made[key] = _placement(key, value)
            elif key == "released":
                made[key] = _released(value)
            elif key == "contact":
                made[key] = str(value)
            else:
                made[key] = _number(key, value, *_range(key))
        return BenchRequest(**made)

    def coordinates(self) -> Array:
        """Return the six coordinates (6,) m and rad of the original components; si is 0."""
        values = {
            "ap": self.ap_mm * MILLIMETRE,
            "ml": self.ml_mm * MILLIMETRE,
            "axial_rotation": self.axial_rotation_deg * DEGREE,
            "adduction": self.adduction_deg * DEGREE,
            "flexion": self.flexion_deg * DEGREE,
        }
        return np.array([values.get(name, 0.0) for name in KNEE_COORDINATES])


def _range(key: str) -> tuple[float, float]:
    limits = BENCH_LIMIT
    if key in ANGLES:
        return -limits.angle_deg, limits.angle_deg
    if key in LENGTHS:
        return -limits.length_mm, limits.length_mm
    if key == "load_N":
        return 0.0, limits.load_N
    if key == "slack_percent":
        return -limits.slack_percent, limits.slack_percent
    return limits.finest_mm, 10.0


def _number(key: str, value: Any, low: float, high: float) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool)
    if not good or not math.isfinite(value) or not low <= value <= high:
        raise InputError(f"{key} = {value!r}", "bench", f"give {low:g} to {high:g}")
    return float(value)


def _placement(name: str, values: Any) -> Placement:
    known = {one.name for one in fields(Placement)}
    if not isinstance(values, Mapping) or not set(values) <= known:
        raise InputError(f"{name} is no placement", "bench", f"keys: {', '.join(sorted(known))}")
    limits = BENCH_LIMIT
    return Placement(
        **{
            key: _number(
                f"{name}.{key}",
                value,
                *(
                    (-limits.placement_deg, limits.placement_deg)
                    if key.endswith("_deg")
                    else (-limits.placement_mm, limits.placement_mm)
                ),
            )
            for key, value in values.items()
        }
    )


def _released(values: Any) -> tuple[str, ...]:
    known = [name for name in KNEE_COORDINATES if name != "flexion"]
    if not isinstance(values, list | tuple) or not set(values) <= set(known):
        raise InputError("released names no coordinates", "bench", f"of {', '.join(known)}")
    chosen = set(values) | ({"si"} if values else set())
    return tuple(name for name in known if name in chosen)


@dataclass(frozen=True, eq=False)
class Bench:
    """What of a case does not change on the bench.

    Args:
        case: with [contact]; as a run reads it.
        bundles: its ligaments with their slack lengths.
    """

    case: Case
    bundles: "tuple[Ligament, ...]"

    @property
    def shank_weight(self) -> float:
        """Weight (N) of what the axial load carries beside the load itself."""
        mass = self.case.chain.segment("tibia")[0]
        return mass * -float(self.case.chain.model.gravity.linear[1])

    def case_of(self, request: BenchRequest, height: Any = None) -> Case:
        """Return the case that stands still as a request says.

        Args:
            request: the state of the bench.
            height: y (m) of the femoral origin as a function of the pose; None: 0.
        """
        placed = inverse(request.tibial.matrix()) @ knee_pose(request.coordinates())
        placed = placed @ request.femoral.matrix()
        if height is not None:
            placed[1, 3] = height(placed) - BENCH_LIMIT.first_penetration
        coordinates = knee_coordinates(placed)
        scene = self.case.scene
        assert scene.contact is not None
        table = scene.contact.model_copy(
            update={
                "model": request.contact,
                "resolution_mm": request.resolution_mm,
                "released": request.released,
                "coupling": "none",
                "adjust": False,
                "options": scene.contact.options if request.contact == scene.contact.model else {},
            }
        )
        scene = scene.model_copy(
            update={
                "contact": table,
                "patella": None,
                "patellar_ligament": None,
                "quadriceps": None,
                "muscle": (),
                "muscles": None,
                "measured": None,
                "ligament": (),
                "generic_ligaments": None,
            }
        )
        return replace(
            self.case,
            scene=scene,
            motion=_still_motion(coordinates),
            tibia=_upright(),
            ground=self._ground(request),
            patella=None,
            muscles=(),
            patellar_ligament=None,
            measured=None,
            emg=None,
            ligaments=tuple(self._bundle(one, request) for one in self.bundles),
        )

    def _ground(self, request: BenchRequest) -> GroundReaction:
        """Return a vertical force through the insert's origin that leaves the axial load."""
        force = np.array([0.0, request.load_N + self.shank_weight, 0.0])
        point = self.case.chain.insert_in_tibia[:3, 3] * [1.0, 0.0, 1.0]
        return GroundReaction(
            np.tile(force, (ROWS, 1)),
            np.tile(point, (ROWS, 1)),
            np.zeros((ROWS, 3)),
            np.ones(ROWS, bool),
        )

    def _bundle(self, bundle: "Ligament", request: BenchRequest) -> "Ligament":
        """Return a bundle whose ends stayed on the bones while the components moved."""
        return replace(
            bundle,
            proximal=self._end(bundle.proximal, request),
            distal=self._end(bundle.distal, request),
            slack_length=bundle.slack_length * (1.0 + request.slack_percent / 100.0),
            reference_strain=float("nan"),
        )

    def _end(self, end: LinkPoint, request: BenchRequest) -> LinkPoint:
        chain = self.case.chain
        link = chain.carrier(end.link)
        position = transform(chain.link_in(end.link, link), end.position)
        if link == "femur":
            position = transform(inverse(request.femoral.matrix()), position)
        elif link == "tibia":
            insert = chain.insert_in_tibia
            moved = insert @ inverse(request.tibial.matrix()) @ inverse(insert)
            position = transform(moved, position)
        return LinkPoint(link, position)


def _still_motion(coordinates: Array) -> KneeMotion:
    places, nothing = np.tile(coordinates, (ROWS, 1)), np.zeros((ROWS, 6))
    still = np.zeros(ROWS)
    time = np.arange(ROWS, dtype=float)
    return KneeMotion(time, places, nothing, nothing, places, still, still)


def _upright() -> BodyMotion:
    nothing = np.zeros((ROWS, 6))
    return BodyMotion(
        np.arange(ROWS, dtype=float), np.tile(np.eye(4), (ROWS, 1, 1)), nothing, nothing
    )


def write_bench(case: Case, folder: Path) -> Path:
    """Write a case of `Bench.case_of` as a scene that `tkamb run` reads; return the scene file.

    The URDF is copied; meshes are named where they are.

    Args:
        case: a case that stands still.
        folder: an existing folder; its files of these names are replaced.
    """
    scene, side = case.scene, -1.0 if case.scene.patient.side == "left" else 1.0
    places = case.motion.coordinates[0].copy()
    places[KNEE_COORDINATES.index("ml")] *= side
    header = ["time_s", *(f"{name}_m" for name in KNEE_COORDINATES[:3])]
    header += [f"{name}_rad" for name in KNEE_COORDINATES[3:]]
    times = case.motion.time
    _write_table(folder / "motion.csv", header, [[t, *places] for t in times])
    _write_table(folder / "tibia.csv", ["time_s", "lean_rad"], [[t, 0.0] for t in times])
    assert case.ground is not None
    force, point = case.ground.force[0], case.ground.point[0] * [1.0, 1.0, side]
    names = ["time_s", "fx_N", "fy_N", "fz_N", "px_m", "py_m", "pz_m"]
    _write_table(folder / "force.csv", names, [[t, *force, *point] for t in times])
    urdf = scene.patient.urdf.read_text(encoding="utf-8")
    (folder / "patient.urdf").write_text(urdf, encoding="utf-8")
    text = _scene_text(case, side)
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return folder / "scene.toml"


def _write_table(path: Path, header: list[str], rows: list[list[float]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[repr(float(value)) for value in row] for row in rows])


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | Path):
        text = str(value).replace("\\", "\\\\").replace('"', '\\"')
        return f'"{text}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(one) for one in value)}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items())} }}"
    return repr(value)


def _table(name: str, values: Mapping[str, Any]) -> list[str]:
    return [name, *(f"{key} = {_toml(value)}" for key, value in values.items()), ""]


def _scene_text(case: Case, side: float) -> str:
    scene = case.scene
    patient = scene.patient.model_dump(exclude_none=True) | {"urdf": "patient.urdf"}
    lines = ["# Written by `tkamb live`: one pose that stands still under an axial load.", ""]
    lines += _table("[patient]", patient)
    columns = {"time": "time_s"}
    columns |= {name: f"{name}_m" for name in KNEE_COORDINATES[:3]}
    columns |= {name: f"{name}_rad" for name in KNEE_COORDINATES[3:]}
    lines += _table(
        "[motion]",
        {
            "file": "motion.csv",
            "interpretation": "coordinates",
            "angle_unit": "rad",
            "length_unit": "m",
            "cutoff_Hz": "none",
            "columns": columns,
        },
    )
    lines += _table(
        "[tibia]",
        {
            "kind": "sagittal",
            "file": "tibia.csv",
            "columns": {"time": "time_s", "angle": "lean_rad"},
            "angle_unit": "rad",
            "ankle_mm": [0.0, 0.0, 0.0],
        },
    )
    forces = {f"force_{k}": f"f{axis}_N" for k, axis in enumerate("xyz", 1)}
    points = {f"point_{k}": f"p{axis}_m" for k, axis in enumerate("xyz", 1)}
    lines += _table(
        "[ground_reaction]",
        {
            "file": "force.csv",
            "length_unit": "m",
            "cutoff_Hz": "none",
            "columns": {"time": "time_s", **forces, **points},
        },
    )
    for name in ("femoral", "insert"):
        lines += _table(
            f"[implant.{name}]", getattr(scene.implant, name).model_dump(exclude_none=True)
        )
    for bundle in case.ligaments:
        lines += _table("[[ligament]]", _ligament(bundle, side))
    assert scene.contact is not None
    contact = scene.contact.model_dump(exclude_none=True)
    contact = {key: value for key, value in contact.items() if value not in ((), {}, [])}
    lines += _table("[contact]", contact)
    notes = ["One pose that stands still under an axial load, set by hand in `tkamb live`."]
    lines += _table("[output]", {"axis": "time", "notes": notes})
    return "\n".join(lines)


def _ligament(bundle: "Ligament", side: float) -> dict[str, Any]:
    def end(point: LinkPoint) -> dict[str, Any]:
        x, y, z = (float(value) / MILLIMETRE for value in point.position)
        return {"link": point.link, "point_mm": [x, y, side * z]}

    stiffness = (
        {"stiffness_N_per_mm": float(bundle.stiffness) / 1000.0}
        if bundle.law == "two-line"
        else {"stiffness_N_per_strain": float(bundle.stiffness)}
    )
    return {
        "name": bundle.name,
        "proximal": end(bundle.proximal),
        "distal": end(bundle.distal),
        "law": bundle.law,
        **stiffness,
        "slack_length_mm": float(bundle.slack_length) / MILLIMETRE,
    }


def as_values(request: BenchRequest) -> dict[str, Any]:
    """Return a request as a JSON object, as `BenchRequest.read` takes it."""
    return asdict(request)
