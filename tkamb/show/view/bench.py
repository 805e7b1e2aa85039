"""The knee of `tkamb live`: one pose, an axial load, placement and ligaments changed by the user.

A `BenchRequest` becomes a static case without muscles and patella. A released patella is added to
the result (`tkamb.show.view.bench_patella`). The axial load acts along the
tibia's long axis, through the origin of the insert frame of the scene. This line of action is fixed
to the bone, also if the user moves the insert. `tkamb run` gives the same numbers for the scene
that `bench_scene.write_bench` writes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    cross,
    inverse,
    knee_coordinates,
    knee_pose,
    pose,
    transform,
)
from tkamb.io.recordings.ground_reaction import GroundReaction
from tkamb.io.recordings.tibia import BodyMotion
from tkamb.io.scene.case import Case
from tkamb.show.view.bench_scene import ROWS, STILL, still_motion
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.ligaments import Ligament


RANGES = {
    # A scene accepts these angles even if a component is rotated by `PLACEMENT_DEG`, so every state
    # can be saved.
    "flexion_deg": (-20.0, 160.0),
    "adduction_deg": (-20.0, 20.0),
    "axial_rotation_deg": (-60.0, 60.0),
    # The femur is then beside the insert.
    "ap_mm": (-60.0, 60.0),
    "ml_mm": (-60.0, 60.0),
    # Load and weight of the shank together are below the largest force that a scene accepts from a
    # force plate.
    "load_N": (0.0, 15_000.0),
    # Ligaments of the knee rupture at strains of 12 to 20 %.
    "slack_percent": (-20.0, 20.0),
    # The patellar ligament of a weightlifter ruptured at 14.5 kN (Zernicke et al. 1977).
    "quadriceps_N": (0.0, 15_000.0),
    # A finer map cannot follow a slider. The coarsest is the limit in `MapGridSettings`.
    "resolution_mm": (0.5, 10.0),
    # Inserts are sold with 6 to 20 mm.
    "thickness_mm": (4.0, 25.0),
}
"""Ranges of the sliders of `tkamb live`."""
# deg and mm: largest change of a component's orientation and position. Surgical errors are smaller.
PLACEMENT_DEG = PLACEMENT_MM = 20.0
# Number of prepared contact models that stay in memory. A lattice takes 0.1 to 0.5 GB.
KEPT_MODELS = 8
# Number of contact models that are prepared at the same time. The machine must still compute the
# coarse model while a slider moves.
MOST_THREADS = 2
# m: penetration at which a search for released coordinates begins, as `InitialPoseSettings`.
FIRST_PENETRATION = 5e-5


@dataclass(frozen=True)
class Placement:
    """A component moved on its bone, in its own axes: x anterior, y superior, z lateral.

    Args:
        ap_mm: anterior translation, mm.
        ml_mm: lateral translation, mm.
        varus_deg: rotation about the anterior axis, deg; positive is varus.
        rotation_deg: rotation about the superior axis, deg; positive is external.
        slope_deg: rotation about the lateral axis, deg; positive is posterior slope of an insert,
            or flexion of a femoral component.
    """

    ap_mm: float = 0.0
    ml_mm: float = 0.0
    varus_deg: float = 0.0
    rotation_deg: float = 0.0
    slope_deg: float = 0.0

    def matrix(self) -> Array:
        """Return the pose (4, 4) of the moved component in its original axes, for a right knee."""
        turn = Rotation.from_euler(
            "ZXY", [self.slope_deg, -self.varus_deg, -self.rotation_deg], degrees=True
        ).as_matrix()
        return pose(turn, np.array([self.ap_mm, 0.0, self.ml_mm]) * MILLIMETRE)


@dataclass(frozen=True)
class BenchRequest:
    """One state of the bench. Angles and translations are those of a right knee.

    Args:
        flexion_deg: flexion after Grood and Suntay. `adduction_deg` is varus, and
            `axial_rotation_deg` is external rotation of the femur.
        ap_mm: anterior position of the femoral component, insert frame; `ml_mm` is lateral.
        load_N: axial load along the tibia, through the origin of the recorded insert frame, N.
        tibial: placement of the insert on the tibia.
        slack_percent: change of the slack lengths of all ligaments between femur and tibia, %.
        released: names of the coordinates that are found by equilibrium.
        contact: name of the contact model; `resolution_mm` is its spacing.
        thickness_mm: smallest thickness of a parametric insert; None: the insert of the scene.
        quadriceps_N: tension of the quadriceps on a released patella, N; None: no patella.
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
    thickness_mm: float | None = None
    quadriceps_N: float | None = None

    @staticmethod
    def read(values: Mapping[str, Any]) -> "BenchRequest":
        """Return the request of a JSON object from the page."""
        names = {one.name for one in fields(BenchRequest)}
        for key in values:
            if key not in names:
                raise InputError(f"no '{key}' on the bench", None, names_near(key, names))
        arguments: dict[str, Any] = {}
        for key, value in values.items():
            if key in ("femoral", "tibial"):
                arguments[key] = _placement(key, value)
            elif key == "released":
                arguments[key] = _released(value)
            elif key == "contact":
                arguments[key] = str(value)
            elif key in ("thickness_mm", "quadriceps_N") and value is None:
                arguments[key] = None
            else:
                arguments[key] = _number(key, value, *RANGES[key])
        return BenchRequest(**arguments)

    def coordinates(self) -> Array:
        """Return the knee coordinates (6,), m and rad, before components are moved; si is 0."""
        values = {
            "ap": self.ap_mm * MILLIMETRE,
            "ml": self.ml_mm * MILLIMETRE,
            "axial_rotation": self.axial_rotation_deg * DEGREE,
            "adduction": self.adduction_deg * DEGREE,
            "flexion": self.flexion_deg * DEGREE,
        }
        return np.array([values.get(name, 0.0) for name in KNEE_COORDINATES])

    def bones(self, insert_in_tibia: Array) -> dict[str, Array]:
        """Return link -> pose (4, 4) of its bone in the link.

        If the user moves a component, its pose in the link does not change. Instead the bone and
        its attachments move in the opposite direction.

        Args:
            insert_in_tibia: pose of the insert frame in the link "tibia", shape (4, 4).
        """
        tibia = insert_in_tibia @ inverse(self.tibial.matrix()) @ inverse(insert_in_tibia)
        return {"femur": inverse(self.femoral.matrix()), "tibia": tibia}


