"""Loads of tkamb agree with those of free bodies, which are computed from the raw files.

`raw_files`, `raw_leg` and `free_body` use numpy and scipy, but not tkamb. They read scene, URDF,
tables, markers and STL, apply the documented smoothing spline, and fit the shank's markers. They
compute the poses of all segments from the URDF's joints, the accelerations by differences of those
poses, the ground reaction as a wrench, ligament tensions, and the direction of sliding. Their
equations are in the laboratory: 6 for shank with foot, 3 for the patella, 6 for thigh with patella.

tkamb supplies geometry: contact points and normals of condyles and patella, the lines of quadriceps
and patellar ligament, taut paths of wrapped ligaments, unloaded condyles, and whether the
quadriceps is slack. For DM it also supplies the pose of the insert's mesh and the solved positions
of the patella. A line that wraps nothing is compared with the scene's two points.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from free_body import FreeBodies, Lent
from raw_leg import Leg
from shared_trials import two_flexors
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import pose
from tkamb.io.recordings.meshes import axes_rotation, load_surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.ligament_paths import bundle_paths
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.run.read_scene import recording_of

MODELS = Path(__file__).parents[1] / "models"
DATA = Path(__file__).parents[2] / "shared" / "data" / "dm"
SHIPPED, DM = MODELS / "deep_knee_bend" / "scene.toml", MODELS / "dm" / "scene.toml"
SHIPPED_FRAMES = (8, 22, 40, 58, 76, 93)
DM_FRAMES = (2, 5, 9, 12, 14, 16)
"""Frames of 21, one every 5 % of the cycle: contact of both condyles or one, slack quadriceps,
swing."""
FORCE, MOMENT = 1.0, 0.1
"""N and N·m: largest accepted difference between tkamb and the free bodies."""


needs_dm = pytest.mark.skipif(
    not (DATA / "DM.osim").is_file(), reason="subject DM's files (../shared/data/dm) are absent"
)


@pytest.fixture(scope="module")
def shipped():
    case = load_case(load_scene(SHIPPED))
    return Leg(SHIPPED), recording_of(case), case.motion.time


@pytest.fixture(scope="module")
def dm():
    scene = load_scene(DM)
    scene = scene.model_copy(update={"motion": scene.motion.model_copy(update={"frames": 21})})
    case = load_case(scene)
    recording, time = recording_of(case), case.motion.time
    patella = np.array([state.coordinates for state in recording.extensor.states])
    table = scene.implant.insert
    surface = load_surface(table.mesh, table.unit, table.axes, name="insert")
    turn = axes_rotation(table.axes)
    mesh = insert_placement(surface, turn) @ pose(turn, np.zeros(3))
    return Leg(DM, mesh, (time, patella)), recording, time


@pytest.mark.parametrize("k", SHIPPED_FRAMES)
def test_the_shipped_knee_is_in_balance_on_free_bodies(shipped, k):
    leg, recording, time = shipped
    assert_same_loads(leg, recording.loads(k), time[k])


@pytest.mark.parametrize("k", SHIPPED_FRAMES[1::2])
def test_the_shipped_knee_with_muscles_across_it_is_in_balance(shipped, monkeypatch, k):
    leg, recording, time = shipped
    monkeypatch.setattr(recording, "muscles", SharedMuscles(two_flexors(len(time))))
    frame = recording.loads(k)
    assert frame.geometry.share.force[1:].min() > 20.0
    assert_same_loads(leg, frame, time[k])


@needs_dm
@pytest.mark.parametrize("k", DM_FRAMES)
def test_dm_is_in_balance_on_free_bodies(dm, k):
    leg, recording, time = dm
    frame = recording.loads(k)
    bundles = [bundle for bundle in recording.knee.ligaments if bundle.wraps]
    wrapped = {bundle.name: lent_path(bundle, frame) for bundle in bundles}
    assert len(wrapped) == 38
    assert_same_loads(leg, frame, time[k], wrapped)


def lent_path(bundle, frame):
    """Return the length of a wrapped ligament, m, and the ends of its part between the links."""
    poses = {link: frame.geometry.state.pose(link) for link in bundle.links}
    path = bundle_paths([bundle], poses)
    points = path.points[0]
    points = points[[True, *(np.diff(points, axis=0) != 0.0).any(axis=1)]]
    (link,) = {wrap.body for wrap in bundle.wraps}
    # The part on the surface belongs to the surface's link.
    free = points[-2:] if link == bundle.proximal.link else points[:2]
    return float(path.length[0]), *free


def assert_same_loads(leg, frame, t, wrapped=None):
    """Assert that tkamb and the free bodies agree on every common load."""
    assert not frame.loads.problems
    reference = FreeBodies(leg, t, replace(lent(frame), wrapped=wrapped or {})).loads()
    for k, axis in enumerate(("ap", "si", "ml")):
        reference[f"hip_force_{axis}"] = reference["hip_force"][k]
        reference[f"hip_moment_{axis}"] = reference["hip_moment"][k]
    del reference["hip_force"], reference["hip_moment"]
    values = frame.loads.values
    assert set(reference) >= {name for name in values if "rest" not in name and values[name] != 0.0}
    differences = {name: values[name] - value for name, value in reference.items()}
    moments = ("moment", "axial", "coronal", "flexion")
    limit = {
        name: MOMENT if any(word in name for word in moments) else FORCE for name in differences
    }
    assert not {name: d for name, d in differences.items() if abs(d) > limit[name]}


def lent(frame):
    """Return the inputs that the free bodies take from tkamb."""
    geometry, loads = frame.geometry, frame.loads
    quadriceps, ligament = (
        [(load.link, *pair) for load in line for pair in zip(load.points, load.forces, strict=True)]
        for line in (geometry.muscles[0].loads, geometry.extensor.patellar_ligament)
    )
    return Lent(
        {side: (condyle.point, condyle.normal) for side, condyle in geometry.condyles.items()},
        tuple(loads.lifted),
        loads.slack,
        quadriceps,
        ligament,
        (geometry.extensor.contact_point, geometry.extensor.contact_normal),
        *(([], 0.0) if geometry.share is None else lent_muscles(geometry.share)),
    )


def lent_muscles(share):
    """Return ends and forces of the muscles across the knee, and the knee's reserve."""
    ends = (share.lines.shank, share.lines.thigh, share.force[share.crossing])
    return list(zip(*ends, strict=True)), share.reserve[share.flexion]


