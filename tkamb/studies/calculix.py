"""CalculiX beside the built-in models: the same hexahedra, the same load, one row per element.

Node-to-surface penalty contact against the rigid femoral triangles; the femoral component
moves along y only, pushed by the load at a reference node. C3D8 is fully integrated and locks
at nu = 0.45; C3D8I does not. CalculiX has the Ramberg-Osgood law only with finite strain
(*DEFORMATION PLASTICITY wants NLGEOM), the built-in models have small strain: a nonlinear
comparison is one of the two strain measures as well.

A press of CalculiX begins anew each time: its cold and warm times are the same.
"""

import json
import resource
import shutil
import subprocess
import tempfile
import time as clock
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.model import LatticeState
from tkamb.contact.materials import LinearElastic, RambergOsgood
from tkamb.contact.pressing import pose_at_approach
from tkamb.contact.registry import contact_model
from tkamb.contact.summary import medial_points
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.studies.cases import StudyCase
from tkamb.studies.measures import Job, Measure
from tkamb.studies.quantities import Quantities, errors
from tkamb.studies.references import Reference
from tkamb.studies.tradeoff import Row, floor_of
from tkamb.units import MEGAPASCAL, MILLIMETRE

PROGRAM = "ccx"
CASES = ("sphere", "two condyles")
ELEMENTS = ("C3D8I",)
PENALTY = 1e5
"""N/mm³: contact gives way by 0.2 µm at 20 MPa."""
REACH = 2.5e-3
"""m: femoral triangles within this height of the lowest point take part."""
LEAST_PRESSURE = 0.1e6
"""Pa: a node below it does not count as touched."""
THICKNESS = np.array([0.0, 1e-3, 0.0])
"""m: of the layer of wedges that stands for the rigid femoral component."""


def peer_rows(
    cases: Iterable[StudyCase], references: dict[str, Reference], grid_mm: float = 2.0
) -> list[Row]:
    """Return a row for each case that CalculiX can do.

    Raises:
        InputError: CalculiX is not installed.
        ComputationError: it failed.
    """
    if shutil.which(PROGRAM) is None:
        raise InputError("is not installed", "CalculiX", "apt-get install calculix-ccx")
    rows = []
    for case in cases:
        for element in ELEMENTS if case.name in CASES else ():
            found = press_by_calculix(case, grid_mm, element)
            reference = references[case.name]
            compared = errors(found.values, reference.values) | {"map": float("nan")}
            job = Job(case.name, f"calculix {element}", grid_mm)
            rows.append(Row(job, found, compared, floor_of(reference)))
    return rows


def press_by_calculix(case: StudyCase, grid_mm: float, element: str) -> Measure:
    """Press a case by CalculiX on the lattice's grid; a timed measure with its answer."""
    model = contact_model("fe", grid_mm, cache=False)
    start = clock.perf_counter()
    state = model.prepare(case.pair)
    own = model.press(state, case.load, case.pose)
    patch = _patch(case.pair.femoral, pose_at_approach(case.pair, case.pose, 0.0))
    text = _deck(state, patch, case, 0.8 * own.approach, element)
    prepared = clock.perf_counter()
    blocks = _run(text)
    seconds = clock.perf_counter() - prepared
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6
    values = _values(blocks, state, own.pose)
    nodes = state.node_count
    return Measure("ok", prepared - start, seconds, seconds, memory, 0, nodes, values)


def _patch(femoral: Surface, pose: Array) -> Surface:
    """Return the lower triangles of the femoral component in the insert frame."""
    placed = femoral.moved(pose)
    low = placed.triangles[..., 1].min(axis=1) < placed.vertices[:, 1].min() + REACH
    used, faces = np.unique(
        placed.faces[low & (placed.face_normals[:, 1] < -0.3)], return_inverse=True
    )
    return Surface(placed.vertices[used], faces.reshape(-1, 3), "patch")