def _number(key: str, value: Any, low: float, high: float) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool)
    if not good or not low <= value <= high:  # NaN fails this test too
        raise InputError(f"{key} = {value!r:.60}", "bench", f"give {low:g} to {high:g}")
    return float(value)


def _placement(name: str, values: Any) -> Placement:
    names = {one.name for one in fields(Placement)}
    if not isinstance(values, Mapping) or not set(values) <= names:
        raise InputError(f"{name} is no placement", "bench", f"keys: {', '.join(sorted(names))}")
    most = {"deg": PLACEMENT_DEG, "mm": PLACEMENT_MM}
    sizes = {key: most[key.rpartition("_")[2]] for key in values}
    return Placement(
        **{k: _number(f"{name}.{k}", v, -sizes[k], sizes[k]) for k, v in values.items()}
    )


def _released(values: Any) -> tuple[str, ...]:
    names = [name for name in KNEE_COORDINATES if name != "flexion"]
    if not isinstance(values, list | tuple) or any(name not in names for name in values):
        raise InputError("'released' is no list of coordinates", "bench", f"of {', '.join(names)}")
    chosen = set(values) | ({"si"} if values else set())
    return tuple(name for name in names if name in chosen)


@dataclass(frozen=True, eq=False)
class Bench:
    """The parts of a case that no request changes."""

    case: Case
    ligaments: "tuple[Ligament, ...]"

    @cached_property
    def bundles(self) -> "tuple[Ligament, ...]":
        """Return all ligaments, each end given in the link of the bone that it is fixed to."""
        chain = self.case.chain
        links = {link for one in self.ligaments for link in one.links}
        carriers = {link: chain.carrier(link) for link in links}
        placed = {link: (bone, chain.link_in(link, bone)) for link, bone in carriers.items()}
        return tuple(one.on_links(placed) for one in self.ligaments)

    def case_of(self, request: BenchRequest, height: Any = None, like: Case | None = None) -> Case:
        """Return the static case of a request.

        Args:
            height: function of the pose that returns y of the femoral origin at first touch, m.
                The component is placed `first_penetration` below it. None: y follows from si = 0.
            like: case with another insert; None: the case of the scene.
        """
        like = like or self.case
        placed = inverse(request.tibial.matrix()) @ knee_pose(request.coordinates())
        placed = placed @ request.femoral.matrix()
        if height is not None:
            placed[1, 3] = height(placed) - FIRST_PENETRATION
        coordinates = knee_coordinates(placed)
        scene = like.scene
        assert scene.contact is not None
        table = scene.contact.model_copy(
            update={
                "model": request.contact,
                "resolution_mm": request.resolution_mm,
                "released": request.released,
                "coupling": "none",
                "adjust": False,
                "patellofemoral": None,
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
                **STILL,
            }
        )
        return replace(
            like,
            scene=scene,
            motion=still_motion(np.tile(coordinates, (ROWS, 1))),
            tibia=_upright(),
            ground=self._ground(request),
            patella=None,
            muscles=(),
            patellar_ligament=None,
            patella_heads=(),
            patella_ligaments=(),
            measured=None,
            emg=None,
            ligaments=tuple(self._bundle(one, request) for one in self.bundles),
        )

    def _ground(self, request: BenchRequest) -> GroundReaction:
        """Return the ground reaction whose effect at the knee is the axial load.

        Laboratory and tibia have the same axes and origin. The line of the load is fixed to the
        bone. A second force balances the shank's weight. The two forces are returned as their
        resultant at the centre of pressure (y = 0) with its free moment about y.
        """
        chain, moved = self.case.chain, self._bones(request)["tibia"]
        axial = moved[:3, 1] * request.load_N
        mass, centre, _ = chain.segment("tibia")
        weight = -mass * np.array(chain.model.gravity.linear)
        force = axial + weight
        about = cross(transform(moved, chain.insert_in_tibia[:3, 3]), axial) + cross(centre, weight)
        point = np.array([about[2], 0.0, -about[0]]) / force[1]
        moment = about - cross(point, force)
        forces, points, moments = (np.tile(values, (ROWS, 1)) for values in (force, point, moment))
        return GroundReaction(forces, points, moments, np.ones(ROWS, bool))

    def _bones(self, request: BenchRequest) -> dict[str, Array]:
        return request.bones(self.case.chain.insert_in_tibia)

    def _bundle(self, bundle: "Ligament", request: BenchRequest) -> "Ligament":
        moved = self._bones(request)
        return replace(
            bundle.on_links({link: (link, moved.get(link, np.eye(4))) for link in bundle.links}),
            slack_length=bundle.slack_length * (1.0 + request.slack_percent / 100.0),
            reference_strain=float("nan"),
        )


def _upright() -> BodyMotion:
    zeros = np.zeros((ROWS, 6))
    return BodyMotion(np.arange(ROWS, dtype=float), np.tile(np.eye(4), (ROWS, 1, 1)), zeros, zeros)
