"""No command overwrites the output of another command."""

import json

import pytest

from kept_runs import keep
from scenes import fast_scene
from synthetic_run import make_run
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.claim import BESIDE, WRITTEN, claimed_directory, occupants
from tkamb.run.results_folder import write_results
from tkamb.studies.kept_rows import KeptRows

pytestmark = pytest.mark.usefixtures("plain_report")

SCENE = str(fast_scene())
COMMANDS = {
    "run": ["run", SCENE, "--frames", "50:51"],
    "uncertainty": ["uncertainty", SCENE, "--frames", "50:51", "--samples", "20"],
    "tradeoff": ["tradeoff", "--quick"],
    "stability": ["stability", "--quick"],
    "wear": ["wear", SCENE],
    "cohort": ["cohort", "{cohort}"],
}


def content(folder):
    """Return name -> bytes of all files below a folder."""
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("occupant", WRITTEN)
def test_a_command_does_not_change_the_folder_of_another_command(
    command, occupant, tmp_path, capsys
):
    if command == occupant or occupant in BESIDE.get(command, ()):
        return
    out = tmp_path / "out"
    with claimed_directory(out):
        (out / WRITTEN[occupant][0]).write_text("hours of work")
    before = content(out)
    (cohort := tmp_path / "c.toml").write_text(f'[[trial]]\nname = "a"\nscene = "{SCENE}"')
    words = [word.format(cohort=cohort) for word in COMMANDS[command]]
    assert main([*words, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    (line,) = [text for text in error.splitlines() if text.startswith("tkamb: ")]
    assert f"holds what `tkamb {occupant}` wrote ({WRITTEN[occupant][0]})" in line
    assert "choose another folder with --out" in line
    assert content(out) == before


def test_results_with_bands_belong_to_an_uncertainty_run(tmp_path):
    """A run would remove the bands."""
    for name in ("results.csv", "bands.csv"):
        (tmp_path / name).write_text("time_s\n")
    assert occupants(tmp_path) == {"uncertainty": "bands.csv"}


@pytest.mark.parametrize(
    ("identity", "whose"),
    [
        ({"choice of frames": [0, 1, 1], "version of tkamb": "0"}, "run"),
        ({"choice of frames": [0, 1, 1], "method of sampling": "lhs"}, "uncertainty"),
        ({"choice of frames": None, "table of runs": "a"}, "cohort"),
    ],
)
def test_an_unfinished_run_is_recognised_by_its_identity(identity, whose, tmp_path):
    (tmp_path / ".frames").mkdir()
    (tmp_path / ".frames" / "run.json").write_text(json.dumps(identity))
    assert occupants(tmp_path) == {whose: ".frames/run.json"}


@pytest.mark.parametrize(
    ("row", "whose"),
    [
        ({"status": "ok", "map": {"1 2": 3.0}}, "tradeoff"),
        ({"case": "a", "kind": "b"}, "stability"),
    ],
)
def test_a_killed_study_is_recognised_by_its_rows(row, whose, tmp_path):
    KeptRows(tmp_path, resume=False).put("key", row)
    assert occupants(tmp_path) == {whose: "rows.jsonl"}


def test_output_of_the_same_command_is_replaced_and_that_of_another_only_with_force(tmp_path):
    write_results(make_run("bend"), tmp_path)
    write_results(make_run("bend"), tmp_path)
    refused = pytest.raises(InputError, match="holds what `tkamb run` wrote")
    with refused, claimed_directory(tmp_path, command="tradeoff"):
        pass
    with claimed_directory(tmp_path, force=True, command="tradeoff"):
        pass


def test_compare_and_export_write_beside_a_run_without_changing_it(tmp_path, capsys):
    run = keep(make_run("bend"), tmp_path / "run")
    before = content(run)
    for words in (["compare", run, run], ["export", run, "--vtp"]):
        assert main([*map(str, words), "--out", str(run)]) == 0
    after = content(run)
    assert {"compare.html", "contact.pvd"} <= set(after)
    assert {name: after[name] for name in before} == before


def test_wear_and_run_may_share_a_folder(tmp_path):
    with claimed_directory(tmp_path):
        for name in ("results.csv", "wear.json"):
            (tmp_path / name).write_text("x")
    for command in ("wear", "run"):
        with claimed_directory(tmp_path, command=command) as folder:
            assert (folder / "results.csv").read_text() == "x"
