"""A run reads only the files and imports only the modules that its scene needs.

The contents of all files that the scene names are hashed.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from scenes import write_scene
from tkamb import simulate

WATCH = """
import json, sys
opened = []
sys.addaudithook(lambda event, args: event == "open" and opened.append(str(args[0])))
from tkamb import simulate
results = simulate(sys.argv[1], frames=slice(0, 101, 50))
print(json.dumps({
    "modules": sorted(name for name in sys.modules if name.startswith("tkamb.")),
    "others": [n for n in ("fcl", "matplotlib", "meshcat", "numba") if n in sys.modules],
    "files": [f for f in opened if f.endswith((".stl", ".csv", ".urdf", ".toml"))],
    "status": results.status,
}))
"""

REPORT = """
import sys
import tkamb.show.report, tkamb.run.results_folder
heavy = ("scipy", "trimesh", "pinocchio", "fcl", "numba")
print([name for name in heavy if name in sys.modules])
"""

MUSCLES = ("quadriceps", "patellar_ligament", "patella")


def traced_run(path):
    """Run a scene; return its opened files, imported modules, status and flexion moment."""
    process = subprocess.run(
        [sys.executable, "-c", WATCH, str(path)], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout)


def test_a_report_imports_no_numerical_library():
    process = subprocess.run(
        [sys.executable, "-c", REPORT], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "[]"


def test_a_scene_of_patient_and_motion_opens_only_their_files(tmp_path):
    drop = ("contact", "implant", "ligament", "tibia", "ground_reaction", *MUSCLES)
    record = traced_run(write_scene(tmp_path, drop))
    names = {name.rsplit("/", 1)[-1] for name in record["files"]}
    assert names == {"scene.toml", "patient.urdf", "motion.csv"}
    for module in record["modules"]:
        assert not module.startswith(("tkamb.contact", "tkamb.run.maps"))
        assert module not in (
            "tkamb.knee.ligaments",
            "tkamb.knee.extensor",
            "tkamb.io.recordings.meshes",
        )
    assert record["others"] == []
    assert record["status"] == ["ok"] * 3


def test_without_contact_no_mesh_is_read_and_no_contact_imported(tmp_path):
    record = traced_run(write_scene(tmp_path, ("contact", *MUSCLES)))
    assert "tkamb.io.mesh_files" not in record["modules"]  # the files are hashed, not read
    assert not any(module.startswith("tkamb.contact") for module in record["modules"])
    assert "tkamb.knee.ligaments" in record["modules"]


def test_without_ligaments_no_ligament_module_is_imported(tmp_path):
    record = traced_run(write_scene(tmp_path, ("ligament",)))
    assert "tkamb.knee.ligaments" not in record["modules"]
    assert "tkamb.contact.foundation" in record["modules"]
    assert not any("lattice" in module or "hertz" in module for module in record["modules"])


def test_external_moments_do_not_depend_on_omitted_parts(tmp_path):
    """External moments depend on motion, segments and ground reaction only."""
    drop = ("contact", "implant", "ligament", *MUSCLES)
    whole_moment, bare_moment = (
        simulate(write_scene(tmp_path / name, drop), frames=slice(0, 101, 50))[
            "external_flexion_moment_Nm"
        ]
        for name, drop in (("whole", ()), ("bare", drop))
    )
    # Without [patella], its mass of 0.1 kg is fixed to the femur.
    assert whole_moment == pytest.approx(bare_moment, abs=0.2)
    assert np.abs(whole_moment - bare_moment).max() > 0
