"""Results do not depend on the laboratory frame, the units or the sampling rate; scaling."""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from scenes import MODEL, write_scene
from tkamb.errors import InputError
from tkamb.geometry import closest, condyles
from tkamb.geometry.frames import pose
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.patient import load_urdf
from tkamb.io.scene.case import Case, load_case
from tkamb.io.scene.parts import ligament, read_muscles, read_patellar_ligament
from tkamb.io.scene.scene import Scene, load_scene
from tkamb.knee import equations as knee
from tkamb.knee import patellofemoral, unknowns
from tkamb.knee.chain import Chain
from tkamb.knee.frame import Frame
from tkamb.run.read_scene import recording_of

FEW = 26
FRAMES = (0, 9, 15, 23)
CONDYLE_LENGTHS = (
    "notch_depth",
    "facet_depth",
    "strip_width",
    "sample_spacing",
    "highest_sample",
    "deepest_notch",
)


@cache
def shipped() -> Case:
    return load_case(load_scene(MODEL / "scene.toml", {"motion.frames": FEW}))


@cache
def shipped_loads() -> list[Frame]:
    recording = recording_of(shipped())
    return [recording.loads(k) for k in FRAMES]


def numbers(frame: Frame) -> np.ndarray:
    """Return the loads of a frame: forces (N), moments (N·m), tensions (N)."""
    assert not frame.loads.problems
    loads = frame.loads
    return np.array(
        [
            *loads.values.values(),
            *loads.contact_force,
            loads.external_flexion,
            loads.external_adduction,
            loads.sensitivity,
            *frame.geometry.tensions.values(),
            frame.geometry.extensor.wrap,
        ]
    )


def turned(case: Case, rotation: np.ndarray, shift: np.ndarray) -> Case:
    """Return the case with its laboratory measurements in another laboratory frame."""
    move = pose(rotation, shift)
    ground = replace(
        case.ground,
        force=case.ground.force @ rotation.T,
        moment=case.ground.moment @ rotation.T,
        point=case.ground.point @ rotation.T + shift,
    )
    tibia = replace(case.tibia, pose=move @ case.tibia.pose)
    return replace(case, tibia=tibia, ground=ground)


@pytest.mark.parametrize("angle_deg", [17.0, 201.0])
def test_turning_the_laboratory_about_the_vertical_changes_nothing(angle_deg):
    rotation = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    recording = recording_of(turned(shipped(), rotation, np.array([0.4, -0.1, 1.3])))
    for k, before in zip(FRAMES, shipped_loads(), strict=True):
        expected = numbers(before)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(numbers(recording.loads(k)), expected, atol=1e-10 * scale)


def test_any_rotation_of_laboratory_and_gravity_changes_nothing():
    rotation = Rotation.from_euler("xyz", [40.0, 100.0, -75.0], degrees=True).as_matrix()
    case = turned(shipped.__wrapped__(), rotation, np.zeros(3))
    gravity = rotation @ case.chain.model.gravity.linear
    case.chain.model.gravity = pin.Motion(gravity, np.zeros(3))
    recording = recording_of(case)
    for k, before in zip(FRAMES, shipped_loads(), strict=True):
        expected = numbers(before)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(numbers(recording.loads(k)), expected, atol=1e-10 * scale)


