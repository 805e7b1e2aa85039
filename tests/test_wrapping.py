"""Taut paths: analytic lengths, moment arms against finite differences, exact equilibrium."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import inverse, knee_pose, pose, transform
from tkamb.geometry.polygons import convex_outline, sagittal_outline, sagittal_section
from tkamb.geometry.surface import Surface
from tkamb.knee.load import LinkPoint, total_wrench
from tkamb.knee.muscles import Line, Wrap
from tkamb.knee.wrapping import is_inside, taut_path

RADIUS = 0.03
CIRCLE = RADIUS * np.column_stack(
    [np.cos(np.arange(0, 2 * np.pi, 0.002)), np.sin(np.arange(0, 2 * np.pi, 0.002))]
)
FLEXION = np.deg2rad(np.arange(0.0, 140.1, 1.0))


def ellipse(a: float, b: float, n: int = 400) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    return np.column_stack([a * np.cos(angle), b * np.sin(angle)])


def circle_length(start: np.ndarray, end: np.ndarray, radius: float) -> float:
    """Return the geodesic's length on a circular cylinder, clockwise from start to end."""
    a, b = np.linalg.norm(start[:2]), np.linalg.norm(end[:2])
    around = -np.arctan2(start[0] * end[1] - start[1] * end[0], start[:2] @ end[:2])
    sweep = around % (2 * np.pi) - np.arccos(radius / a) - np.arccos(radius / b)
    plane = np.sqrt(a**2 - radius**2) + np.sqrt(b**2 - radius**2) + radius * sweep
    return float(np.hypot(plane, end[2] - start[2]))


def between(link: str, start: list[float], other: str, end: list[float]) -> tuple[LinkPoint, ...]:
    return LinkPoint(link, np.array(start)), LinkPoint(other, np.array(end))


def quadriceps() -> Line:
    """Return a line over a femur with an elliptic outline. The patella is fixed to the insert."""
    return Line(
        "quadriceps",
        (
            LinkPoint("femur", np.array([0.012, 0.2, 0.006])),
            LinkPoint("tibia", np.array([0.05, 0.02, -0.004])),
        ),
        Wrap("femur", ellipse(0.034, 0.03)),
    )


def poses_at(flexion: float) -> dict[str, np.ndarray]:
    pose = knee_pose([0.002 - 0.004 * flexion, 0.03, 0.001, 0.1 * flexion, 0.02, flexion])
    return {"femur": pose, "tibia": np.eye(4)}


def test_length_on_circular_cylinder_is_the_helix() -> None:
    start, end = np.array([0.01, 0.2, 0.02]), np.array([-0.01, -0.06, -0.01])
    path = taut_path(start, end, CIRCLE)
    assert path.length == pytest.approx(circle_length(start, end, RADIUS), rel=1e-6)
    assert path.wrapped
    assert path.points[:, 0].max() == pytest.approx(RADIUS, rel=1e-5)  # in front of the bone


def test_free_path_is_straight() -> None:
    path = taut_path(np.array([0.05, 0.2, 0.0]), np.array([0.04, -0.1, 0.01]), CIRCLE)
    assert not path.wrapped
    assert path.wrap_angle == 0.0


@pytest.mark.parametrize("angle_deg", [-60.0, 0.0, 60.0, 120.0, 170.0, 200.0])
def test_the_string_passes_in_front_and_the_wrap_angle_is_its_turn(angle_deg: float) -> None:
    """The end moves clockwise from above the bone until it is behind the bone."""
    angle = np.pi / 2 - np.deg2rad(angle_deg)
    start = np.array([0.0, 0.2, 0.0])
    end = 0.06 * np.array([np.cos(angle), np.sin(angle), 0.0])
    path = taut_path(start, end, CIRCLE)
    expected = np.deg2rad(angle_deg) - np.arccos(RADIUS / 0.2) - np.arccos(RADIUS / 0.06)
    assert path.wrap_angle == pytest.approx(max(expected, 0.0), abs=3e-3)


def test_the_forces_of_a_unit_tension_add_up_to_zero() -> None:
    for flexion in FLEXION[::20]:
        line = quadriceps()
        path = line.path(poses_at(float(flexion)))
        wrench = total_wrench(line.loads(path), np.array([0.1, -0.2, 0.3]))
        assert np.abs(wrench).max() < 1e-14


def test_the_reaction_presses_on_the_bone_without_friction() -> None:
    points = between("a", [0.0, 0.2, 0.02], "b", [0.0, -0.06, -0.01])
    line = Line("string", points, Wrap("bone", CIRCLE))
    reaction = line.loads(line.path(dict.fromkeys(("a", "b", "bone"), np.eye(4))))[2]
    assert reaction.link == "bone"
    assert np.abs(reaction.forces[:, 2]).max() < 1e-12
    assert (np.sum(reaction.forces * reaction.points, axis=1) < 0.0).all()


