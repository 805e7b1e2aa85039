"""No command overwrites or mixes another command's output, finished or unfinished."""

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
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("occupant", WRITTEN)
def test_a_command_is_refused_anothers_folder_and_nothing_changes(
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
    (line,) = [one for one in error.splitlines() if one.startswith("tkamb: ")]
    assert f"holds what `tkamb {occupant}` wrote ({WRITTEN[occupant][0]})" in line
    assert "choose another folder with --out" in line
    assert content(out) == before


def test_a_run_is_not_what_an_uncertainty_run_wrote(tmp_path):
    """A run would remove the bands beside the results, which took hours."""
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
def test_what_is_under_way_is_known(identity, whose, tmp_path):
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
def test_a_study_that_was_killed_is_known_by_its_rows(row, whose, tmp_path):
    KeptRows(tmp_path, resume=False).put("key", row)
    assert occupants(tmp_path) == {whose: "rows.jsonl"}


def test_own_output_is_replaced_and_force_takes_anothers(tmp_path):
    write_results(make_run("bend"), tmp_path)
    write_results(make_run("bend"), tmp_path)
    refused = pytest.raises(InputError, match="holds what `tkamb run` wrote")
    with refused, claimed_directory(tmp_path, command="tradeoff"):
        pass
    with claimed_directory(tmp_path, force=True, command="tradeoff"):
        pass


def test_a_page_and_maps_with_names_of_their_own_stand_beside_a_run(tmp_path, capsys):
    run = keep(make_run("bend"), tmp_path / "run")
    before = content(run)
    for words in (["compare", run, run], ["export", run, "--vtp"]):
        assert main([*map(str, words), "--out", str(run)]) == 0
    after = content(run)
    assert {"compare.html", "contact.pvd"} <= set(after)
    assert {name: after[name] for name in before} == before


def test_wear_stands_beside_its_run_and_the_run_may_be_run_again(tmp_path):
    with claimed_directory(tmp_path):
        for name in ("results.csv", "wear.json"):
            (tmp_path / name).write_text("x")
    for command in ("wear", "run"):
        with claimed_directory(tmp_path, command=command) as folder:
            assert (folder / "results.csv").read_text() == "x"
