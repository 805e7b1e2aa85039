"""OpenSim's tools on a trial. The package `opensim` is needed."""

import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from jw_gait import JW, Gait
from tkamb.geometry.frames import Array
from tkamb.io.recordings.tables import read_table
from tkamb.show.storage import write_storage

UNBALANCED = 1e4
"""Optimal force of actuators on coordinates without a reserve, N or N·m."""


class Tools:
    """OpenSim on a trial of JW.

    The input files hold filtered coordinates and ground reactions, so the tools do not filter.
    Coordinates are not clamped to their ranges, because AnalyzeTool would clamp them and
    InverseDynamicsTool would not.

    Args:
        trial: gait trial.
        folder: folder for input and output files.
    """

    def __init__(self, trial: Gait, folder: Path) -> None:
        import opensim

        self.opensim, self.trial, self.folder = opensim, trial, folder
        opensim.Logger.removeFileSink()
        opensim.Logger.setLevelString("Off")
        names, time_s = list(trial.kinematics.model.coordinates), trial.motion.time
        columns = dict(zip(names, trial.motion.q.T, strict=True))
        write_storage(folder / "q.mot", {"time": time_s} | columns, in_degrees=False)
        loads = {"time": time_s}
        for body, reaction in zip(trial.loads, trial.reactions.values(), strict=True):
            for kind in ("force", "point", "moment"):
                values = getattr(reaction, kind)
                loads |= {f"{body}_{kind}_{a}": values[:, k] for k, a in enumerate("xyz")}
        write_storage(folder / "loads.mot", loads, in_degrees=False)
        self._write_external_loads()

    def _write_external_loads(self) -> None:
        document = ElementTree.Element("OpenSimDocument", Version="40000")
        loads = ElementTree.SubElement(document, "ExternalLoads", name="plates")
        objects = ElementTree.SubElement(loads, "objects")
        for body in self.trial.loads:
            force = ElementTree.SubElement(objects, "ExternalForce", name=body)
            for tag, text in (
                ("applied_to_body", body),
                ("force_expressed_in_body", "ground"),
                ("point_expressed_in_body", "ground"),
                ("force_identifier", f"{body}_force_"),
                ("point_identifier", f"{body}_point_"),
                ("torque_identifier", f"{body}_moment_"),
            ):
                ElementTree.SubElement(force, tag).text = text
        ElementTree.SubElement(loads, "datafile").text = str(self.folder / "loads.mot")
        ElementTree.ElementTree(document).write(self.folder / "loads.xml")

    def inverse_dynamics(self) -> Array:
        """Return the generalised forces (f, n)."""
        tool = self.opensim.InverseDynamicsTool()
        model = self.opensim.Model(str(JW / "JW.osim"))
        tool.setModel(model)
        tool.setCoordinatesFileName(str(self.folder / "q.mot"))
        tool.setExternalLoadsFileName(str(self.folder / "loads.xml"))
        tool.setStartTime(float(self.trial.motion.time[0]))
        tool.setEndTime(float(self.trial.motion.time[-1]))
        tool.setLowpassCutoffFrequency(-1.0)
        tool.setResultsDir(str(self.folder))
        tool.setOutputGenForceFileName("id.sto")
        excluded = self.opensim.ArrayStr()
        excluded.append("Muscles")
        tool.setExcludedForces(excluded)
        tool.run()
        columns = read_table(self.folder / "id.sto").columns
        names = self.trial.kinematics.model.coordinates
        return np.stack(
            [
                next(columns[f"{n}_{e}"] for e in ("moment", "force") if f"{n}_{e}" in columns)
                for n in names
            ],
            axis=1,
        )

    def write_model(
        self, muscles: tuple[str, ...], reserve: dict[str, float], wraps: bool = True
    ) -> Path:
        """Write the model with some muscles and an actuator on every independent coordinate.

        Args:
            muscles: names of the muscles to keep.
            reserve: coordinate -> optimal force of its actuator. Others have `UNBALANCED`.
            wraps: whether muscle paths keep their wrap objects.
        """
        model = self.opensim.Model(str(JW / "JW.osim"))
        forces = model.updForceSet()
        for k in range(forces.getSize() - 1, -1, -1):
            if forces.get(k).getName() not in muscles:
                forces.remove(k)
        for name in () if wraps else muscles:
            path = self.opensim.Muscle.safeDownCast(forces.get(name)).updGeometryPath()
            path.updWrapSet().clearAndDestroy()
        read_model = self.trial.kinematics.model
        followers = {coupler.dependent for coupler in read_model.couplers}
        for k in range(model.getCoordinateSet().getSize()):
            coordinate = model.getCoordinateSet().get(k)
            coordinate.setDefaultClamped(False)
            name = coordinate.getName()
            if read_model.coordinates[name].locked or name in followers:
                continue
            actuator = self.opensim.CoordinateActuator(name)
            actuator.setName(f"reserve_{name}")
            actuator.setOptimalForce(reserve.get(name, UNBALANCED))
            actuator.setMinControl(-1e6)
            actuator.setMaxControl(1e6)
            model.addForce(actuator)
        model.finalizeConnections()
        model.printToXML(str(self.folder / "muscles.osim"))
        return self.folder / "muscles.osim"

    def static_optimisation(self, first: float, last: float, every: int) -> tuple[dict, float]:
        """Return muscle -> activations at every `every`-th time, and processor time, s."""
        analysis = self.opensim.StaticOptimization()
        analysis.setName("StaticOptimization")
        analysis.setUseMusclePhysiology(False)
        analysis.setActivationExponent(2.0)
        analysis.setConvergenceCriterion(1e-4)
        analysis.setMaxIterations(1000)
        seconds = self._analyse("so", analysis, first, last, every)
        return read_table(self.folder / "so_StaticOptimization_activation.sto").columns, seconds

    def moment_arms(
        self, coordinates: tuple[str, ...], first: float, last: float, every: int
    ) -> dict[str, dict]:
        """Return coordinate -> muscle -> moment arms, with the model's constraints."""
        analysis = self.opensim.MuscleAnalysis()
        analysis.setName("MuscleAnalysis")
        analysis.setComputeMoments(True)
        words = self.opensim.ArrayStr()
        for name in coordinates:
            words.append(name)
        analysis.setCoordinates(words)
        self._analyse("ma", analysis, first, last, every)
        stem = str(self.folder / "ma_MuscleAnalysis_MomentArm_")
        return {name: read_table(Path(f"{stem}{name}.sto")).columns for name in coordinates}

    def knee_reaction(self, first: float, last: float, every: int) -> tuple[dict, float]:
        """Return force and moment on the tibia at the tray, ground frame, and processor time, s.

        Muscle forces are those of `static_optimisation`.
        """
        analysis = self.opensim.JointReaction()
        analysis.setName("JointReaction")
        analysis.setForcesFileName(str(self.folder / "so_StaticOptimization_force.sto"))
        for setter, word in (
            (analysis.setJointNames, "tibial_tray_weld"),
            (analysis.setOnBody, "child"),
            (analysis.setInFrame, "ground"),
        ):
            words = self.opensim.ArrayStr()
            words.append(word)
            setter(words)
        seconds = self._analyse("jr", analysis, first, last, every)
        return read_table(self.folder / "jr_JointReaction_ReactionLoads.sto").columns, seconds

    def _analyse(self, name: str, analysis, first: float, last: float, every: int) -> float:
        analysis.setStartTime(first)
        analysis.setEndTime(last)
        analysis.setStepInterval(every)
        tool = self.opensim.AnalyzeTool()
        tool.setName(name)
        tool.setModelFilename(str(self.folder / "muscles.osim"))
        tool.setCoordinatesFileName(str(self.folder / "q.mot"))
        tool.setExternalLoadsFileName(str(self.folder / "loads.xml"))
        tool.setLowpassCutoffFrequency(-1.0)
        tool.setInitialTime(first)
        tool.setFinalTime(last)
        tool.setSolveForEquilibrium(False)
        tool.setReplaceForceSet(False)
        tool.setResultsDir(str(self.folder))
        tool.updAnalysisSet().cloneAndAppend(analysis)
        tool.printToXML(str(self.folder / f"{name}.xml"))
        tool = self.opensim.AnalyzeTool(str(self.folder / f"{name}.xml"))
        start = time.process_time()
        tool.run()
        return time.process_time() - start