def test_lines_that_wrap_nothing_run_between_the_scenes_points(shipped):
    leg, recording, time = shipped
    for k in SHIPPED_FRAMES:
        geometry = recording.loads(k).geometry
        extensor = geometry.extensor
        lines = {"patellar_ligament": extensor.patellar_ligament}
        if extensor.wrap == 0.0:
            lines["quadriceps"] = geometry.muscles[0].loads
        laboratory_in_insert = np.linalg.inv(leg.insert_in_laboratory(time[k]))
        for name, loads in lines.items():
            for (end, place), load in zip(leg.ends(name, time[k]), loads, strict=True):
                assert load.link in (end, leg.body(end))
                assert np.allclose(
                    load.points[0], (laboratory_in_insert @ np.append(place, 1.0))[:3], atol=1e-9
                )


def test_the_free_bodies_notice_a_load_that_is_wrong_by_one_per_cent(shipped):
    leg, recording, time = shipped
    k, ground = SHIPPED_FRAMES[3], leg.ground
    reference = FreeBodies(leg, time[k], lent(recording.loads(k))).loads()
    leg.ground = lambda t: 1.01 * ground(t)
    try:
        changed = FreeBodies(leg, time[k], lent(recording.loads(k))).loads()
    finally:
        leg.ground = ground
    assert abs(changed["muscle_quadriceps"] - reference["muscle_quadriceps"]) > 10 * FORCE
    assert np.abs(changed["hip_moment"] - reference["hip_moment"]).max() > 5 * MOMENT
