"""Mistakes in a scene are refused, flagged, or without effect on the results."""

import csv
import itertools
import json

import numpy as np
import pytest

from mistakes import DATA, dm_bench, keep_meshes, set_key, shipped_bench
from random_mistakes import random_mistakes
from scenes import MODEL, write_scene
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.run.results import Results

needs_dm = pytest.mark.skipif(not DATA.is_dir(), reason="needs the data of subject DM")


@pytest.fixture(scope="module")
def cached_meshes():
    with pytest.MonkeyPatch.context() as patch:
        keep_meshes(patch)
        yield


@pytest.fixture(scope="module")
def knee(cached_meshes, tmp_path_factory):
    """Return the bench of the shipped knee."""
    return shipped_bench(tmp_path_factory.mktemp("knee"))


@pytest.fixture(scope="module")
def dm(cached_meshes, tmp_path_factory):
    """Return the bench of subject DM."""
    return dm_bench(tmp_path_factory.mktemp("dm"))


def urdf(old, new):
    """Return an edit that replaces a text of the URDF."""

    def edit(content, texts):
        assert old in texts["patient.urdf"]
        texts["patient.urdf"] = texts["patient.urdf"].replace(old, new, 1)

    return edit


def key(dotted, value):
    """Return an edit that sets a key of the scene."""
    return lambda content, texts: set_key(content, dotted, value)


def cells(name, column, change, row=None):
    """Return an edit that changes one cell of a column, or all of them."""

    def edit(content, texts):
        rows = list(csv.reader(texts[name].splitlines()))
        k = rows[0].index(column)
        for cell in rows[1:] if row is None else [rows[row]]:
            cell[k] = change if isinstance(change, str) else repr(float(change(float(cell[k]))))
        texts[name] = "\n".join(",".join(cells) for cells in rows) + "\n"

    return edit


def series(*edits):
    """Return an edit that applies several edits."""

    def edit(content, texts):
        for part in edits:
            part(content, texts)

    return edit


def text(name, change):
    """Return an edit of a whole file."""
    return lambda content, texts: texts.update({name: change(texts[name])})


INNER = '<parent link="knee_ap_link"/><child link="knee_si_link"/><origin xyz="'
MASS = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LINES = '<limit lower="-0.2" upper="0.2" effort="1e6" velocity="1e3"/>'

