"""Compute the numbers of docs/dissertation.md with the preset sharma-2008.

Facts of the source stand in `reproduction.toml`, appendix D in `dissertation_tables.toml`. The page
takes some other numbers from scripts/data/validation.json; they are not computed here.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact import materials
from tkamb.contact.lattice.meshing.cells import CORNERS, DIRECTIONS, join_springs
from tkamb.contact.lattice.source_lattice import SourceLattice
from tkamb.contact.lattice.source_springs import source_factor
from tkamb.contact.materials import RambergOsgood
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.knee.ligament_laws import TwoLine
from tkamb.run.press import load_pair, press_meshes
from tkamb.run.simulation import simulate
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

PRESET = "sharma-2008"
LOAD, CELLS = 1500.0, 1.5 * MILLIMETRE
"""N and m: load and cell size of the press in `lattice`."""
TILTED = (0.3, (30.5, 30.7, 31.2), -6.9)
"""Poses of `adjustment`: coronal angle (deg), recorded heights (mm), AP position (mm)."""
LIFTED = (0.45, (15.0, 30.0))
"""Coronal error that `lift_off` adds (deg), and its flexion angles (deg), as in section 5.2.2."""


@dataclass(frozen=True)
class ReproductionSettings:
    """The reproduction of the dissertation."""

    stride: int = 10
    """Stride of the 101 frames of the shipped bend. Source: appendix D has
    0, 10, ... 100 %."""


REPRODUCTION = ReproductionSettings()


Values = dict[str, float]


def lattice(model: Path) -> Values:
    """Return the numbers of sections 4.1, 4.2 and 4.5 on the shipped insert.

    Args:
        model: folder of the shipped knee.
    """
    pair, pose = load_pair(*_meshes(model), "mm", (-6.9, 30.7, 0, 0, 0, 0), "fixed",
                           "polyethylene", "+x,+y,+z", "right")  # fmt: skip
    contact = SourceLattice(CELLS, loops="source", pressure_rule="source", cache=False)
    start = time.process_time()
    state = contact.prepare(pair)
    prepared = time.process_time()
    contact.press(state, LOAD / 10, pose)  # compiles code that is not in the cache
    pressed = time.process_time()
    result = contact.press(state, LOAD, pose)
    ended = time.process_time()
    solid, operator = state.problem.solid, state.problem.operator
    linear = SourceLattice(CELLS, loops="source", law="linear", pressure_rule="source", cache=False)
    loaded = result.pressure > 0
    return {
        "nodes": state.node_count,
        "cells": len(state.lattice.cells),
        "edge_mm": float(state.lattice.spacing.max()) / MILLIMETRE,
        "volume_ratio": float(solid.volume.sum()) / float(pair.insert.mesh.volume),
        "active": int(loaded.sum()),
        "contact_nodes": len(operator.contact_nodes),
        "springs": len(state.lattice.springs.ends),
        "unknowns": solid.nodes.size,
        "held": int(state.problem.held.sum()),
        "loops": result.iterations,
        "load_error": -float(result.wrench_on_insert[1]) / LOAD - 1.0,
        "pressure_sum": float((result.pressure * result.area).sum()) / LOAD,
        "linear_loops": linear.press(linear.prepare(pair), LOAD, pose).iterations,
        "prepare_seconds": prepared - start,
        "press_seconds": ended - pressed,
    }


def template() -> Values:
    """Return the numbers of sections 4.4, 4.5.1, 4.5.2 and 5.2 that need no knee."""
    springs = {}
    for nodes in (2, 3):
        cells = nodes - 1
        number = np.arange(nodes**3).reshape(nodes, nodes, nodes)
        table = np.stack(
            [number[i : i + cells, j : j + cells, k : k + cells].ravel() for i, j, k in CORNERS], 1
        )
        springs[f"springs_{nodes**3}"] = len(join_springs(table, nodes**3).ends)
    cube, length = np.ones(3), np.linalg.norm(DIRECTIONS, axis=1)
    squares = (DIRECTIONS / length[:, None]) ** 2
    along, across = (float((length**2 * squares[:, 0] * squares[:, k]).sum()) for k in (0, 1))
    law = materials.material("polyethylene")
    assert isinstance(law.law, RambergOsgood)
    return springs | {
        "spring_factor": source_factor(cube),
        "poisson": across / (along + across),  # C12 / (C11 + C12)
        "ligament_N": float(TwoLine(100e3).tension(40e-3 * 1.06, 40e-3)),
        "material_E": law.young_modulus / MEGAPASCAL,
        "material_alpha": law.law.alpha,
        "material_sigma0": law.law.reference_stress / MEGAPASCAL,
        "material_n": law.law.exponent,
    }


def adjustment(model: Path) -> Values:
    """Return the least and greatest medial force over the recorded heights, with adjustment.

    Without adjustment, return the medial force at the middle height.
    """
    angle, heights, place = TILTED

    def medial(height: float, adjust: bool) -> float:
        report = press_meshes(
            *_meshes(model),
            LOAD,
            pose=(place, height, 0.0, angle, 0.0, 0.0),
            contact="foundation",
            adjust=adjust,
        )
        return 0.0 if report.result.medial is None else report.result.medial.force

    adjusted = [medial(height, True) for height in heights]
    return {
        "adjusted_low": min(adjusted),
        "adjusted_high": max(adjusted),
        "unadjusted": medial(heights[1], False),
    }


def lift_off(scene: Path) -> Values:
    """Return the number of positions with lift-off by a coronal error, adjusted and unadjusted.

    The result also has the smallest share of the load on a condyle.
    """

    error, flexions = LIFTED
    recorded = load_case(load_scene(scene)).motion.coordinates[:, 5] / DEGREE
    frames = [int(np.abs(recorded - flexion).argmin()) for flexion in flexions]
    result = {}
    for name, adjust in (("adjusted", True), ("unadjusted", False)):
        wrong = {"implant.femoral.rotation_deg": [error, 0.0, 0.0], "contact.adjust": adjust}
        tilted, shares, changes = load_scene(scene, wrong, PRESET), [], []
        for frame in frames:
            row = simulate(tilted, frames=slice(frame, frame + 1))
            forces = [float(np.nan_to_num(row[f"{s}_force_N"][0])) for s in ("medial", "lateral")]
            shares.append(min(forces) / sum(forces))
            changes.append(abs(float(row["adjust_force_change_BW"][0])))
        if adjust:
            result["adjust_change_BW"] = max(changes)
        result[f"share_{name}"] = min(shares)
        result[f"lost_{name}"] = sum(share == 0.0 for share in shares)
    return result


def bend(scene: Path) -> tuple[Values, list[dict[str, float]]]:
    """Return numbers of the shipped bend by the preset, and appendix D's twelve quantities.

    Returns:
        Values of sections 4.4, 5.2.1 to 5.2.3, and a row for each 10 % of the bend.
    """
    result = simulate(load_scene(scene, preset=PRESET), frames=slice(0, 101, REPRODUCTION.stride))
    weight = float(result["force_total_N"][0] / result["force_total_BW"][0])
    columns = {
        1: result["medial_force_N"] / weight,
        2: result["lateral_force_N"] / weight,
        3: result["medial_area_mm2"],
        4: result["lateral_area_mm2"],
        5: result["medial_mean_pressure_MPa"],
        6: result["lateral_mean_pressure_MPa"],
        7: result["quadriceps_N"] / weight,
        8: result["patellar_ligament_N"] / weight,
        9: result["patellofemoral_N"] / weight,
        10: result["force_ap_N"] / weight,
        11: result["force_ml_N"] / weight,
        12: result["force_si_N"] / weight,
    }
    rows: list[dict[str, Any]] = []
    for k in range(len(result)):
        row: dict[str, Any] = {
            "percent": REPRODUCTION.stride * k,
            "flexion_deg": float(result["flexion_deg"][k]),
        }
        row |= {f"D-{number}": round(float(values[k]), 4) for number, values in columns.items()}
        rows.append(row | {"status": result.status[k]})
    total, ratio = result["force_total_BW"], result["lateral_force_N"] / result["medial_force_N"]
    residual = np.hypot(result["residual_ap_N"], result["residual_ml_N"]) / result["force_total_N"]
    values = {
        "peak_BW": float(np.nanmax(total)),
        "peak_deg": float(result["flexion_deg"][int(np.nanargmax(total))]),
        "start_BW": float(total[0]),
        "start_deg": float(result["flexion_deg"][0]),
        "ratio_low": float(np.nanmin(ratio)),
        "ratio_high": float(np.nanmax(ratio)),
        "residual_percent": 100.0 * float(np.nanmax(residual)),
        "quadriceps_as_source": float(columns[7][-1]),
        "slip_medial_mm": float(result["medial_slip_mm"][-1]),
        "slip_lateral_mm": float(result["lateral_slip_mm"][-1]),
    }
    return values, rows


def _meshes(model: Path) -> tuple[Path, Path]:
    return model / "femoral_component.stl", model / "insert.stl"
