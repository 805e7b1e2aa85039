"""Import paths of release 0.1, which work until release 0.3.

`from tkamb.inputs.c3d import read_c3d` imports `tkamb.io.recordings.c3d`, with a
DeprecationWarning.
"""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

FOLDERS = {
    "tkamb.body": "tkamb.knee",
    "tkamb.equilibrium": "tkamb.knee",
    "tkamb.scene": "tkamb.io.scene",
    "tkamb.inputs": "tkamb.io.recordings",
    "tkamb.importing": "tkamb.io.importing",
    "tkamb.opensim": "tkamb.io.opensim",
    "tkamb.output": "tkamb.show",
    "tkamb.uncertainty": "tkamb.studies.uncertainty",
    "tkamb.cohort": "tkamb.studies.cohort",
    "tkamb.wear": "tkamb.studies.wear",
    "tkamb.designs": "tkamb.studies.designs",
    "tkamb.check": "tkamb.show",
    "tkamb.compare": "tkamb.show",
    "tkamb.view": "tkamb.show.view",
    "tkamb.datasets": "tkamb.io.datasets",
    "tkamb.starter": "tkamb.io.starter",
    "tkamb.muscles": "tkamb.run.muscles",
    "tkamb.plausibility": "tkamb.run.plausibility",
}
"""Folder of release 0.1 -> its new folder."""
MODULES = {
    "tkamb.activities": "tkamb.io.activities",
    "tkamb.atomic": "tkamb.files",
    "tkamb.body.adjustment_effect": "tkamb.knee.adjustment",
    "tkamb.body.contributions": "tkamb.knee.crossing",
    "tkamb.body.extensor_response": "tkamb.knee.crossing",
    "tkamb.body.generic_ligaments": "tkamb.knee.ligaments",
    "tkamb.body.joint_equilibrium": "tkamb.knee.released_forces",
    "tkamb.body.ligament_sides": "tkamb.knee.ligaments",
    "tkamb.body.load_state": "tkamb.knee.unknowns",
    "tkamb.check.inventory": "tkamb.show.scene_check",
    "tkamb.claim": "tkamb.io.claim",
    "tkamb.cohort.command": "tkamb.commands.studies",
    "tkamb.cohort.folder": "tkamb.studies.cohort.run",
    "tkamb.cohort.report": "tkamb.show.cohort_report",
    "tkamb.columns": "tkamb.run.columns",
    "tkamb.compare.command": "tkamb.commands.results",
    "tkamb.compare.figures": "tkamb.show.comparison_page",
    "tkamb.compare.page": "tkamb.show.comparison_page",
    "tkamb.compare.pairing": "tkamb.show.comparison",
    "tkamb.compiled": "tkamb.geometry.compiled",
    "tkamb.contact.ellipse": "tkamb.contact.hertz",
    "tkamb.contact.lattice.flags": "tkamb.contact.lattice.report",
    "tkamb.contact.lattice.linear.memory_need": "tkamb.contact.lattice.linear.operator",
    "tkamb.contact.lattice.linear.response": "tkamb.contact.lattice.linear.compliance",
    "tkamb.contact.lattice.meshing.levels": "tkamb.contact.lattice.meshing.columns",
    "tkamb.contact.lattice.meshing.notches": "tkamb.contact.lattice.meshing.walls",
    "tkamb.contact.lattice.newton": "tkamb.contact.lattice.solver",
    "tkamb.contact.lattice.solids.bbar": "tkamb.contact.lattice.bbar",
    "tkamb.contact.lattice.solids.calibrated": "tkamb.contact.lattice.calibrated",
    "tkamb.contact.lattice.solids.cell_loops": "tkamb.contact.lattice.calibrated",
    "tkamb.contact.lattice.solids.curve": "tkamb.contact.lattice.solid",
    "tkamb.contact.lattice.solids.solid": "tkamb.contact.lattice.solid",
    "tkamb.contact.lattice.source.model": "tkamb.contact.lattice.source_lattice",
    "tkamb.contact.lattice.source.springs": "tkamb.contact.lattice.source_springs",
    "tkamb.contact.neighbourhood": "tkamb.contact.samples",
    "tkamb.contact.probe": "tkamb.contact.model",
    "tkamb.datasets.command": "tkamb.commands.import_model",
    "tkamb.datasets.dataset": "tkamb.io.datasets",
    "tkamb.datasets.get": "tkamb.io.datasets",
    "tkamb.defaults": "tkamb.io",
    "tkamb.decks": "tkamb.run.decks",
    "tkamb.designs.cam": "tkamb.studies.designs.femoral",
    "tkamb.designs.sagittal": "tkamb.studies.designs.femoral",
    "tkamb.designs.touch": "tkamb.studies.designs.design",
    "tkamb.equilibrium.adjusted_press": "tkamb.knee.adjustment",
    "tkamb.equilibrium.contact_side": "tkamb.run.contact_side",
    "tkamb.equilibrium.known": "tkamb.run.read_scene",
    "tkamb.equilibrium.mechanics": "tkamb.run.mechanics",
    "tkamb.equilibrium.post_side": "tkamb.knee.frame_contact",
    "tkamb.equilibrium.shared_muscles": "tkamb.run.muscles.shared_muscles",
    "tkamb.equilibrium.split_sensitivity": "tkamb.knee.adjustment",
    "tkamb.export_command": "tkamb.commands.results",
    "tkamb.geometry.bounds": "tkamb.geometry.closest",
    "tkamb.geometry.cut": "tkamb.geometry.post",
    "tkamb.geometry.normals": "tkamb.geometry.surface",
    "tkamb.geometry.ragged": "tkamb.geometry.topology",
    "tkamb.geometry.sections": "tkamb.geometry.polygons",
    "tkamb.geometry.subdivision": "tkamb.geometry.curved",
    "tkamb.geometry.tree": "tkamb.geometry.nearest",
    "tkamb.guard": "tkamb.run.guard",
    "tkamb.importing.command": "tkamb.commands.import_model",
    "tkamb.importing.force_columns": "tkamb.io.importing.plates",
    "tkamb.importing.shank": "tkamb.io.importing.recorded_poses",
    "tkamb.importing.standing": "tkamb.io.importing.trial",
    "tkamb.importing.toml_text": "tkamb.io.toml_text",
    "tkamb.importing.urdf": "tkamb.io.importing.links",
    "tkamb.inputs.cycle": "tkamb.io.recordings.gait_cycle",
    "tkamb.inputs.emg": "tkamb.io.recordings.measured",
    "tkamb.inputs.gait": "tkamb.io.recordings.gait_cycle",
    "tkamb.inputs.leg_chain": "tkamb.io.recordings.inverse_kinematics",
    "tkamb.inputs.measured_force": "tkamb.io.recordings.measured",
    "tkamb.inputs.plate_loads": "tkamb.io.recordings.force_plates",
    "tkamb.inputs.segments": "tkamb.io.recordings.patient",
    "tkamb.inputs.stl": "tkamb.io.recordings.polygon_files",
    "tkamb.known_errors": "tkamb.run.known_errors",
    "tkamb.memory": "tkamb.geometry.memory",
    "tkamb.mesh_command": "tkamb.commands.mesh",
    "tkamb.mesh_files": "tkamb.io.mesh_files",
    "tkamb.muscles.bones": "tkamb.run.muscles.trial",
    "tkamb.muscles.emg": "tkamb.run.muscles.sharing",
    "tkamb.muscles.hill": "tkamb.run.muscles.leg",
    "tkamb.muscles.recording": "tkamb.run.muscles.knee_trial",
    "tkamb.muscles.static_optimisation": "tkamb.run.muscles.sharing",
    "tkamb.named_classes": "tkamb.contact.named_classes",
    "tkamb.occupants": "tkamb.io.claim",
    "tkamb.opensim.elements": "tkamb.io.opensim.document",
    "tkamb.opensim.inverse_dynamics": "tkamb.io.opensim.motion",
    "tkamb.opensim.lines": "tkamb.io.opensim.model",
    "tkamb.opensim.plane_strings": "tkamb.io.opensim.geodesic",
    "tkamb.opensim.strings": "tkamb.io.opensim.wrapping",
    "tkamb.opensim.tension": "tkamb.io.opensim.paths",
    "tkamb.output.comparison": "tkamb.run.recorded",
    "tkamb.output.maps": "tkamb.run.maps",
    "tkamb.output.metrics": "tkamb.run.metrics",
    "tkamb.output.places": "tkamb.show.svg",
    "tkamb.output.reading": "tkamb.show.sections",
    "tkamb.output.tables": "tkamb.show.sections",
    "tkamb.output.vtk": "tkamb.io.vtk",
    "tkamb.output.wear": "tkamb.show.sections",
    "tkamb.plausibility.implant": "tkamb.run.plausibility.segments",
    "tkamb.plausibility.question": "tkamb.run.plausibility",
    "tkamb.plug_ins": "tkamb.run.identity",
    "tkamb.press": "tkamb.run.press",
    "tkamb.results": "tkamb.run.results",
    "tkamb.results_folder": "tkamb.run.results_folder",
    "tkamb.run.agreement": "tkamb.run.status",
    "tkamb.run.cluster": "tkamb.run.workers",
    "tkamb.run.frames": "tkamb.run.simulation",
    "tkamb.run.profiling": "tkamb.run.timing",
    "tkamb.run.recall": "tkamb.run.contact_side",
    "tkamb.run.rerun": "tkamb.run.identity",
    "tkamb.run.shards": "tkamb.run.recorder",
    "tkamb.run.stages": "tkamb.run.timing",
    "tkamb.scene.lines": "tkamb.io.scene.parts",
    "tkamb.scene.measured": "tkamb.io.recordings.recording_tables",
    "tkamb.scene.recording_tables": "tkamb.io.recordings.recording_tables",
    "tkamb.scene.table": "tkamb.io.recordings.scene_table",
    "tkamb.scene_options": "tkamb.commands.options",
    "tkamb.simulation": "tkamb.run.simulation",
    "tkamb.studies.audit": "tkamb.studies.verdict",
    "tkamb.studies.bodies": "tkamb.studies.cases",
    "tkamb.studies.command": "tkamb.commands.studies",
    "tkamb.studies.elastic_layer": "tkamb.studies.references",
    "tkamb.studies.peer": "tkamb.studies.calculix",
    "tkamb.studies.quantities": "tkamb.studies.measures",
    "tkamb.studies.row": "tkamb.studies.tradeoff",
    "tkamb.studies.tradeoff_report": "tkamb.show.tradeoff_report",
    "tkamb.threads": "tkamb.geometry.threads",
    "tkamb.uncertainty.correlation": "tkamb.studies.uncertainty.sampling",
    "tkamb.uncertainty.folder": "tkamb.studies.uncertainty.run",
    "tkamb.uncertainty.indices": "tkamb.studies.uncertainty.sensitivity",
    "tkamb.uncertainty.screening": "tkamb.studies.uncertainty.sensitivity",
    "tkamb.uncertainty.varied_case": "tkamb.studies.uncertainty.sample",
    "tkamb.view.arrows": "tkamb.show.view.lines",
    "tkamb.view.colours": "tkamb.show.view.drawing",
    "tkamb.view.film": "tkamb.show.view.page",
    "tkamb.view.shading": "tkamb.show.view.payload",
    "tkamb.view.strands": "tkamb.show.view.lines",
    "tkamb.wear.creep": "tkamb.studies.wear.materials",
    "tkamb.wear.force_control": "tkamb.studies.wear.simulator",
    "tkamb.wear.kept": "tkamb.studies.wear.run",
    "tkamb.wear.picture": "tkamb.studies.wear.report",
    "tkamb.wear.profile": "tkamb.studies.wear.simulator",
    "tkamb.wear.sample": "tkamb.studies.wear.bands",
    "tkamb.wear.springs": "tkamb.studies.wear.simulator",
    "tkamb.wear.viscoelastic_lattice": "tkamb.studies.wear.viscoelastic",
}
"""Module of release 0.1 -> its new name."""