REFUSED = {
    "continuous": (urdf('"knee_flexion" type="revolute"', '"knee_flexion" type="continuous"'),
                   "'knee_flexion' is continuous .* must be revolute"),
    "inner origin": (urdf(INNER + "0 0 0", INNER + "0 0.003 0"), "'knee_si' has an origin"),
    "inner rpy": (urdf(INNER + '0 0 0"', INNER + '0 0 0" rpy="0.05 0 0"'),
                  "'knee_si' has an origin .* in the chain"),
    "inner mass": (urdf('<link name="knee_ml_link"/>',
                        f'<link name="knee_ml_link">{MASS}</inertial></link>'),
                   "link 'knee_ml_link' has a mass"),
    "order": (series(urdf('"knee_axial_rotation" type', '"spare" type'),
                     urdf('"knee_adduction" type', '"knee_axial_rotation" type'),
                     urdf('"spare" type', '"knee_adduction" type'),
                     urdf('xyz="0 -1 0"', 'xyz="spare"'),
                     urdf('xyz="-1 0 0"', 'xyz="0 -1 0"'),
                     urdf('xyz="spare"', 'xyz="-1 0 0"')),
              "has parent .*the order is tibia, knee_ap, knee_si, knee_ml, knee_axial_rotation"),
    "hip on patella": (urdf('<parent link="femur"/><child link="hip"/>',
                            '<parent link="patella"/><child link="hip"/>'),
                       "link 'hip' is not fixed to 'femur'"),
    "hip far": (urdf("0 0.424383 0", "0 100 0"), "beyond 10 m; give xyz in metres"),
    "hip in mm": (urdf("0 0.424383 0", "0 424.383 0"), "give xyz in metres, not in millim"),
    "inertia term": (urdf(' iyz="0"', ""), "has no iyz; give all six"),
    "no limits": (urdf(LINES, ""), "'knee_ap' has no complete <limit>"),
    "misspelt attribute": (urdf('<origin xyz="0 0.411838 0"', '<origin xzy="0 0.411838 0"'),
                           "unknown attribute xzy of <origin>; did you mean xyz"),
    "1e308": (cells("motion.csv", "flexion_deg", "1e308", 40), "which is no measurement"),
    "upside down": (key("implant.femoral.axes", "+x,-y,-z"), "check the axes of the mesh"),
    "1e5": (cells("motion.csv", "flexion_deg", "1e5", 40), "flexion runs .* no knee does"),
    "+360": (cells("motion.csv", "flexion_deg", lambda v: v + 360, 40), "no knee does"),
    "patella": (cells("motion.csv", "patella_rotation_deg", lambda v: v + 360, 40),
                "patella_rotation runs .* no knee does"),
    "lean of 210": (cells("tibia.csv", "lean_deg", "210", 30), "angle runs .* no shank does"),
    "milliseconds": (cells("motion.csv", "time_s", lambda v: 1e-3 * v), "time is in seconds"),
    "underscore": (cells("motion.csv", "flexion_deg", "1_000", 40), "plain decimal"),
    "Arabic digits": (cells("motion.csv", "flexion_deg", "٣٠", 40), "plain decimal"),
    "decimal commas": (text("motion.csv", lambda t: t.replace(".", ",")), "not commas"),
    "commas and points": (
        text("tibia.csv", lambda t: t.replace(",", ";").replace(".", ",", 3)), "one decimal sign"),
    "stiffness": (key("ligament.0.stiffness_N_per_mm", 91250.0), "give it in N/mm, not in N/m"),
    "true": (key("patient.mass_kg", True), "not true"),
    "no list": (key("contact.released", "adduction"), r'is not a list; .*\["adduction"\]'),
    "in quotes": (key("patient.mass_kg", "75"), 'not "75" in quotes'),
    "mass of 500": (key("patient.mass_kg", 500.0), "not within 20 to 300; give it in kilograms"),
    "mass of 0.075": (key("patient.mass_kg", 0.075), "not within 20 to 300"),
    "height in m": (key("patient.height_mm", 1.75),
                    "not within 1000 to 2300; give the standing height in milli"),
    "femur too low": (key("implant.femoral.position_mm", [0.0, -8.0, 0.0]), "is near the insert"),
    "strain in per cent": (series(key("ligament.0.slack_length_mm", None),
                                  key("ligament.0.reference_strain", 2.0)),
                           "a strain, not per cent"),
    "exchanged meshes": (series(key("implant.femoral.mesh", str(MODEL / "insert.stl")),
                                key("implant.insert.mesh", str(MODEL / "femoral_component.stl"))),
                         "are exchanged"),
    "side": (key("patient.side", "left"), "correct .* side, which is 'left'"),
    "left-handed": (key("ground_reaction.laboratory_axes", "+x,+y,-z"), "left-handed"),
    "left-handed mesh": (key("implant.femoral.axes", "+x,+y,-z"), "left-handed"),
    "unknown key": (series(key("motion.length_unit", None), key("motion.lenght_unit", "mm")),
                    "unknown key 'motion.lenght_unit'; did you mean length_unit"),
    "unknown table": (series(key("motin", {}), key("motion", None)),
                      "unknown key 'motin'; did you mean motion"),
    "key of another table": (key("contact.mass_kg", 75.0), r"'mass_kg' is a key of \[patient\]"),
    "model": (key("contact.model", "latice"), "did you mean lattice"),
    "material": (key("contact.material", "polyetylene"), "did you mean polyethylene"),
    "column": (key("motion.columns.flexion", "flexion"),
               "no column 'flexion'; did you mean flexion_deg.* its header: time_s, flexion_deg"),
    "role": (key("motion.columns.flxion", "flexion_deg"), "unknown role 'flxion'.*did you mean"),
    "link": (key("quadriceps.origin.link", "femurr"), "did you mean femur"),
}  # fmt: skip

