"""An error names the argument in Python, and the option on the command line."""

from pathlib import Path

import pytest

import tkamb
from tkamb.cli import main
from tkamb.errors import InputError

pytestmark = pytest.mark.usefixtures("plain_report")

SCENE = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml"
CASES = (
    ({"frames": slice(90, 200)}, ["--frames", "90:200"], "frames: ", "--frames: "),
    ({"workers": 0}, ["--workers", "0"], "workers: ", "--workers: "),
    (
        {"overrides": {"contact.modl": "fe"}},
        ["--set", "contact.modl=fe"],
        "overrides contact.modl: ",
        "--set contact.modl: ",
    ),
)


@pytest.mark.parametrize(("arguments", "options", "in_python", "printed"), CASES)
def test_an_error_names_the_argument_in_python_and_the_option_of_the_command(
    arguments, options, in_python, printed, tmp_path, capsys
):
    with pytest.raises(InputError) as caught:
        tkamb.simulate(SCENE, contact="foundation", **arguments)
    assert str(caught.value).startswith(in_python)
    run = ["run", str(SCENE), "--contact", "foundation", "--out", str(tmp_path / "out")]
    assert main([*run, *options]) == 2
    assert f"tkamb: {printed}" in capsys.readouterr().err


def test_a_foreign_folder_is_refused_in_the_words_of_the_caller(tmp_path, capsys):
    (tmp_path / "diary.txt").write_text("mine")
    with pytest.raises(InputError, match="another directory, or give force=True"):
        tkamb.simulate(SCENE, contact="foundation", frames=slice(0, 1), directory=tmp_path)
    assert main(["run", str(SCENE), "--contact", "foundation", "--out", str(tmp_path)]) == 2
    assert "choose another folder with --out, or give --force" in capsys.readouterr().err
