"""Other forms of subject JW's model that OpenSim reads give the same patient and forces."""

import csv
import re
from pathlib import Path

import pytest

from tkamb.cli import main

JW = Path(__file__).parents[2] / "shared" / "data" / "jw"
pytestmark = pytest.mark.skipif(
    not JW.is_dir(), reason="subject JW's files are not beside the project"
)
FORCES_N = {2.275: 1039.0, 2.675: 838.0, 3.475: 1006.0, 3.675: 861.0}
"""Time (s) -> total contact force (N) of the original model, by an earlier version of tkamb.

The contact model is the elastic foundation at a resolution of 3 mm.
"""


def original() -> str:
    return (JW / "JW.osim").read_text(encoding="utf-8")


def cut(text: str, tag: str, folder: Path) -> str:
    """Move a set of the model into its own file; return the text that refers to this file."""
    match = re.search(rf"<{tag} .*?</{tag}>", text, re.S)
    assert match
    document = f'<OpenSimDocument Version="40000">{match[0]}</OpenSimDocument>'
    (folder / f"{tag}.xml").write_text(document, encoding="utf-8")
    return text.replace(match[0], f'<{tag} file="{tag}.xml"/>')


def massless(text: str, inertia: str) -> str:
    """Return the text of the model with two bodies that have zero mass and the given inertia."""
    for name in ("tibial_tray", "femoral_component"):
        begin = text.index(f'<Body name="{name}">')
        end = text.index("</Body>", begin)
        body = re.sub(r"<mass>.*?</mass>", "<mass>0</mass>", text[begin:end])
        body = re.sub(r"<inertia>.*?</inertia>", f"<inertia>{inertia}</inertia>", body)
        text = text[:begin] + body + text[end:]
    return text


def translations_first(joint: re.Match) -> str:
    """Return a joint with the axes of its translations before those of its rotations."""
    axis = re.compile(r'<TransformAxis name="\w+">.*?</TransformAxis>', re.S)
    parts = axis.findall(joint[0])
    new = iter(parts[3:] + parts[:3])
    return axis.sub(lambda _: next(new), joint[0])


def form(name: str, folder: Path) -> bytes:
    """Return the model in one of its other forms."""
    text = original()
    if name == "ampersand":
        return text.replace("<gravity>", "<credits>A., & B.</credits><gravity>", 1).encode()
    if name == "Latin-1":
        return text.replace("<gravity>", "<credits>Müller</credits><gravity>", 1).encode("latin-1")
    if name == "massless":
        return massless(text, "1 1 1 0 0 0").encode()
    if name == "axes":  # OpenSim goes by the names of the axes, not by their order
        pattern = r"<CustomJoint name=.*?</CustomJoint>"
        return re.sub(pattern, translations_first, text, flags=re.S).encode()
    if name == "z up":
        begin = text.index('<PhysicalOffsetFrame name="ground_offset">')
        end = text.index("</PhysicalOffsetFrame>", begin)
        turn = "<orientation>1.5707963267948966 0 0</orientation>"
        frame = re.sub("<orientation>.*?</orientation>", turn, text[begin:end])
        assert turn in frame
        text = text[:begin] + frame + text[end:]
        return re.sub("<gravity>.*?</gravity>", "<gravity>0 0 -9.80665</gravity>", text).encode()
    if name == "Unassigned":
        return re.sub("(<length_units>).*?<", r"\1Unassigned<", text).encode()
    sets = ("ConstraintSet", "ForceSet", "MarkerSet", "BodySet", "JointSet")
    for tag in sets if name == "every set" else (name,):
        text = cut(text, tag, folder)
    return text.encode()


def imported(model: Path, out: Path) -> Path:
    """Import the gait trial og3 with a model; return the path of the scene."""
    mesh = JW / "geometry"
    arguments = ["import", model, "--c3d", JW / "motion" / "jw_ngait_og3.c3d", "--side", "right"]
    arguments += ["--mass-kg", "66.7", "--femoral", mesh / "femoral_component.stl"]
    arguments += ["--insert", mesh / "tibial_insert.stl", "--patella", mesh / "patellar_button.stl"]
    arguments += ["--mesh-unit", "m", "--mesh-axes=-x,+y,-z", "--out", out]
    assert main([str(word) for word in arguments]) == 0
    return out / "scene.toml"


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    return imported(JW / "JW.osim", tmp_path_factory.mktemp("reference") / "out")


FORMS = ("ampersand", "axes", "z up", "Latin-1", "ConstraintSet", "ForceSet", "MarkerSet")
FORMS = (*FORMS, "every set", "massless", "Unassigned")


@pytest.mark.parametrize(
    "name",
    [*FORMS[:3], *(pytest.param(name, marks=pytest.mark.slow) for name in FORMS[3:])],
)
def test_another_form_gives_the_same_patient(tmp_path, reference, name):
    (tmp_path / "JW.osim").write_bytes(form(name, tmp_path))
    scene = imported(tmp_path / "JW.osim", tmp_path / "out")
    if name == "massless":  # the inertia of a massless body is ignored, so zeros give the same
        (tmp_path / "JW.osim").write_text(massless(original(), "0 0 0 0 0 0"), encoding="utf-8")
        reference = imported(tmp_path / "JW.osim", tmp_path / "zero")
    text, reference_text = (
        re.sub(r'"[^"]*shared', '"shared', path.read_text(encoding="utf-8"))
        for path in (scene, reference)
    )
    assert text == reference_text
    urdfs = [path.with_name("patient.urdf").read_bytes() for path in (scene, reference)]
    assert urdfs[0] == urdfs[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ampersand", "ConstraintSet", "massless", "axes", "z up"])
def test_another_form_gives_the_same_forces(tmp_path, name):
    (tmp_path / "JW.osim").write_bytes(form(name, tmp_path))
    scene = imported(tmp_path / "JW.osim", tmp_path / "out")
    run = ["run", str(scene), "--contact=foundation", "--resolution=3", "--frames=0:56:6"]
    assert main([*run, f"--out={tmp_path / 'results'}"]) == 0
    with (tmp_path / "results" / "results.csv").open() as file:
        rows = {
            round(float(r["time_s"]), 3): float(r["force_total_N"]) for r in csv.DictReader(file)
        }
    for time, force in FORCES_N.items():
        assert rows[time] == pytest.approx(force, abs=1.0)