def test_the_force_at_a_via_point_acts_on_its_link() -> None:
    """Three segments (the middle one wrapped) agree with a hand calculation. The loads add up to
    zero.
    """
    via = LinkPoint("shank", np.array([0.02, -0.09, 0.01]))
    start, end = between("hip", [-0.03, 0.3, 0.0], "shank", [0.0, -0.3, 0.02])
    origin = LinkPoint("femur", np.array([0.0, 0.2, 0.02]))
    line = Line("string", (start, origin, via, end), Wrap("femur", CIRCLE, segment=1))
    path = line.path(dict.fromkeys(("hip", "femur", "shank"), np.eye(4)))
    around = taut_path(origin.position, via.position, CIRCLE)
    assert around.wrapped
    straight = np.linalg.norm(origin.position - start.position)
    straight += np.linalg.norm(end.position - via.position)
    assert path.length == pytest.approx(around.length + straight)
    assert path.wrap_angle == around.wrap_angle
    loads = line.loads(path)
    assert [load.link for load in loads] == ["hip", "shank", "femur", "shank"]
    along = (end.position - via.position) / np.linalg.norm(end.position - via.position)
    assert loads[3].forces[0] == pytest.approx(along - around.end_direction)
    assert np.abs(total_wrench(loads, np.array([0.1, -0.2, 0.3]))).max() < 1e-14


@pytest.mark.parametrize("coordinate", range(6))
def test_moment_arm_is_derivative_of_length(coordinate: int) -> None:
    """r = dL/dq holds to 1e-5 by central differences over 0-140 deg, with and without wrapping."""
    line, step = quadriceps(), 2e-7
    worst = 0.0
    wrapped = set()
    for flexion in FLEXION:
        q = np.array([0.002 - 0.004 * flexion, 0.03, 0.001, 0.1 * flexion, 0.02, flexion])
        lengths = []
        twists = []
        for sign in (-1.0, 1.0):
            moved = q.copy()
            moved[coordinate] += sign * step
            poses = {"femur": knee_pose(moved), "tibia": np.eye(4)}
            lengths.append(line.path(poses).length)
            twists.append(poses["femur"])
        path = line.path({"femur": knee_pose(q), "tibia": np.eye(4)})
        wrapped.add(path.wrapped)
        pose_rate = (twists[1] - twists[0]) / (2 * step)
        power = 0.0
        for load in line.loads(path):
            if load.link == "femur":
                femur_inverse = np.linalg.inv(knee_pose(q))
                for point, force in zip(load.points, load.forces, strict=True):
                    material = femur_inverse @ np.append(point, 1.0)
                    power += (pose_rate @ material)[:3] @ force
        difference = (lengths[1] - lengths[0]) / (2 * step)
        scale = 0.03 if coordinate > 2 else 1.0
        worst = max(worst, abs(difference + power) / max(abs(difference), scale))
    assert wrapped == {True, False}
    assert worst < 1e-5


def test_moment_arm_has_no_jump_when_wrapping_starts() -> None:
    """At the start of wrapping the flexion moment arm changes as little as in other frames."""
    line = quadriceps()

    def arm(flexion: float) -> float:
        wrench = total_wrench(
            [p for p in line.loads(line.path(poses_at(flexion))) if p.link == "femur"], np.zeros(3)
        )
        return float(wrench[5])

    low, high = 0.0, np.deg2rad(140.0)
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if line.path(poses_at(middle)).wrapped else (middle, high)
    assert not line.path(poses_at(low)).wrapped
    assert line.path(poses_at(high)).wrapped
    assert abs(arm(low) - arm(high)) < 1e-9


def test_a_start_inside_the_outline_is_refused() -> None:
    with pytest.raises(ComputationError, match="inside"):
        taut_path(np.zeros(3), np.array([0.1, 0.0, 0.0]), CIRCLE)


def test_a_point_that_is_nan_is_not_inside_and_has_no_length() -> None:
    for axis in range(2):
        start = np.array([0.0, 0.1, 0.0])
        start[axis] = np.nan
        assert not is_inside(start, CIRCLE)
        assert np.isnan(taut_path(start, np.array([0.0, -0.1, 0.0]), CIRCLE).length)