@pytest.mark.parametrize("axes", ["+y,+z,+x", "-x,+y,-z"])
def test_a_laboratory_with_other_axes_gives_the_same(tmp_path, axes):
    to_laboratory = np.zeros((3, 3))
    for row, axis in enumerate(axes.split(",")):
        to_laboratory[row, "xyz".index(axis[1])] = -1.0 if axis[0] == "-" else 1.0
    path = write_scene(
        tmp_path,
        drop=("tibia",),
        ground_reaction__laboratory_axes=axes,
        motion__frames=FEW,
    )
    recorded = load_case(load_scene(MODEL / "scene.toml"))
    tibia = recorded.tibia
    turns = Rotation.from_matrix(to_laboratory.T @ tibia.pose[:, :3, :3]).as_euler("YXZ")
    places = tibia.pose[:, :3, 3] @ to_laboratory
    names = [f"{kind}_{n}" for kind in ("rotation", "translation") for n in (1, 2, 3)]
    rows = np.column_stack([recorded.motion.time, np.unwrap(turns, axis=0), places])
    np.savetxt(
        tmp_path / "pose.csv", rows, "%.15g", ",", header=",".join(["time", *names]), comments=""
    )
    with path.open("a", encoding="utf-8") as scene:
        scene.write(
            '[tibia]\nkind = "pose"\nfile = "pose.csv"\nsequence = "YXZ"\nangle_unit = "rad"\n'
            f'length_unit = "m"\nlaboratory_axes = "{axes}"\n'
        )
    _turn_columns(tmp_path / "ground_reaction.csv", to_laboratory)
    recording = recording_of(load_case(load_scene(path)))
    for k, before in zip(FRAMES, shipped_loads(), strict=True):
        expected = numbers(before)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(numbers(recording.loads(k)), expected, atol=1e-6 * scale)


def _turn_columns(path, to_laboratory):
    rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    table = np.array(rows[1:], float)
    for kind in ("force", "point"):
        unit = "N" if kind == "force" else "mm"
        columns = [rows[0].index(f"{kind}_{axis}_{unit}") for axis in "xyz"]
        table[:, columns] = table[:, columns] @ to_laboratory
    np.savetxt(path, table, "%.12g", ",", header=",".join(rows[0]), comments="")


LENGTH, MASS, TIME = 2.0, 4.0, 0.5
"""Units of the new system, in old units: powers of two, so that floats scale exactly."""
FORCE = MASS * LENGTH / TIME**2


def scaled_scene(scene: Scene) -> Scene:
    """Return the scene with the numbers of its tables in the new units."""

    def attachment(end):
        return end.model_copy(update={"point_mm": tuple(LENGTH * x for x in end.point_mm)})

    bundles = tuple(
        bundle.model_copy(
            update={
                "proximal": attachment(bundle.proximal),
                "distal": attachment(bundle.distal),
                "stiffness_N_per_mm": bundle.stiffness_N_per_mm * FORCE / LENGTH,
                "slack_length_mm": bundle.slack_length_mm * LENGTH,
            }
        )
        for bundle in scene.ligament
    )
    lines = {}
    for name in ("quadriceps", "patellar_ligament"):
        table = getattr(scene, name)
        keys = [key for key, _ in table if key.endswith("_mm")]
        lengths = {key: LENGTH * getattr(table, key) for key in keys}
        ends = {
            key: attachment(getattr(table, key))
            for key in ("origin", "insertion", "proximal", "distal")
            if hasattr(table, key)
        }
        lines[name] = table.model_copy(update=lengths | ends)
    return scene.model_copy(update={"ligament": bundles} | lines)


def scaled_chain(case: Case) -> Chain:
    """Return the chain with placements, inertias and gravity in the new units."""
    chain = Chain(load_urdf(case.scene.patient, True), True)
    model = chain.model
    for joint in range(model.njoints):
        place, inertia = model.jointPlacements[joint], model.inertias[joint]
        model.jointPlacements[joint] = pin.SE3(place.rotation, LENGTH * place.translation)
        model.inertias[joint] = pin.Inertia(
            MASS * inertia.mass, LENGTH * inertia.lever, MASS * LENGTH**2 * inertia.inertia
        )
    for frame in model.frames:
        frame.placement = pin.SE3(frame.placement.rotation, LENGTH * frame.placement.translation)
    model.gravity = pin.Motion(model.gravity.linear * LENGTH / TIME**2, np.zeros(3))
    chain._insert_in_root = scaled_pose(chain._insert_in_root)
    chain._tibia_in_root = scaled_pose(chain._tibia_in_root)
    return chain


def scaled_pose(poses):
    scaled = np.array(poses)
    scaled[..., :3, 3] *= LENGTH
    return scaled


