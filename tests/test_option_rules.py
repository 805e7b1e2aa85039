"""Every option has an effect, or a rule refuses it where it has none."""

import argparse
import os
import shlex
import subprocess
import sys

import numpy as np
import pytest

from pendulum_leg import changed, recorded_leg
from scenes import fast_scene
from tkamb.cli import _parser, main
from tkamb.commands.options import EXAMPLES, RULES, Rule, check_options, leaf_parsers
from tkamb.io.recordings.tables import read_table
from tkamb.show.storage import write_storage

PARSERS = dict(leaf_parsers(_parser()))

ALWAYS = {
    "import": "--grf --c3d --trc --motion --side --mass-kg --femoral --insert --interval --out "
    "--scene "
    "--activity --note --muscles --cycle --scale-mass --keep-mass --knee --cutoff-hz",
    "run": "--as --contact --resolution --out --frames --set --no-cache --force --resume "
    "--workers "
    "--profile --pack --strict --json",
    "check": "--out --set --json",
    "new": "--side --mass-kg --height-mm --sex",
    "verify": "--inputs --rerun",
    "methods": "",
    "settings": "--json",
    "live": "--frame --contact --out --port",
    "report": "",
    "scene": "--schema",
    "compare": "--axis --frame --out --force --json",
    "press": "--load --units --pose --pose-file --contact --no-cache --resolution "
    "--bearing --material --axes --side --adjust --out --json",
    "contact list": "",
    "mesh check": "--json",
    "mesh part": "--out",
    "mesh lattice": "--resolution --units --axes --side --out --json",
    "data get": "--from --url --to",
    "export": "--sto --vtp --figures --deck",
    "view": "--contact --frame --camera --lattice --html --png --gif --mp4",
    "tradeoff": "--quick --full --peer --recompute --resume --out --force --json",
    "stability": "--quick --resume --workers --out --force --json",
    "wear": "--close --set --part --simulator --cycles --updates --law --material --wear-factor "
    "--contact --resolution "
    "--frames-per-cycle --samples --workers --out --force --resume --json",
    "uncertainty": "--contact --resolution --frames --set --dask --screen",
    "cohort": "--dask --shard --frames --out --force --resume",
}
"""Options that have an effect beside all others. The parser itself refuses options that exclude
each other, such as --c3d and --trc."""