def test_section_of_a_cylinder_is_its_circle() -> None:
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.08, sections=180)
    surface = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "cylinder")
    cut = sagittal_section(surface, 0.01)
    radius = np.linalg.norm(cut, axis=2)
    assert np.all((radius <= 0.02 + 1e-12) & (radius >= 0.02 * np.cos(np.pi / 180) - 1e-12))
    perimeter = np.linalg.norm(cut[:, 1] - cut[:, 0], axis=1).sum()
    assert perimeter == pytest.approx(2 * np.pi * 0.02, rel=1e-3)


def test_the_outline_is_offset_by_half_of_the_tendon() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    grown = convex_outline(square, 0.1)
    edges = np.roll(grown, -1, axis=0) - grown
    area = 0.5 * (grown[:, 0] * edges[:, 1] - grown[:, 1] * edges[:, 0]).sum()
    assert area == pytest.approx(1.0 + 4 * 0.1 + np.pi * 0.01, rel=1e-4)


def test_the_outline_ends_at_the_given_height() -> None:
    mesh = trimesh.creation.box(extents=(0.02, 0.4, 0.04))
    surface = Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "shaft")
    outline = sagittal_outline([surface], [0.0], offset=0.002, below=0.1)
    assert outline[:, 1].max() == pytest.approx(0.1)
    with pytest.raises(InputError, match="no surface is cut"):
        sagittal_outline([surface], [1.0])


def shipped_lines() -> tuple[Line, Line]:
    """Return quadriceps and patellar ligament of the shipped implant. The ligament's distal end is
    under the insert, unlike in a patient, so that it wraps the insert's lip.
    """
    folder = Path(__file__).parents[1] / "models" / "deep_knee_bend"
    femoral, insert = (
        Surface(np.asarray(mesh.vertices) * 1e-3, np.asarray(mesh.faces), name)
        for name in ("femoral_component", "insert")
        for mesh in [trimesh.load(folder / f"{name}.stl")]
    )
    planes = np.linspace(-0.005, 0.005, 5)
    top = float(femoral.bounds[1, 1])
    quadriceps = Line(
        "quadriceps",
        (
            LinkPoint("femur", np.array([float(femoral.bounds[1, 0]) - 0.012, top + 0.15, 0.004])),
            LinkPoint("patella", np.array([0.01, 0.02, 0.0])),
        ),
        Wrap("femur", sagittal_outline([femoral], planes, 0.003)),
    )
    lip = float(insert.bounds[1, 0])
    ligament = Line(
        "patellar_ligament",
        (
            LinkPoint("patella", np.array([0.008, -0.02, 0.0])),
            LinkPoint("tibia", np.array([lip - 0.02, -0.02, 0.005])),
        ),
        Wrap("tibia", sagittal_outline([insert], planes, 0.002)),
    )
    return quadriceps, ligament


def leg_poses(q: np.ndarray) -> dict[str, np.ndarray]:
    """Return link -> pose from six knee coordinates and three patella coordinates."""
    femur = knee_pose(q[:6])
    c, s = np.cos(q[8]), np.sin(q[8])
    patella = pose([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], [q[6], q[7], 0.002])
    return {"femur": femur, "patella": femur @ patella, "tibia": np.eye(4)}


@pytest.mark.parametrize("which", [0, 1])
def test_moment_arms_of_both_lines_on_the_shipped_knee(which: int) -> None:
    """The generalised force of a unit tension is -dL/dq for all nine coordinates, 0-140 deg."""
    line, step = shipped_lines()[which], 2e-7
    worst, wrapped = 0.0, []
    for degrees in np.arange(0.0, 140.1, 5.0):
        f = np.deg2rad(degrees)
        turn = -0.65 * f
        along = np.array([np.cos(-0.9 * f), np.sin(-0.9 * f)]) * 0.045
        q = np.array([-2e-3 * f, 0.03, 1e-3, 0.08 * f, 0.02, f, along[0], along[1] + 0.005, turn])
        poses = leg_poses(q)
        path = line.path(poses)
        wrapped.append(path.wrapped)
        loads = line.loads(path)
        for k in range(9):
            moved = [q + sign * step * np.eye(9)[k] for sign in (-1.0, 1.0)]
            ends = [leg_poses(m) for m in moved]
            slope = (line.path(ends[1]).length - line.path(ends[0]).length) / (2 * step)
            power = 0.0
            for load in loads:
                rate = (ends[1][load.link] - ends[0][load.link]) / (2 * step)
                local = transform(inverse(poses[load.link]), load.points)
                velocity = local @ rate[:3, :3].T + rate[:3, 3]
                power += float((velocity * load.forces).sum())
            scale = 1.0 if k in (0, 1, 2, 6, 7) else 0.03
            worst = max(worst, abs(slope + power) / max(abs(slope), scale))
    assert len(set(wrapped)) == 2
    assert worst < 1e-5