def scaled_case(case: Case) -> Case:
    def surface(of: Surface) -> Surface:
        return Surface(LENGTH * of.vertices, of.faces, of.name)

    units = np.array([LENGTH] * 3 + [1.0] * 3)
    flat = np.array([LENGTH, LENGTH, 1.0])
    motion, tibia, ground = case.motion, case.tibia, case.ground
    scene, chain = scaled_scene(case.scene), scaled_chain(case)
    return Case(
        scene,
        chain,
        replace(
            motion,
            time=motion.time * TIME,
            coordinates=motion.coordinates * units,
            velocity=motion.velocity * units / TIME,
            acceleration=motion.acceleration * units / TIME**2,
            patella=motion.patella * flat,
            patella_velocity=motion.patella_velocity * flat / TIME,
            patella_acceleration=motion.patella_acceleration * flat / TIME**2,
        ),
        replace(
            tibia,
            time=tibia.time * TIME,
            pose=scaled_pose(tibia.pose),
            velocity=tibia.velocity * units / TIME,
            acceleration=tibia.acceleration * units / TIME**2,
        ),
        replace(
            ground,
            force=ground.force * FORCE,
            point=ground.point * LENGTH,
            moment=ground.moment * FORCE * LENGTH,
        ),
        surface(case.femoral),
        surface(case.insert),
        surface(case.patella),
        tuple(ligament(table) for table in scene.ligament),
        read_muscles(scene, chain),
        read_patellar_ligament(scene),
    )


def test_other_units_give_the_dimensionally_scaled_answer(monkeypatch):
    """Lengths, masses, times and gravity of the case are scaled, and lengths in the settings."""
    unscaled = shipped_loads()  # before the settings are scaled
    speed = unknowns.CONTACT_POINT.standstill_speed * LENGTH / TIME
    contact_point = replace(unknowns.CONTACT_POINT, standstill_speed=speed)
    monkeypatch.setattr(unknowns, "CONTACT_POINT", contact_point)
    own_lengths = {
        (knee, "EQUATION"): ("residual_shift",),
        (patellofemoral, "PATELLOFEMORAL"): ("patch_depth", "sample_spacing", "sample_range"),
        (closest, "CLOSEST_POINT"): ("region_radius", "clearance", "gap_range"),
        (closest, "CONDYLE"): CONDYLE_LENGTHS,
        (condyles, "CONDYLE"): CONDYLE_LENGTHS,
    }
    for (module, name), fields in own_lengths.items():
        settings = getattr(module, name)
        scaled_fields = {field: getattr(settings, field) * LENGTH for field in fields}
        monkeypatch.setattr(module, name, replace(settings, **scaled_fields))
    patella = patellofemoral.PatellofemoralContact.__init__
    ml, lateral_yield, tilt_yield = patella.__defaults__
    scaled = (ml, lateral_yield * LENGTH, tilt_yield / LENGTH)
    monkeypatch.setattr(patella, "__defaults__", scaled)
    recording = recording_of(scaled_case(shipped()))
    for k, before in zip(FRAMES, unscaled, strict=True):
        after = recording.loads(k)
        assert not after.loads.problems
        for name, value in before.loads.values.items():
            moment = "moment" in name or name == "residual_axial"
            expected = value * FORCE * (LENGTH if moment else 1.0)
            assert after.loads.values[name] == pytest.approx(expected, rel=1e-8, abs=1e-6 * FORCE)
        assert after.loads.external_flexion == pytest.approx(
            before.loads.external_flexion * FORCE * LENGTH, rel=1e-9, abs=1e-9
        )
        assert after.loads.sensitivity == pytest.approx(before.loads.sensitivity * FORCE, rel=1e-6)
        assert after.geometry.extensor.wrap == pytest.approx(
            before.geometry.extensor.wrap, abs=1e-9
        )
        for name, tension in before.geometry.tensions.items():
            assert after.geometry.tensions[name] == pytest.approx(
                tension * FORCE, rel=1e-9, abs=1e-9
            )


