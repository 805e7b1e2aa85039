"""Scenes with [patella] released: the patella in six degrees of freedom in the frames of a run."""

import copy

import numpy as np
import pytest

import tkamb
from mirrored_patient import write_mirrored_patient
from released_patella import RELEASED
from scenes import as_toml, write_scene
from tkamb.errors import InputError
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES

FRAMES = slice(20, 101, 20)
ENDS = (("proximal", "distal"), ("origin", "insertion"))


BUTTON = {"model": "foundation", "resolution_mm": 1.0}


def released_scene(folder, **changes):
    return write_scene(folder, contact__patellofemoral=BUTTON, patella=RELEASED | changes)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return released_scene(tmp_path_factory.mktemp("released"))


@pytest.fixture(scope="module")
def results(scene):
    return tkamb.simulate(scene, frames=FRAMES)


def coordinates(results):
    units = ("mm", "mm", "mm", "deg", "deg", "deg")
    names = zip(PATELLA_BODY_COORDINATES, units, strict=True)
    return np.array([results[f"patella_{name}_{unit}"] for name, unit in names]).T


def test_the_plane_results_do_not_change(results, tmp_path):
    plane = tkamb.simulate(write_scene(tmp_path), frames=FRAMES)
    for name, values in plane.columns.items():
        if name != "status" and not name.endswith("_seconds"):
            assert np.array_equal(values, results.columns[name], equal_nan=True), name
    assert not any(name.startswith(("patella_tilt", "patella_line")) for name in plane.columns)


def test_the_patella_is_in_equilibrium_in_every_frame(results):
    assert not any("patella:" in status for status in results.status)
    assert (results["patella_residual_N"] <= 1e-6 * results["quadriceps_N"]).all()
    assert np.isfinite(coordinates(results)).all()
    # The strands carry the pull of the patellar ligament, but the equations keep the plane patella.
    strands = sum(results[f"patella_line_strand_{side}_N"] for side in ("medial", "lateral"))
    assert strands[1:] == pytest.approx(results["patellar_ligament_N"][1:], rel=0.15)


def test_a_run_and_the_object_find_the_same_patella(scene, results):
    """`Knee.patella_equilibrium` with the same lines, and the tension of each frame."""
    knee, motion, _ = tkamb.read_scene(scene)
    lines = [
        tkamb.Ligament(
            one["name"],
            *(
                tkamb.LinkPoint(one[end]["link"], 1e-3 * np.array(one[end]["point_mm"]))
                for end in ("proximal", "distal")
            ),
            tkamb.TwoLine(stiffness=1e3 * one["stiffness_N_per_mm"]),
            slack_length=0.05,
        )
        for one in RELEASED["ligament"]
    ]
    heads = [
        tkamb.Muscle(
            one["name"],
            tuple(
                (one[end]["link"], tuple(1e-3 * np.array(one[end]["point_mm"])))
                for end in ("origin", "insertion")
            ),
        )
        for one in RELEASED["head"]
    ]
    own = tkamb.Knee(
        knee.model,
        implant=tkamb.Implant(knee.femoral, knee.insert, knee.button, placed=True),
        extensor=knee.extensor,
        ligaments=lines,
        muscles=heads,
        patellofemoral_contact=tkamb.contact_model("foundation", resolution=1e-3),
    )
    for row, frame in enumerate(range(*FRAMES.indices(len(motion)))):
        tension = results["quadriceps_N"][row]
        tensions = {one["name"]: one["share"] * tension for one in RELEASED["head"]}
        found = own.patella_equilibrium(motion.q[frame], tensions)
        mine = [found.coordinates[name] for name in PATELLA_BODY_COORDINATES]
        scale = [1e3] * 3 + [180.0 / np.pi] * 3
        assert np.array(mine) * scale == pytest.approx(coordinates(results)[row], abs=1e-5)
        peak = 1e6 * results["button_peak_pressure_MPa"][row]
        assert found.contact.contact.pressure.max() == pytest.approx(peak, rel=1e-5)


def test_a_left_patient_has_the_same_shift_and_tilt(results, tmp_path):
    import tomllib

    path = write_mirrored_patient(tmp_path)
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    patella = copy.deepcopy(RELEASED)
    for one in (*patella["head"], *patella["ligament"]):
        for end in set(one) & {"origin", "insertion", "proximal", "distal"}:
            one[end]["point_mm"][2] *= -1.0
    content["patella"], content["contact"]["patellofemoral"] = patella, BUTTON
    path.write_text(as_toml(content), encoding="utf-8")
    left = tkamb.simulate(path, frames=FRAMES)
    assert coordinates(left) == pytest.approx(coordinates(results), abs=1e-5)
    for name in ("button_medial_force_N", "button_lateral_force_N"):
        assert left[name] == pytest.approx(results[name], rel=1e-5)


def test_a_resumed_run_finds_the_same_patella(scene, tmp_path):
    frames = slice(40, 44)
    whole = tkamb.simulate(scene, frames=frames)

    def stop(indices):
        yield from list(indices)[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tkamb.simulate(scene, frames=frames, directory=tmp_path, progress=stop)
    tkamb.simulate(scene, frames=frames, directory=tmp_path, resume=True)
    resumed = tkamb.read_results(tmp_path)
    assert coordinates(resumed) == pytest.approx(coordinates(whole), abs=1e-5)


def test_released_coordinates_are_those_of_the_scene(tmp_path):
    held = released_scene(tmp_path, released=["ap", "si", "flexion", "tilt"])
    results = tkamb.simulate(held, frames=slice(60, 61))
    assert results["patella_shift_mm"][0] == results["patella_rotation_deg"][0] == 0.0
    assert abs(results["patella_tilt_deg"][0]) > 1e-3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ligament": []}, "released"),
        ({"head": RELEASED["head"][:2]}, "do not sum to 1"),
        ({"released": ["tild"]}, "released"),
        ({"ligament": RELEASED["ligament"][2:]}, "patella to the tibia"),
        ({"ligament": RELEASED["ligament"] * 2}, "named twice"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path, changes, words):
    path = released_scene(tmp_path, **changes)
    with pytest.raises(InputError, match=words):
        tkamb.simulate(path, frames=slice(0, 1))


def test_a_lost_patella_is_in_the_status(tmp_path):
    """Strands of 290 mm are slack: nothing holds the patella against the quadriceps."""
    slack = [one | {"slack_length_mm": 290.0} for one in RELEASED["ligament"]]
    results = tkamb.simulate(released_scene(tmp_path, ligament=slack), frames=slice(50, 51))
    assert "patella: " in results.status[0] and not results.status[0].startswith("failed")
    assert np.isnan(coordinates(results)).all() and np.isnan(results["button_force_N"][0])
    assert np.isfinite(results["force_total_N"][0])