def _deck(state: LatticeState, patch: Surface, case: StudyCase, depth: float, element: str) -> str:
    """Return the input, mm, N, MPa: a step that moves down by `depth` (m), one under load."""
    lattice, n, m = state.lattice, len(state.lattice.nodes), len(patch.vertices)
    places = np.concatenate([lattice.nodes, patch.vertices, patch.vertices + THICKNESS])
    centre, first = len(places) + 1, len(lattice.cells) + 1
    wedges = patch.faces[:, [0, 2, 1]] + n
    nonlinear = not case.pair.material.is_linear
    lines = ["*NODE, NSET=NALL"]
    lines += [f"{i},{x:.9e},{y:.9e},{z:.9e}" for i, (x, y, z) in enumerate(places / MILLIMETRE, 1)]
    lines += [f"{centre},0.,30.,0.", f"{centre + 1},0.,30.,0."]
    lines += [f"*ELEMENT, TYPE={element}, ELSET=INSERT", *_numbered(1, lattice.cells)]
    lines.append("*ELEMENT, TYPE=C3D6, ELSET=FEMUR")
    lines += _numbered(first, np.concatenate([wedges, wedges + m], axis=1))
    lines += _set("NBOTTOM", lattice.bottom_nodes) + _set("NREF", np.array([centre - 1]))
    lines += _set("NSLAVE", np.unique(lattice.contact_triangles)) + _set("NINSERT", np.arange(n))
    lines += _set("NFEMUR", np.arange(n, n + 2 * m))
    lines += ["*SURFACE, NAME=SLAVE, TYPE=NODE", "NSLAVE", "*SURFACE, NAME=MASTER"]
    lines += [f"{first + e},S1" for e in range(len(wedges))]
    lines += _material(case.pair.material)
    lines.append(f"*RIGID BODY, NSET=NFEMUR, REF NODE={centre}, ROT NODE={centre + 1}")
    lines += ["*SURFACE INTERACTION, NAME=SI", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"]
    lines += [f"{PENALTY},0.001", "*CONTACT PAIR, INTERACTION=SI, TYPE=NODE TO SURFACE"]
    lines.append("SLAVE,MASTER")
    held = ["NBOTTOM,1,3", f"{centre},1,1", f"{centre},3,3", f"{centre + 1},1,3"]
    step = "*STEP, INC=300" + (", NLGEOM" if nonlinear else "")
    lines += ["*BOUNDARY", *held, step, "*STATIC", "0.1,1.,1e-7,0.25"]
    lines += ["*BOUNDARY", f"{centre},2,2,{-depth / MILLIMETRE}", "*END STEP"]
    lines += [step, "*STATIC", "0.5,1.,1e-7,1.", "*BOUNDARY, OP=NEW", *held]
    lines += ["*CLOAD", f"{centre},2,{-case.load}"]
    lines += ["*NODE PRINT, NSET=NREF, FREQUENCY=1000", "U"]
    return "\n".join([*lines, "*CONTACT PRINT, FREQUENCY=1000", "CSTR", "*END STEP", ""])


def _material(insert: Any) -> list[str]:
    modulus, law = insert.young_modulus / MEGAPASCAL, insert.law
    lines = ["*MATERIAL, NAME=PE"]
    if isinstance(law, RambergOsgood):
        stress = law.reference_stress / MEGAPASCAL
        lines.append("*DEFORMATION PLASTICITY")
        lines.append(f"{modulus},{insert.poisson_ratio},{stress},{law.exponent},{law.alpha}")
    elif isinstance(law, LinearElastic):
        lines += ["*ELASTIC", f"{modulus},{insert.poisson_ratio}"]
    else:
        raise InputError("has no law that CalculiX knows", f"material '{insert.name}'")
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "2.1E5,0.3"]
    lines.append("*SOLID SECTION, ELSET=INSERT, MATERIAL=PE")
    return [*lines, "*SOLID SECTION, ELSET=FEMUR, MATERIAL=STEEL"]


def _numbered(first: int, members: NDArray[np.int64]) -> list[str]:
    return [f"{i},{','.join(str(v + 1) for v in row)}" for i, row in enumerate(members, first)]


def _set(name: str, nodes: NDArray[np.int64]) -> list[str]:
    return [f"*NSET, NSET={name}", *(str(v + 1) for v in nodes)]


def _run(text: str) -> dict[str, Array]:
    """Run a deck; return the blocks of numbers in its .dat file, the last of each kind."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "peer.inp").write_text(text, encoding="utf-8")
        command = [PROGRAM, "-i", "peer"]
        ran = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        found = place / "peer.dat"
        if ran.returncode or not found.exists():
            said = json.dumps((ran.stdout + ran.stderr).strip().splitlines()[-1:])
            raise ComputationError(f"stopped: {said}", "CalculiX")
        return _blocks(found.read_text(encoding="utf-8").splitlines())


def _blocks(lines: Iterable[str]) -> dict[str, Array]:
    blocks: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for line in lines:
        words = line.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            rows = blocks[words[0]] = []
            continue
        if numbers:
            rows.append(numbers)
    return {name: np.array(rows) for name, rows in blocks.items() if rows}


def _values(blocks: dict[str, Array], state: LatticeState, pose: Array) -> Quantities:
    """Return what CalculiX found, its pressures spread over the lattice's areas."""
    if not {"displacements", "contact"} <= blocks.keys():
        raise ComputationError("gave no contact stress", "CalculiX")
    stress, area = blocks["contact"], state.map.area
    pressure = np.zeros(len(area))
    place = np.searchsorted(state.problem.contact_nodes, stress[:, 0].astype(int) - 1)
    pressure[place] = np.maximum(stress[:, 1], 0.0) * MEGAPASCAL
    values = {"approach": -float(blocks["displacements"][-1, 2]) * MILLIMETRE}
    medial = medial_points(state.points, pose, condyle_split(state.pair.femoral))
    for side, own in (("medial", medial), ("lateral", ~medial)):
        normal = (pressure * area)[own, None] * state.map.normals[own]
        force = float(np.linalg.norm(normal.sum(axis=0)))
        touched = float(area[own & (pressure > LEAST_PRESSURE)].sum())
        values |= {
            f"{side}_force": force,
            f"{side}_area": touched,
            f"{side}_mean_pressure": force / touched if touched else 0.0,
            f"{side}_peak_pressure": float(pressure[own].max(initial=0.0)),
        }
    return values
