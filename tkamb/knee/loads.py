"""Loads of a knee at one instant, in the axes and signs of the user's knee."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array
from tkamb.knee.canonical import Bridge
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solved_unknowns
from tkamb.knee.load import PointForces, scaled
from tkamb.knee.unknowns import MUSCLE, muscle_load

MIRRORED = ("ml", "axial", "coronal")
"""Parts of a load's name that change sign between a left knee and its mirror image: force along
z, moments about y and x. Hip moments are named by their axes."""
NAN = float("nan")


@dataclass(frozen=True, eq=False)
class KneeLoads:
    """Loads of the knee at one instant, SI, in the insert frame; NaN where they have no solution.

    The insert frame is x anterior, y superior, z to the subject's right, for left knees too.

    Args:
        contact_force: (3,) N, of the condyles on the femur, without residuals.
        normal_force: side -> N, of each condyle along its contact normal, by equilibrium.
        quadriceps: N; NaN without an extensor mechanism, as the next three.
        patellar_ligament: N.
        patellofemoral: N, along the contact normal.
        patellofemoral_tangential: N, across it in the sagittal plane.
        ligaments: bundle -> N.
        residuals: what an exact model would make zero: ap, ml (N), axial, and perhaps coronal,
            flexion (N·m), on the tibia.
        hip_force: (3,) N on the femur at the hip centre: all loads that cross the hip.
        hip_moment: (3,) N·m.
        external_flexion: N·m, moment that tends to flex the knee.
        external_adduction: N·m, moment that tends to adduct it.
        condition: condition number of the equations.
        lifted: condyles that carry nothing.
        slack: the extensor mechanism carries nothing.
        ambiguous: other sets of loads, too, have no wrong sign.
        problems: why there is no solution; empty when there is one.
        external_forces: `pin.StdVec_Force`: contact, ligaments and extensor mechanism as found, as
            `fext` of the model. With them and the external loads `pin.rnea` leaves the residuals.
        residual_forces: `pin.StdVec_Force` of the residuals.
        hip_forces: `pin.StdVec_Force` of the loads on the thigh at the hip.
        equations: the solution of the equations, of a right knee.
        geometry: the geometry of the equations.
    """

    contact_force: Array
    normal_force: dict[str, float]
    quadriceps: float
    patellar_ligament: float
    patellofemoral: float
    patellofemoral_tangential: float
    ligaments: dict[str, float]
    residuals: dict[str, float]
    hip_force: Array
    hip_moment: Array
    external_flexion: float
    external_adduction: float
    condition: float
    lifted: frozenset[str]
    slack: bool
    ambiguous: bool
    problems: tuple[str, ...]
    external_forces: Any
    residual_forces: Any
    hip_forces: Any
    equations: SolvedLoads
    geometry: KneeGeometry

    @property
    def contact_total(self) -> float:
        """N, magnitude of the contact force."""
        return float(np.linalg.norm(self.contact_force))

    @property
    def tensions(self) -> dict[str, float]:
        """Muscle and patellar ligament -> N, as `Knee.external_forces` takes them.

        Empty without an extensor mechanism.
        """
        extensor, values = self.geometry.extensor, self.equations.values
        if extensor is None:
            return {}
        values_by_name = {name: values.get(muscle_load(name), NAN) for name in extensor.muscles}
        return values_by_name | {"patellar_ligament": values.get("patellar_ligament", NAN)}


def knee_loads(
    geometry: KneeGeometry, solved: SolvedLoads, friction: float, bridge: Bridge, data: Any
) -> KneeLoads:
    """Return solved loads as those of the user's knee, and what they do to the model's joints.

    Args:
        geometry: the geometry of the equations.
        solved: their solution, of a right knee.
        friction: Coulomb coefficient of the femorotibial contact.
        bridge: to the user's model.
        data: Pinocchio's, with joint placements up to date.
    """
    unknowns = [] if solved.problems else solved_unknowns(geometry, solved, friction)
    groups: dict[str, list[PointForces]] = {"external": [], "residual": [], "hip": []}
    if unknowns:
        groups["external"] += geometry.ligaments
    for unknown in unknowns:
        group = unknown.name.split("_")[0]
        group = group if group in groups else "external"
        groups[group] += scaled(unknown.loads, solved.values[unknown.name])
    forces = {name: bridge.joint_forces(data, group) for name, group in groups.items()}
    is_left = bridge.left
    values = {
        name: -value if is_left and _mirrored(name) else value
        for name, value in solved.values.items()
    }
    force = solved.contact_force * (np.array([1.0, 1.0, -1.0]) if is_left else 1.0)
    value_of, extensor = values.get, geometry.extensor
    return KneeLoads(
        np.asarray(force),
        {
            side: value_of(f"{side}_normal", 0.0 if solved.values else NAN)
            for side in _sides(geometry)
        },
        extensor.tension(values) if extensor else NAN,
        value_of("patellar_ligament", NAN),
        value_of("patellofemoral", NAN),
        value_of("patellofemoral_tangential", NAN),
        dict(geometry.tensions),
        {
            name.removeprefix("residual_"): value
            for name, value in values.items()
            if name.startswith("residual_")
        },
        np.array([value_of(f"hip_force_{axis}", NAN) for axis in ("ap", "si", "ml")]),
        np.array([value_of(f"hip_moment_{axis}", NAN) for axis in ("ap", "si", "ml")]),
        solved.external_flexion,
        solved.external_adduction,
        solved.condition,
        solved.lifted,
        solved.slack,
        solved.ambiguous,
        solved.problems,
        forces["external"],
        forces["residual"],
        forces["hip"],
        solved,
        geometry,
    )


def _sides(geometry: KneeGeometry) -> list[str]:
    return [side for side in SIDES if side in geometry.condyles]


def _mirrored(name: str) -> bool:
    """Say whether a load's magnitude changes sign in the mirror image."""
    if name.startswith(MUSCLE):
        return False
    if "moment" in name:  # about x and y; about z and the clinical axes it keeps its sign
        return name.endswith(("_ap", "_si", "_axial", "_coronal"))
    return name.endswith(MIRRORED)