def resampled_scene(folder, rate, cutoff, start=1.0, stop=2.0):
    """Write a part of the shipped bend (`start` to `stop`, s), resampled at a rate (Hz)."""
    changes = {f"{table}__cutoff_Hz": cutoff for table in ("motion", "ground_reaction")}
    path = write_scene(folder, **changes)
    time = np.linspace(start, stop, round((stop - start) * rate) + 1)
    for name in ("motion.csv", "tibia.csv", "ground_reaction.csv"):
        header = (path.parent / name).read_text(encoding="utf-8").split("\n", 1)[0]
        rows = np.loadtxt(path.parent / name, delimiter=",", skiprows=1)
        spline = make_interp_spline(rows[:, 0], rows[:, 1:], k=5)
        np.savetxt(
            path.parent / name,
            np.column_stack([time, spline(time)]),
            "%.12g",
            ",",
            header=header,
            comments="",
        )
    return path


def test_slow_and_fast_recordings_of_the_same_motion_agree(tmp_path):
    """One second of the bend at 20 Hz and 1000 Hz, both filtered at 6 Hz, agrees to 1e-4 BW."""
    forces = {}
    for rate in (20, 1000):
        case = load_case(load_scene(resampled_scene(tmp_path / str(rate), rate, 6.0)))
        recording = recording_of(case)
        chosen = [int(np.argmin(np.abs(case.motion.time - at))) for at in (1.3, 1.5, 1.7)]
        frames = [recording.loads(k) for k in chosen]
        assert not any(frame.loads.problems for frame in frames)
        forces[rate] = np.array([frame.loads.contact_force for frame in frames])
    assert np.abs(forces[20] - forces[1000]).max() < 1e-4 * shipped().body_weight


SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
S = 1.1


def case(scale, *drop):
    """Return the shipped knee at a scale without contact, ligaments and the tables `drop`."""
    scene = load_scene(SCENE, {"patient.scale": scale})
    return load_case(scene.model_copy(update=dict.fromkeys(("contact", *drop)) | {"ligament": ()}))


def test_static_forces_without_ligaments_scale_with_body_weight():
    # Forces scale with s³, moments with s⁴, arms with s. Inertia forces, which scale with s⁴, are
    # zero in the first frame.
    plain, large = (recording_of(case(scale)).loads(0).loads for scale in (1.0, S))
    size = S**3 * float(np.linalg.norm(plain.contact_force))
    np.testing.assert_allclose(
        large.contact_force, S**3 * plain.contact_force, rtol=0.0, atol=1e-6 * size
    )
    assert size > 100.0


def test_every_part_of_the_case_is_scaled_by_its_power():
    scene = load_scene(SCENE)
    plain, large = load_case(scene), load_case(load_scene(SCENE, {"patient.scale": S}))
    assert large.body_weight == pytest.approx(S**3 * plain.body_weight)
    for part in ("femoral", "insert", "patella"):
        original, scaled = getattr(plain, part), getattr(large, part)
        np.testing.assert_allclose(scaled.vertices, S * original.vertices)
    for original, scaled in zip(plain.ligaments, large.ligaments, strict=True):
        assert scaled.slack_length == pytest.approx(S * original.slack_length)
        # The same strain gives S² times the force.
        assert scaled.law.stiffness * scaled.slack_length == pytest.approx(
            S**2 * original.law.stiffness * original.slack_length
        )
    for link in ("tibia", "femur"):
        (mass, centre, inertia), (large_mass, large_centre, large_inertia) = (
            original.chain.segment(link) for original in (plain, large)
        )
        assert large_mass == pytest.approx(S**3 * mass)
        np.testing.assert_allclose(large_centre, S * centre)
        np.testing.assert_allclose(large_inertia, S**5 * inertia)
    np.testing.assert_allclose(
        large.motion.coordinates, plain.motion.coordinates * [*[S] * 3, 1, 1, 1]
    )
    expected = S * plain.chain.link_in("hip", "femur")[:3, 3]
    np.testing.assert_allclose(large.chain.link_in("hip", "femur")[:3, 3], expected)


def test_a_scale_beyond_people_is_refused():
    with pytest.raises(InputError, match=r"patient\.scale.*not within 0\.7"):
        load_scene(SCENE, {"patient.scale": 2.0})
