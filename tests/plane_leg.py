"""A plane leg of three rods on hinges about z, with the muscles of a test."""

import numpy as np

from tkamb.geometry.frames import pose
from tkamb.io.opensim.model import (
    Body,
    Coordinate,
    Joint,
    JointAxis,
    Linear,
    OpenSimModel,
    OpenSimMuscle,
    Path,
    PathPoint,
)

Z = np.array([0.0, 0.0, 1.0])
THIGH, SHANK = 0.4, 0.42
MASSES = {"pelvis": 10.0, "femur_r": 8.0, "tibia_r": 3.0, "foot_r": 1.0}
COORDINATES = ("hip_flexion_r", "knee_flexion_r", "ankle_flexion_r")


def hinge(name: str, parent: str, child: str, coordinate: str | None, place) -> Joint:
    """Return a joint from a point of the parent to the child's origin.

    The joint is a hinge about z. It is a weld if `coordinate` is None.
    """
    axes = () if coordinate is None else (JointAxis(Z, coordinate, Linear(1.0, 0.0)),)
    kind = "WeldJoint" if coordinate is None else "PinJoint"
    return Joint(name, kind, parent, child, pose(np.eye(3), place), np.eye(4), axes, ())


def muscle(
    name: str, *points: tuple[str, list[float]], force: float = 1000.0, **numbers
) -> OpenSimMuscle:
    """Return a straight muscle through points of bodies."""
    path = Path(
        tuple(PathPoint(f"{name}{k}", b, np.array(p)) for k, (b, p) in enumerate(points)), ()
    )
    values = {
        "optimal_fibre_length_m": 0.1,
        "tendon_slack_length_m": 0.2,
        "pennation_rad": 0.0,
        "max_contraction_velocity": 10.0,
    }
    return OpenSimMuscle(name, "Thelen2003Muscle", path, force, **(values | numbers), enabled=True)


def plane_leg(*muscles: OpenSimMuscle) -> OpenSimModel:
    """Return the leg. The hip is at the pelvis's origin, 1 m above ground's origin.

    Knee and ankle are below the hip if all coordinates are zero.
    """
    inertia = 0.01 * np.eye(3)
    places = {"pelvis": 0.0, "femur_r": -0.2, "tibia_r": -0.2, "foot_r": 0.0}
    bodies = {n: Body(n, m, np.array([0.0, places[n], 0.0]), inertia) for n, m in MASSES.items()}
    joints = (
        hinge("ground_pelvis", "ground", "pelvis", None, [0.0, 1.0, 0.0]),
        hinge("hip_r", "pelvis", "femur_r", COORDINATES[0], [0.0, 0.0, 0.0]),
        hinge("knee_r", "femur_r", "tibia_r", COORDINATES[1], [0.0, -THIGH, 0.0]),
        hinge("ankle_r", "tibia_r", "foot_r", COORDINATES[2], [0.0, -SHANK, 0.0]),
    )
    coordinates = {
        name: Coordinate(name, joint.name, True, 0.0, (-2.0, 2.0), False, False)
        for name, joint in zip(COORDINATES, joints[1:], strict=True)
    }
    return OpenSimModel(
        "plane leg", np.array([0.0, -9.80665, 0.0]), bodies, joints, coordinates,
        (), (), {}, {m.name: m for m in muscles}, {}, {}, {}, (),
    )  # fmt: skip
