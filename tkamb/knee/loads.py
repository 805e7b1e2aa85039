"""Loads of a knee at one instant, in the axes of the user's knee."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.geometry.frames import SIDES, Array
from tkamb.knee.canonical import Bridge
from tkamb.knee.equations import KneeGeometry, SolvedLoads, solved_unknowns
from tkamb.knee.load import PointForces, scaled
from tkamb.knee.unknowns import MUSCLE, muscle_load

MIRRORED = ("ml", "axial", "coronal")
"""Endings of the names of loads that change sign in the mirror image: forces along z, moments about
y and x."""
NAN = float("nan")


@dataclass(frozen=True, eq=False)
class KneeLoads:
    """Loads of the knee at one instant, SI, in the insert frame; NaN without a solution.

    The insert frame has x anterior, y superior and z to the patient's right, for left knees too.
    Without an extensor mechanism the four loads from `quadriceps` to `patellofemoral_tangential`
    are NaN.

    Args:
        contact_force: force of the insert on the femur without residuals, (3,), N.
        normal_force: side -> force of the condyle along its contact normal, by equilibrium, N.
        quadriceps: tension of the quadriceps, N.
        patellar_ligament: tension of the patellar ligament, N.
        patellofemoral: patellofemoral force along the contact normal, N.
        patellofemoral_tangential: patellofemoral force across the normal, in the sagittal plane, N.
        ligaments: bundle -> tension, N.
        residuals: loads on the tibia that are zero in an exact model: ap, ml (N), axial and, in
            some load states, coronal and flexion (N·m).
        hip_force: sum of all loads across the hip on the femur, (3,), N.
        hip_moment: moment of these loads about the hip centre, (3,), N·m.
        external_flexion: external moment, positive in flexion, N·m.
        external_adduction: external moment, positive in adduction, N·m.
        condition: condition number of the equations.
        lifted: condyles that carry no load.
        slack: whether the extensor mechanism carries no load.
        ambiguous: whether a second load state also has a solution with all signs right.
        problems: reasons why there is no solution; empty: there is a solution.
        external_forces: `pin.StdVec_Force` of contact, ligaments and extensor mechanism, as `fext`
            of the model. With these and the external loads `pin.rnea` gives the residuals at the
            knee.
        residual_forces: `pin.StdVec_Force` of the residuals.
        hip_forces: `pin.StdVec_Force` of the loads across the hip, on the thigh.
        equations: the solution of the equations of a right knee.
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
    def failed(self) -> bool:
        """Whether there is no solution."""
        return bool(self.problems)

    @property
    def reason(self) -> str:
        """Why there is no solution, in a sentence; empty: there is a solution."""
        return "; ".join(self.problems)

    def __repr__(self) -> str:
        """Return the main forces in two lines."""
        if self.failed:
            return f"<tkamb.KneeLoads: failed: {self.reason}>"
        sides = ", ".join(f"{side} {force:.0f} N" for side, force in self.normal_force.items())
        return (
            f"<tkamb.KneeLoads: contact {self.contact_total:.0f} N ({sides})\n"
            f"  quadriceps {self.quadriceps:.0f} N, patellofemoral {self.patellofemoral:.0f} N>"
        )

    @property
    def contact_total(self) -> float:
        """Magnitude of the contact force, N."""
        return float(np.linalg.norm(self.contact_force))

    @property
    def tensions(self) -> dict[str, float]:
        """Muscle or "patellar_ligament" -> tension, N, as input of `Knee.external_forces`.

        A released patella has the tensions of its heads. The result is empty without an extensor
        mechanism.
        """
        extensor, values = self.geometry.extensor, self.equations.values
        if extensor is None:
            return {}
        if extensor.released is not None and not self.slack:
            return dict(extensor.released.tensions)
        values_by_name = {name: values.get(muscle_load(name), NAN) for name in extensor.muscles}
        return values_by_name | {"patellar_ligament": values.get("patellar_ligament", NAN)}


def knee_loads(
    geometry: KneeGeometry, solved: SolvedLoads, friction: float, bridge: Bridge, data: Any
) -> KneeLoads:
    """Return the solved loads in the axes of the user's knee, and as forces on its joints.

    Args:
        data: Pinocchio data with joint placements up to date.
    """
    unknowns = [] if solved.problems else solved_unknowns(geometry, solved, friction)
    # The first word of an unknown's name is its group. Ligaments are known loads.
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
            for side in SIDES
            if side in geometry.condyles
        },
        extensor.tension(values) if extensor else NAN,
        value_of("patellar_ligament", NAN),
        value_of("patellofemoral", NAN),
        value_of("patellofemoral_tangential", NAN),
        geometry.tensions | _of_patella(geometry, solved),
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


def _of_patella(geometry: KneeGeometry, solved: SolvedLoads) -> dict[str, float]:
    """Return the tensions, N, of a released patella's ligaments."""
    released = None if geometry.extensor is None else geometry.extensor.released
    if released is None or released.found is None or solved.problems:
        return {}
    return dict.fromkeys(released.found.tensions, 0.0) if solved.slack else released.found.tensions


def _mirrored(name: str) -> bool:
    """Return whether a load's magnitude changes sign in the mirror image."""
    if name.startswith(MUSCLE):
        return False
    # Moments about x and y change sign. Moments about z and the clinical axes do not.
    if "moment" in name:
        return name.endswith(("_ap", "_si", "_axial", "_coronal"))
    return name.endswith(MIRRORED)