def new_name(name: str) -> str | None:
    """Return the new name of a module of release 0.1; None: it has not moved."""
    if name in MODULES:
        return MODULES[name]
    part = name.removeprefix("tkamb.").removesuffix(".command")
    if name == f"tkamb.{part}.command" and f"tkamb.{part}" in FOLDERS:
        return f"tkamb.commands.{part}"
    for old, new in FOLDERS.items():
        if name == old or name.startswith(f"{old}."):
            return new + name[len(old) :]
    return None


class _Alias(Loader):
    """Loads a module by its new name."""

    def __init__(self, target: str) -> None:
        self.target = target
        self.own_spec: ModuleSpec | None = None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the module by its new name and return it."""
        module = import_module(self.target)
        self.own_spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's spec, which the import by the old name has replaced.

        The module has already been executed under its new name.
        """
        module.__spec__ = self.own_spec


class _MovedFinder(MetaPathFinder):
    """Finds modules by their former names."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec that imports the new module; None: the module has not moved."""
        new = new_name(fullname)
        if new is None:
            return None
        words = f"{fullname} is now {new}; the old name works until release 0.3"
        warnings.warn(words, DeprecationWarning, stacklevel=2)
        return ModuleSpec(fullname, _Alias(new), is_package=fullname in FOLDERS)


def accept_old_names() -> None:
    """Make former import paths work. Repeated calls have no effect."""
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _MovedFinder())  # before Python searches a moved folder
