"""Check of a whole scene, before anything is run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tkamb.contact.registry import contact_model
from tkamb.io.given_material import given_material
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.run.mechanics import Mechanics
from tkamb.run.plausibility.plausibility import Plausibility
from tkamb.run.read_scene import mechanics_of
from tkamb.run.summary import assumptions, not_modelled
from tkamb.show.check.inventory import Entry, inventory


@dataclass(frozen=True, eq=False)
class SceneCheck:
    """Content of a scene, parts that are not modelled, and questions.

    Args:
        scene: its file.
        case: the scene with its files read.
        mechanics: its body side, prepared.
        entries: content of each file and table.
        not_modelled: parts that the scene leaves out.
        assumptions: assumptions of the results.
        questions: unlikely values, with the likely mistake.
        answered: questions that the scene answers.
        missing: packages that a run needs and that are not installed, with the command to install
        them.
    """

    scene: Path
    case: Case
    mechanics: Mechanics
    entries: tuple[Entry, ...]
    not_modelled: tuple[str, ...]
    assumptions: tuple[str, ...]
    questions: tuple[str, ...]
    answered: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the check as lines of text."""
        nothing = ["none: nothing unlikely was found, which does not prove that all is right"]
        return [
            *(f"missing: {sentence}" for sentence in self.missing),
            f"{self.scene}: can be run{' when that is installed' if self.missing else ''}",
            *(entry.line() for entry in self.entries),
            f"not modelled: {', '.join(self.not_modelled)}",
            *(f"assumed: {sentence}" for sentence in self.assumptions),
            *(f"question: {question}" for question in self.questions or nothing),
            *self.answered,
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return what `tkamb check --json` prints."""
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
            "questions": list(self.questions),
            "answered": list(self.answered),
            "missing": list(self.missing),
        }


def check_scene(
    path: str | Path,
    overrides: dict[str, Any] | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> SceneCheck:
    """Read every file of a scene and ask about unlikely values; nothing is run.

    The contact model is made, but not prepared: a mesh that it cannot use is found by a run.

    Args:
        path: of the scene.
        overrides: dotted key -> value, as `tkamb.load_scene` takes them.
        begin: called with the name of each stage.

    Raises:
        InputError: what `tkamb run` would refuse of the scene and its files.
    """
    begin("reading the scene and its files")
    scene = load_scene(path, overrides)
    if scene.contact:
        contact_model(scene.contact.model, scene.contact.resolution_mm, **scene.contact.options)
        given_material(scene.insert_material)
    case = load_case(scene)
    begin("placing leg, patella and muscles")
    mechanics = mechanics_of(case)
    begin("checking for unlikely values")
    plausibility = Plausibility(case, mechanics)
    return SceneCheck(
        Path(path),
        case,
        mechanics,
        inventory(case, mechanics),
        (*not_modelled(case), *_beyond(case)),
        tuple(assumptions(case)),
        tuple(question.text for question in plausibility.questions),
        plausibility.answered,
        _missing(case),
    )


def _missing(case: Case) -> tuple[str, ...]:
    """Return the packages that a run of the case needs and that are not installed."""
    if not case.scene.muscles:
        return ()
    from tkamb.run.muscles.sharing import solver_is_installed, solver_missing

    return () if solver_is_installed() else (str(solver_missing()),)


def _beyond(case: Case) -> list[str]:
    """Return the parts that no table of a scene can model, as far as they concern this scene."""
    others = [] if case.scene.muscles else ["muscles other than the quadriceps"]
    patella = ["out-of-plane motion of the patella"] if case.scene.patella else []
    post = [] if case.post is not None else ["cam–post contact"]
    return [*others, *patella, *post, "wear and creep (`tkamb wear`)"]
