"""The scenes of subject DM's nine overground trials, for scripts/validation/freeze_predictions."""

from pathlib import Path

from tkamb.io.importing.patient import import_patient, write_patient
from tkamb.io.importing.scene_text import ImportRequest, Meshes

MASS_KG = 69.98
TRIALS = {
    "ngait_og1": "walking",
    "ngait_og3": "walking",
    "ngait_og4": "walking",
    "ngait_og5": "walking",
    "ngait_og6": "walking",
    "ngait_og7": "walking",
    "ngait_og9": "walking",
    "smooth1": "walking",
    "bouncy5": "walking",
}
"""Trial -> activity. smooth1 and bouncy5 are changed gaits."""
GAPS = ("ngait_og7",)
"""Trials in which a segment shows two markers for some frames: the chain is fitted."""


def walk_scene(data: Path, trial: str, folder: Path) -> Path:
    """Return the path of a trial's scene in its folder below `folder`; it is imported if needed.

    The markers are registered with the motion of all nine trials.
    """
    scene = folder / trial / "scene.toml"
    if scene.exists():
        return scene
    geometry, motion = data / "geometry", data / "motion"
    meshes = Meshes(
        geometry / "femoral_component.stl",
        geometry / "tibial_insert.stl",
        geometry / "patellar_button.stl",
        "m",
        "-x,+y,-z",
        geometry / "bone_femur.stl",
    )
    request = ImportRequest(
        data / "DM.osim",
        "right",
        MASS_KG,
        motion / f"DM_{trial}_new.trc",
        grf=motion / f"DM_{trial}_grf.sto",
        register=True,
        companions=tuple(motion / f"DM_{other}_new.trc" for other in TRIALS if other != trial),
        meshes=meshes,
        method="chain" if trial in GAPS else "segments",
        activity=TRIALS[trial],
        muscles=True,
    )
    patient = import_patient(request, scene.parent)
    lines = write_patient(patient, scene.parent, scene.name)
    print("\n".join([f"== {trial}", *patient.report, *lines]), flush=True)
    return scene