FLAGGED = {
    "centre in metres": (
        series(*(cells("ground_reaction.csv", f"point_{a}_mm", lambda v: 1e-3 * v) for a in "xyz")),
        "is it in centimetres or metres?"),
    "centre's sign": (cells("ground_reaction.csv", "point_x_mm", lambda v: -v),
                      "mm behind the ankle.*not under the foot.*is its sign"),
    "point in metres": (key("ligament.0.proximal.point_mm", [0.0015, 0.0005, -0.042]),
                        "is point_mm in metres?"),
    "pounds": (key("patient.mass_kg", 165.3), "pounds?"),
    "body weights": (
        series(*(cells("ground_reaction.csv", f"force_{a}_N", lambda v: v / 736) for a in "xyz")),
        "is it in body weights"),
    "radians": (cells("motion.csv", "flexion_deg", np.deg2rad), "flexion runs .*in radians?"),
    "slack length": (key("ligament.0.slack_length_mm", 70.0), "would strain beyond"),
    "one sample": (cells("motion.csv", "axial_rotation_deg", lambda v: v + 3, 60),
                   "off its neighbours' curve"),
    "URDF in pounds": (urdf("10.620000", "23.413"), "pounds?"),
    "centimetres": (key("patient.height_mm", 1200.0), "of the body height"),
    "lean in radians": (cells("tibia.csv", "lean_deg", np.deg2rad), "angle in radians?"),
    "lean's sign": (cells("tibia.csv", "lean_deg", lambda v: -v), "the hip is # mm behind .*lean"),
    "back to front": (key("implant.femoral.axes", "-x,+y,-z"), "is it back to front"),
    "insertion in centimetres": (key("quadriceps.insertion.point_mm", [0.8, 2.0, 0.0]),
                                 "# mm above the patellar ligament's"),
    "patella in centimetres": (
        series(*(cells("motion.csv", f"patella_{a}_mm", lambda v: v / 10) for a in ("ap", "si"))),
        "patella lies # to # mm from the flexion axis"),
    "origin behind the femur": (key("quadriceps.origin.point_mm", [-32.0, 205.0, 0.0]),
                                "quadriceps. origin: no such line ends there"),
    "friction": (key("contact.friction", 0.5), "friction of # is more than metal"),
    "opening backward": (key("implant.femoral.axes", "-y,+x,+z"), "opens backward.* is it turned"),
    "insert back to front": (key("implant.insert.axes", "-x,+y,-z"), "insert is cut out in front"),
    "button's dome on the bone": (key("implant.patella.axes", "-x,+y,-z"), "flat .*faces backward"),
    "button on edge": (key("implant.patella.axes", "+y,-x,+z"), "flat side faces downward"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_an_impossible_input_is_refused(knee, name):
    edit, words = REFUSED[name]
    outcome = knee.outcome(edit)
    with pytest.raises(InputError, match=words):
        raise InputError(outcome.refused)


@pytest.mark.parametrize("name", FLAGGED)
def test_an_unlikely_input_is_flagged_in_its_frames(knee, name):
    import re

    edit, words = FLAGGED[name]
    outcome = knee.outcome(edit)
    assert not outcome.refused
    assert any(re.search(words, word) for word in outcome.words), outcome.words
    if name not in ("one sample", "lean's sign"):  # these do not affect all frames
        assert {word.partition(":")[0] for word in outcome.words} >= {"0", "2", "4"}


def test_the_shipped_knee_raises_no_question(knee):
    assert not knee.untouched.refused
    assert not knee.untouched.words


def assert_none_passes(bench, rng, counts):
    """Assert that random mistakes are noticed or leave all forces unchanged."""
    silent_mistakes = []
    for name, edit in random_mistakes(bench, rng, *counts):
        outcome = bench.outcome(edit)
        assert "\n" not in outcome.refused
        if not outcome.notices(bench.untouched) and not outcome.same(bench.untouched):
            silent_mistakes.append(name)
    assert not silent_mistakes


def test_no_random_mistake_is_silent(knee):
    assert_none_passes(knee, np.random.default_rng(0), (20, 20))


@needs_dm
def test_no_random_mistake_is_silent_on_dm(dm):
    assert_none_passes(dm, np.random.default_rng(1), (3, 3))


def turned_axes():
    """Yield the 23 wrong right-handed axes of a part."""
    for names in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            rotation = np.diag(signs) @ np.eye(3)[list(names)]
            words = ",".join(f"{'+-'[s < 0]}{'xyz'[n]}" for s, n in zip(signs, names, strict=True))
            if np.linalg.det(rotation) > 0 and words != "+x,+y,+z":
                yield words


@pytest.mark.slow
@pytest.mark.parametrize("part", ["femoral", "insert", "patella"])
def test_a_part_with_any_other_axes_is_noticed(knee, part):
    ways = [axes for axes in turned_axes() if part != "patella" or not axes.startswith("+x")]
    assert len(ways) == (20 if part == "patella" else 23)  # a dome may be turned about its axis
    outcomes = {axes: knee.outcome(key(f"implant.{part}.axes", axes)) for axes in ways}
    assert [axes for axes, result in outcomes.items() if not result.notices(knee.untouched)] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_no_mistake_of_many_is_silent(knee, seed):
    assert_none_passes(knee, np.random.default_rng(100 + seed), (40, 60))


@needs_dm
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_no_mistake_of_many_is_silent_on_dm(dm, seed):
    assert_none_passes(dm, np.random.default_rng(200 + seed), (20, 30))


def test_a_question_is_on_stderr_in_summary_report_and_status(tmp_path, capfd):
    scene = write_scene(tmp_path / "scene", ("contact", "ligament"), patient__mass_kg=165.3)
    out = tmp_path / "out"
    assert main(["run", str(scene), "--out", str(out), "--frames", "0:100:50"]) == 0
    output = capfd.readouterr().err
    assert "tkamb: question: " in output
    assert "in pounds?" in output
    summary = json.loads((out / "summary.json").read_text())
    assert any("in pounds?" in question for question in summary["questions"])
    assert summary["flagged_frames"] == 2
    report = (out / "report.html").read_text()
    assert '<div class="card warning"><h3>Questions to answer' in report
    with (out / "results.csv").open() as file:
        assert all("disagree" in row["status"] for row in csv.DictReader(file))


def test_a_message_names_the_option_of_a_wrong_key(tmp_path, capfd):
    scene = write_scene(tmp_path)
    assert main(["run", str(scene), "--set", "contact.fricton=0.1"]) == 2
    assert "--set contact.fricton: unknown key" in capfd.readouterr().err
    assert main(["run", str(scene), "--set", "contact.released=adduction"]) == 2
    assert """--set 'contact.released=["adduction"]'""" in capfd.readouterr().err


def test_a_misspelt_column_gets_a_suggestion():
    results = Results({"time_s": [0.0], "status": ["ok"]})
    with pytest.raises(InputError, match="no column 'forse_total_N'; did you mean force_total_N"):
        results["forse_total_N"]


def test_an_answered_question_is_a_note_and_no_flag(tmp_path, capfd):
    answers = {"in pounds?": "weighed with a load of 90 kg"}
    table = {"patient__mass_kg": 165.3, "output__answers": answers}
    scene = write_scene(tmp_path / "scene", ("contact", "ligament"), **table)
    out = tmp_path / "out"
    assert main(["run", str(scene), "--out", str(out), "--frames", "0:100:50"]) == 0
    assert "pounds" not in capfd.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["questions"] == []
    assert any("pounds? weighed with a load" in note for note in summary["notes"])
    with (out / "results.csv").open() as file:
        assert not any("disagree" in row["status"] for row in csv.DictReader(file))


@pytest.mark.parametrize(
    ("answers", "words"),
    [({"in stones": "no"}, "no question holds 'in stones'"), ({"in pounds?": " "}, "no answer")],
)
def test_an_answer_without_question_or_reason_is_refused(tmp_path, capfd, answers, words):
    table = {"patient__mass_kg": 165.3, "output__answers": answers}
    scene = write_scene(tmp_path / "scene", ("contact", "ligament"), **table)
    assert main(["run", str(scene), "--out", str(tmp_path / "out")]) == 2
    assert words in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