def options_of(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return long name -> option; metavar -> optional positional argument."""
    options = {}
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        if action.option_strings:
            options[next(o for o in action.option_strings if o.startswith("--"))] = action
        elif action.nargs == "?":
            options[str(action.metavar)] = action
    return options


@pytest.mark.parametrize("command", PARSERS)
def test_every_option_has_a_rule_or_always_has_an_effect(command):
    """A new option needs an entry in `RULES` or in `ALWAYS`."""
    ruled = {rule.option for rule in RULES.get(command, ())}
    always = set(ALWAYS[command].split())
    assert ruled | always == ruled | set(options_of(PARSERS[command]))
    assert set(options_of(PARSERS[command])) <= ruled | always


@pytest.mark.parametrize("command", PARSERS)
def test_every_option_has_a_help_text(command):
    for name, action in options_of(PARSERS[command]).items():
        assert action.help, f"{command} {name}"
    for action in PARSERS[command]._actions:
        assert action.help, f"{command} {action.dest}"


@pytest.mark.parametrize("command", PARSERS)
def test_the_examples_in_the_help_are_accepted(command, capsys):
    assert len(EXAMPLES[command]) >= 2
    for example in EXAMPLES[command]:
        words = shlex.split(example.split(" | ")[0].split(" > ")[0])
        assert words[0] == "tkamb" and words[1 : 1 + len(command.split())] == command.split()
        parser = _parser()
        check_options(parser, words[1:], parser.parse_args(words[1:]))
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    shown = capsys.readouterr().out
    assert all(example in shown for example in EXAMPLES[command])


@pytest.mark.parametrize("command", ["press", "mesh lattice", "import"])
def test_unit_and_axes_have_two_spellings(command):
    strings = PARSERS[command]._option_string_actions
    assert strings["--units"] is strings["--mesh-unit"]
    assert strings["--axes"] is strings["--mesh-axes"]


VALUES = {
    "--mass-kg": "70",
    "--side": "right",
    "--grf": "a.mot",
    "--plates": "2,3",
    "--interval": "0:1",
    "--stride": "0:1",
    "--stance": "0:1",
    "--method": "chain",
    "--contact": "lattice",
    "--mesh-unit": "mm",
    "--deck": "ccx",
    "--frame": "1",
    "--resolution": "1",
    "--samples": "64",
    "--port": "80",
    "--period": "2",
    "--workers": "2",
    "--load": "100",
    "--length-unit": "mm",
    "--cycle": "1:2",
    "--restore-when": "either",
    "--force-unit": "N",
    "--moment-unit": "Nmm",
}
POSITIONAL = {
    "import": ["model.osim"],
    "uncertainty": ["scene.toml"],
    "wear": ["scene.toml"],
    "view": ["scene.toml"],
    "export": ["folder"],
    "press": ["a.stl", "b.stl"],
    "mesh lattice": ["a.stl"],
    "check": ["scene.toml"],
    "tradeoff": [],
    "cohort": ["cohort.toml"],
}
OF_IMPORT = ["--side=right", "--mass-kg=70", "--out=o"]


def written(command: str, name: str) -> list[str]:
    """Return an option as arguments, with a value if it needs one."""
    if not name.startswith("--"):
        return ["scene.toml"]
    action = options_of(PARSERS[command])[name]
    if action.nargs == 0:
        return [name]
    value = VALUES.get(name, "x.toml")
    if command == "uncertainty" and name == "--method":
        value = "sobol"
    return [f"{name}={value}"]


def offences() -> list[tuple[str, Rule, list[str]]]:
    """Return command, rule and a command line that breaks only this rule, for every rule."""
    cases = []
    for command, rules in RULES.items():
        for rule in rules:
            for other in rule.excludes or ("",):
                words = [*command.split(), *POSITIONAL[command]]
                beside = [rule.option, other] if other else [rule.option]
                for name in beside:
                    words += written(command, name)
                if command == "import":
                    words += OF_IMPORT
                    source = "--trc=a.trc"
                    if not {"--c3d", "--motion"} & {*beside}:
                        words.append("--c3d=a.c3d" if "--grf" in rule.excludes else source)
                if command == "export" and not {"--sto", "--vtp", "--figures", "--deck"} & {
                    *beside
                }:
                    words.append("--sto=a.sto")
                if command == "press":
                    words.append("--load=5")
                if rule.option == "--static" and other == "--poses":
                    words += ["--pose-sequence=XYZ"]
                cases.append((command, rule, words))
    return cases


@pytest.mark.parametrize(
    ("command", "rule", "words"),
    [pytest.param(*case, id=" ".join(case[2])[:90]) for case in offences()],
)
def test_an_option_without_effect_is_refused(tmp_path, monkeypatch, capsys, command, rule, words):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(words)
    except SystemExit as refused:
        status = refused.code
    error = capsys.readouterr().err
    assert status == 2 and len(error.splitlines()) == 1, error
    assert rule.option in error and ("needs" in error or "does not go with" in error), error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("short", ["--plat=2", "--plate", "--pl"])
def test_rules_apply_to_abbreviated_options(tmp_path, capsys, short):
    arguments = recorded_leg(tmp_path)
    words = [short] if "=" in short else [short, "2"]
    assert main([*arguments, *words]) == 2
    assert "--plates: needs --c3d" in capsys.readouterr().err


def test_a_value_is_not_mistaken_for_an_option(tmp_path):
    assert main([*recorded_leg(tmp_path), "--note", "forces: see the lab's --plates list"]) == 0


def test_workers_are_refused_with_the_address_of_a_cluster(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["cohort", "c.toml", "--dask=tcp://host:1", "--workers=4"]) == 2
    assert "--workers: does not go with --dask" in capsys.readouterr().err
    assert main(["cohort", "c.toml", "--dask=local", "--workers=4"]) == 2
    assert "no such" in capsys.readouterr().err


def motion_file(tmp_path, start: float, end: float) -> str:
    time = np.linspace(start, end, 81)
    bend = -0.2 - 0.5 * (time - start) / (end - start)
    write_storage(tmp_path / "bend.mot", {"time": time, "knee_r_0": bend}, False)
    return str(tmp_path / "bend.mot")


@pytest.mark.parametrize(("interval", "first", "last"), [("1:3", 1.0, 3.0), ("0.52:2", 0.55, 2.0)])
def test_an_interval_of_a_motion_is_imported(tmp_path, interval, first, last):
    path = motion_file(tmp_path, 0.5, 4.5)
    arguments = changed(recorded_leg(tmp_path), trc=None, motion=path, interval=interval)
    assert main(arguments) == 0
    time = read_table(tmp_path / "out" / "motion.csv").columns["time_s"]
    assert time[[0, -1]] == pytest.approx([first, last])


def test_motion_and_forces_are_imported_at_their_common_times(tmp_path, capsys):
    path = motion_file(tmp_path, 0.5, 4.5)
    clock = np.linspace(0.0, 2.5, 251)
    columns = {f"ground_force_r_{k}{a}": 0 * clock for k in "vp" for a in "xyz"}
    columns["ground_force_r_vy"] = 500.0 + 0 * clock
    write_storage(tmp_path / "grf.mot", {"time": clock} | columns, False)
    arguments = changed(
        recorded_leg(tmp_path), trc=None, motion=path, grf=str(tmp_path / "grf.mot")
    )
    assert main(arguments) == 0
    assert "0.5000 to 2.5000 s are used" in capsys.readouterr().out
    write_storage(tmp_path / "grf.mot", {"time": clock + 9.0} | columns, False)
    assert main(changed(arguments, out=str(tmp_path / "other"))) == 2
    assert "give files of one trial" in capsys.readouterr().err


def test_the_rules_name_existing_options():
    for command, rules in RULES.items():
        names = set(options_of(PARSERS[command]))
        for rule in rules:
            assert {rule.option, *rule.needs, *rule.excludes} <= names


SCENE = fast_scene()


@pytest.mark.slow
def test_no_cache_writes_no_cache(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "kept"))
    run = ["run", str(SCENE), "--frames", "50:51", "--resolution", "1.5", "--contact"]
    first, second = tmp_path / "first", tmp_path / "second"
    assert main([*run, "lattice-linear", "--out", str(first), "--no-cache"]) == 0
    assert not (tmp_path / "kept").exists()
    assert main([*run, "lattice-linear", "--out", str(second)]) == 0
    assert any((tmp_path / "kept").iterdir())
    assert main([*run, "foundation", "--out", str(tmp_path / "third"), "--no-cache"]) == 2
    assert "'foundation' has no cache on disk" in capsys.readouterr().err
    assert not (tmp_path / "third").exists()


@pytest.mark.parametrize(("setting", "threads"), [({}, "1"), ({"OMP_NUM_THREADS": "3"}, "3")])
def test_blas_uses_one_thread_unless_the_environment_sets_a_number(setting, threads):
    code = (
        "import os, sys; from tkamb.cli import main; main(['contact', 'list']); "
        "print(os.environ['OMP_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    process = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | setting,
        capture_output=True,
        text=True,
        check=True,
    )
    assert process.stdout.splitlines()[-1] == threads
