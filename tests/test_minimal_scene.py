"""Only what the scene requires: which files are opened and which modules are imported."""

import json
import subprocess
import sys

import numpy as np
import pytest

from scenes import write_scene

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
    "flexion_moment": results["external_flexion_moment_Nm"].tolist(),
}))
"""

SHOWN = """
import sys
import tkamb.show.report, tkamb.run.results_folder
heavy = ("scipy", "trimesh", "pinocchio", "pydantic", "fcl", "numba")
print([name for name in heavy if name in sys.modules])
"""

MUSCLES = ("quadriceps", "patellar_ligament", "patella")


def watched(path):
    done = subprocess.run(
        [sys.executable, "-c", WATCH, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_report_waits_for_nothing_that_computes():
    done = subprocess.run([sys.executable, "-c", SHOWN], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_patient_and_motion_alone_touch_nothing_else(tmp_path):
    drop = ("contact", "implant", "ligament", "tibia", "ground_reaction", *MUSCLES)
    seen = watched(write_scene(tmp_path, drop))
    names = {name.rsplit("/", 1)[-1] for name in seen["files"]}
    assert names == {"scene.toml", "patient.urdf", "motion.csv"}
    for module in seen["modules"]:
        assert not module.startswith(("tkamb.contact", "tkamb.run.maps"))
        assert module not in (
            "tkamb.knee.ligaments",
            "tkamb.knee.extensor",
            "tkamb.io.recordings.meshes",
        )
    assert seen["others"] == []
    assert seen["status"] == ["ok"] * 3


def test_without_contact_no_mesh_is_read_and_no_contact_imported(tmp_path):
    seen = watched(write_scene(tmp_path, ("contact", *MUSCLES)))
    assert not any(name.endswith(".stl") for name in seen["files"])
    assert not any(module.startswith("tkamb.contact") for module in seen["modules"])
    assert "tkamb.knee.ligaments" in seen["modules"]


def test_without_ligaments_no_ligament_module(tmp_path):
    seen = watched(write_scene(tmp_path, ("ligament",)))
    assert "tkamb.knee.ligaments" not in seen["modules"]
    assert "tkamb.contact.foundation" in seen["modules"]
    assert not any("lattice" in module or "hertz" in module for module in seen["modules"])


def test_parts_that_are_left_out_do_not_change_what_stays(tmp_path):
    """The external moments hang on motion, segments and ground alone."""
    whole = watched(write_scene(tmp_path / "a"))
    bare = watched(write_scene(tmp_path / "b", ("contact", "implant", "ligament", *MUSCLES)))
    whole_moment, bare_moment = (np.array(s["flexion_moment"]) for s in (whole, bare))
    # Without [patella] its 0.1 kg ride on the femur at the joint's neutral place.
    assert whole_moment == pytest.approx(bare_moment, abs=0.2)
    assert np.abs(whole_moment - bare_moment).max() > 0
