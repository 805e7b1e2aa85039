"""Check of a scene before a run: content of each file, and implausible values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.registry import contact_model_in_mm
from tkamb.geometry.defects import mesh_words
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import (
    given_material,
    material_as_json,
    material_in_words,
)
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.run.plausibility.plausibility import Plausibility
from tkamb.run.read_scene import STRAIN_FLEXIONS, recording_of
from tkamb.run.recording import Recording
from tkamb.run.summary import assumptions, not_modelled
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.io.recordings.measured import MeasuredForce


ANGLES = ("flexion", "adduction", "axial_rotation")


# 1: ligament bundles with a larger strain are listed. Ligaments of the knee rupture
# at 12 to 20 %.
HIGH_STRAIN = 0.1


@dataclass(frozen=True)
class Entry:
    """One part of the scene.

    Args:
        file: file of the part; None: the scene file.
    """

    part: str
    file: Path | None
    found: str

    def line(self) -> str:
        """Return the entry as one line of text."""
        where = "" if self.file is None else f" ({self.file.name})"
        return f"{self.part}{where}: {self.found}"


def inventory(case: Case, recording: Recording) -> tuple[Entry, ...]:
    """Return the content of every file and table of a case."""
    result = [_patient(case), _motion(case)]
    if case.scene.tibia or case.motion.markers:
        result.append(_shank(case))
    if case.ground is not None:
        result.append(_ground(case))
    result += _surfaces(case)
    if recording.ligaments:
        result.append(_ligaments(recording))
    if case.muscles:
        result.append(_extensor(case))
    if case.scene.muscles:
        file = case.scene.muscles.model
        result.append(Entry("muscles", file, "all of the leg, by static optimisation"))
    if case.emg is not None:
        text = f"channels {', '.join(case.emg.values)}, {_span(case.emg.time)}"
        result.append(Entry("EMG", case.emg.path, text))
    if case.scene.contact:
        result.append(_contact(case))
    if case.measured is not None:
        result.append(_measured(case.measured, case.body_weight))
    return tuple(result)


def _patient(case: Case) -> Entry:
    patient, chain = case.scene.patient, case.chain
    masses = ", ".join(f"{link} {chain.segment(link)[0]:.2f} kg" for link in ("tibia", "femur"))
    text = (
        f"{patient.side} knee, {patient.mass_kg:g} kg (1 BW is {case.body_weight:.0f} N); "
        f"masses with everything fixed to the link: {masses}"
    )
    return Entry("patient", patient.urdf, text)


def _motion(case: Case) -> Entry:
    motion, table = case.motion, case.scene.motion
    duration = motion.time[-1] - motion.time[0]
    rate = (len(motion.time) - 1) / duration
    ranges = []
    for name, values in zip(KNEE_COORDINATES, motion.coordinates.T, strict=True):
        if name in motion.unrecorded:
            ranges.append(f"{name} not recorded")
        elif name in ANGLES:
            ranges.append(_range(name, values / DEGREE, "deg", 1))
        else:
            ranges.append(_range(name, values / MILLIMETRE, "mm", 1))
    text = (
        f"{len(motion.time)} frames, {motion.time[0]:.3g} to {motion.time[-1]:.3g} s, "
        f"{rate:.0f} a second; {', '.join(reversed(ranges))}{_in_words(case)}"
    )
    return Entry("motion", table.file, text)


def _in_words(case: Case) -> str:
    """Return AP and axial rotation over flexion in words, to check their signs."""
    motion = case.motion
    if {"ap", "axial_rotation"} & set(motion.unrecorded):
        return ""
    values = dict(zip(KNEE_COORDINATES, motion.coordinates.T, strict=True))
    flexion = values["flexion"] / DEGREE
    first, last = int(flexion.argmin()), int(flexion.argmax())
    ap = (values["ap"][last] - values["ap"][first]) / MILLIMETRE
    turn = (values["axial_rotation"][last] - values["axial_rotation"][first]) / DEGREE
    return (
        f"; from {flexion[first]:.0f} to {flexion[last]:.0f} deg of flexion the femur moves "
        f"{abs(ap):.1f} mm {'forward' if ap > 0 else 'backward'} on the insert and turns "
        f"{abs(turn):.1f} deg {'outward' if turn > 0 else 'inward'}"
    )


def _shank(case: Case) -> Entry:
    if case.tibia is None:
        raise ValueError("a shank that was read has a motion")
    up = case.tibia.pose[:, :3, 1]
    lean = np.arctan2(up[:, 0], up[:, 1]) / DEGREE
    height = case.tibia.pose[:, 1, 3] / MILLIMETRE
    text = f"{_range('forward lean', lean, 'deg', 0)}, {_range('ankle height', height, 'mm', 0)}"
    file = case.scene.tibia.file if case.scene.tibia else case.scene.motion.file
    return Entry("tibia", file, text)


def _ground(case: Case) -> Entry:
    ground, table = case.ground, case.scene.ground_reaction
    assert ground is not None and table is not None
    vertical = ground.force[:, 1] / case.body_weight
    loaded = f"foot loaded in {int(np.sum(ground.loaded))} of {len(vertical)} frames"
    place = "at the ankle" if table.applied == "ankle" else "at the centre of pressure"
    remark = ", signs turned: force on the plate" if table.force == "on the plate" else ""
    text = f"{_range('vertical', vertical, 'BW', 2)}, {loaded}; applied {place}{remark}"
    return Entry("ground reaction", table.file, text)


def _surfaces(case: Case) -> list[Entry]:
    implant = case.scene.implant
    parts = (
        ("femoral component", implant.femoral, case.femoral),
        ("insert", implant.insert, case.insert),
        ("patellar button", implant.patella, case.patella),
    )
    return [
        Entry(name, table.mesh, _surface(surface))
        for name, table, surface in parts
        if table is not None and surface is not None
    ]


def _surface(surface: Surface) -> str:
    size = np.ptp(surface.bounds, axis=0) / MILLIMETRE
    return (
        f"{len(surface.faces)} triangles, {size[0]:.1f} mm anterior–posterior, "
        f"{size[1]:.1f} high, {size[2]:.1f} wide"
        + "".join(f"; {words}" for words in mesh_words(surface))
    )


def _ligaments(recording: Recording) -> Entry:
    strains = recording.strains
    strained = [
        f"{name} {100 * value:.0f} % at {flexion:.0f} deg"
        for name, values in strains.items()
        for flexion, value in zip(STRAIN_FLEXIONS, values, strict=True)
        if value > HIGH_STRAIN
    ]
    text = f"{len(recording.ligaments)} bundles: {_listed([b.name for b in recording.ligaments])}"
    finite = np.array([v for values in strains.values() for v in values if np.isfinite(v)])
    if len(finite):
        text += f"; {_range('strain', 100 * finite, '%', 1)} at the recorded pose"
    return Entry(
        "ligaments", None, text + (f"; over 10 %: {', '.join(strained)}" if strained else "")
    )


def _listed(names: Sequence[str]) -> str:
    """MCL1, MCL2, MCL3 are abbreviated as MCL1–3."""
    text: list[str] = []
    for stem, group in groupby(names, lambda name: name.rstrip("0123456789")):
        members = list(group)
        first, last = members[0][len(stem) :], members[-1][len(stem) :]
        counted = [f"{stem}{k}" for k in range(int(first), int(last) + 1)] if first and last else []
        abbreviate = len(members) > 2 and members == counted
        text += [f"{members[0]}–{last}"] if abbreviate else members
    return ", ".join(text)


def _extensor(case: Case) -> Entry:
    assert case.scene.patella is not None
    names = ", ".join(muscle.name for muscle in case.muscles)
    text = f"{names}; patella's motion {case.scene.patella.motion}"
    if released := case.scene.patella.released:
        heads = [f"{100 * head.share:.3g} % {head.name}" for head in case.patella_heads]
        text += (
            f"; released: {', '.join(released)}; heads: {', '.join(heads) or names}; ligaments of "
            f"the patella: {', '.join(one.name for one in case.patella_ligaments)}"
        )
    return Entry("muscle line", None, text)


def _contact(case: Case) -> Entry:
    table = case.scene.contact
    assert table is not None
    made_of = material_in_words(material_as_json(given_material(case.scene.insert_material)))
    text = f"{table.model} at {table.resolution_mm:g} mm, {made_of}"
    if table.released:
        text += f"; solved for: {', '.join(sorted({*table.released, 'si'}))}"
    return Entry("contact", None, text)


def _measured(measured: "MeasuredForce", weight: float) -> Entry:
    forces = [
        _range(name, values[np.isfinite(values)] / weight, "BW", 2)
        for name, values in measured.force.items()
        if np.isfinite(values).any()
    ]
    text = f"{', '.join(forces)}, {_span(measured.time)}; only compared, never used"
    return Entry("measured force", measured.path, text)


def _span(time: Array) -> str:
    return f"{len(time)} samples, {time[0]:.3g} to {time[-1]:.3g} s"


def _range(name: str, values: Array, unit: str, digits: int) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    ends = [f"{one:.{digits}f}" for one in (low, high)]
    ends = [one.removeprefix("-") if float(one) == 0 else one.replace("-", "−") for one in ends]
    return f"{name} {ends[0]} to {ends[1]} {unit}"


@dataclass(frozen=True, eq=False)
class SceneCheck:
    """Content of a scene, parts that are not modelled, and questions.

    Args:
        missing: messages on packages that a run needs and that are not installed.
    """

    scene: Path
    case: Case
    recording: Recording
    entries: tuple[Entry, ...]
    not_modelled: tuple[str, ...]
    assumptions: tuple[str, ...]
    questions: tuple[str, ...]
    answered: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the check as lines of text."""
        nothing = ["note: no unlikely value was found, which does not prove that all are right"]
        return [
            *(f"missing: {sentence}" for sentence in self.missing),
            f"{self.scene}: can be run{' when that is installed' if self.missing else ''}",
            *(entry.line() for entry in self.entries),
            f"not modelled: {', '.join(self.not_modelled)}",
            *(f"assumed: {sentence}" for sentence in self.assumptions),
            *(f"notice: {remark}" for remark in self.case.remarks),
            *([f"question: {question}" for question in self.questions] or nothing),
            *self.answered,
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the output of `tkamb check --json`."""
        motion = self.case.motion
        return {
            "scene": str(self.scene),
            "frames": len(motion.time),
            "duration_s": float(motion.time[-1] - motion.time[0]),
            "inputs": [
                {"part": e.part, "file": e.file and str(e.file), "found": e.found}
                for e in self.entries
            ],
            "not_modelled": list(self.not_modelled),
            "assumptions": list(self.assumptions),
            "notices": list(self.case.remarks),
            "questions": list(self.questions),
            "answered": list(self.answered),
            "missing": list(self.missing),
        }


def check_scene(
    path: str | Path,
    overrides: dict[str, Any] | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> SceneCheck:
    """Read a scene with its files and check them for unlikely values, without a run.

    Only a run checks that the contact model can use the meshes.

    Args:
        overrides: dotted scene key -> value, see `tkamb.load_scene`.
        begin: function that is called with the name of each stage.
    """
    begin("reading the scene and its files")
    scene = load_scene(path, overrides)
    if scene.contact:
        contact_model_in_mm(scene.contact.model, scene.contact.resolution_mm, scene.contact.options)
        given_material(scene.insert_material)
    case = load_case(scene)
    begin("placing leg, patella and muscles")
    recording = recording_of(case)
    begin("checking for unlikely values")
    plausibility = Plausibility(case, recording)
    return SceneCheck(
        Path(path),
        case,
        recording,
        inventory(case, recording),
        (*not_modelled(case), *_beyond(case)),
        tuple(assumptions(case)),
        tuple(question.text for question in plausibility.questions),
        plausibility.answered,
        _missing(case),
    )


def _missing(case: Case) -> tuple[str, ...]:
    if not case.scene.muscles:
        return ()
    from tkamb.run.muscles.sharing import solver_is_installed, solver_missing

    return () if solver_is_installed() else (str(solver_missing()),)


def _beyond(case: Case) -> list[str]:
    muscles = [] if case.scene.muscles else ["muscles other than the quadriceps"]
    table = case.scene.patella
    plane = table is not None and not {"shift", "tilt", "rotation"} & set(table.released)
    patella = ["out-of-plane motion of the patella"] if plane else []
    post = [] if case.post is not None else ["cam–post contact"]
    return [*muscles, *patella, *post, "wear and creep (`tkamb wear`)"]
