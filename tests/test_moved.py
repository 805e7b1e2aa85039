"""Import paths of release 0.1 lead to the same objects, with a warning."""

import subprocess
import sys
from importlib import import_module

import pytest

from tkamb.moved import FOLDERS, MODULES, new_name


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ("tkamb.inputs.c3d", "tkamb.io.recordings.c3d", "read_c3d"),
        ("tkamb.scene", "tkamb.io.scene", "load_scene"),
        ("tkamb.simulation", "tkamb.run.simulation", "simulate"),
        ("tkamb.equilibrium.mechanics", "tkamb.run.mechanics", "Mechanics"),
        ("tkamb.muscles.leg", "tkamb.run.muscles.leg", "leg_muscles"),
        ("tkamb.wear.command", "tkamb.commands.wear", "add_wear"),
    ],
)
def test_an_old_path_gives_the_same_object_and_warns(old, new, name):
    code = f"from {old} import {name} as a; from {new} import {name} as b; assert a is b"
    process = subprocess.run(
        [sys.executable, "-W", "always", "-c", code], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert f"{old} is now {new}" in process.stderr


def test_a_module_keeps_its_name_and_files_after_an_import_by_its_old_path():
    code = (
        "import tkamb.output, tkamb.show; from importlib import reload, resources; "
        "assert tkamb.show.__spec__.name == tkamb.show.__name__ == 'tkamb.show'; "
        "assert resources.files('tkamb.show').joinpath('view').is_dir(); "
        "assert reload(tkamb.show) is tkamb.output"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


def test_every_new_module_exists():
    for new in (*FOLDERS.values(), *MODULES.values()):
        import_module(new)


def test_names_of_modules_that_have_not_moved_are_unchanged():
    assert new_name("tkamb.contact.hertz") is None
    assert new_name("tkamb.bodyguard") is None
    assert new_name("tkamb.studies.stability") is None
    with pytest.raises(ModuleNotFoundError):
        import_module("tkamb.nowhere")
