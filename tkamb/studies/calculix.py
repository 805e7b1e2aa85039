"""CalculiX as an independent check of the lattice, on the same hexahedra, pose and load.

CalculiX runs as a process with one thread and a time limit, and uses no result of the lattice. It
starts at the depth at which an elastic foundation carries the load
(docs/development/peer_calculix.md). CalculiX has no warm start, so its cold and warm times are
equal.

Its pressures on deformed faces are converted to nodal forces and divided by the undeformed
tributary areas, as in the built-in models.

Linear cases use small strain in both programs; with the Ramberg-Osgood law CalculiX uses finite
strain (true stress as a function of Eulerian strain), the built-in models small strain.
"""

import math
import os
import shutil
import subprocess
import tempfile
import time as clock
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tkamb.contact.area import covered_areas
from tkamb.contact.lattice.meshing.contact_map import ContactMap, contact_map
from tkamb.contact.pair import ContactPair, PreparedContact
from tkamb.contact.result import ContactResult
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array
from tkamb.geometry.memory import peak_rss
from tkamb.run.decks import ELEMENT, Deck, PressProblem, press_problem
from tkamb.studies.cases import StudyCase
from tkamb.studies.measures import ONE_THREAD, Measure, quantities, raster_map
from tkamb.units import MEGAPASCAL, MILLIMETRE

PROGRAM = "ccx"


# s: time limit of a run. A longer run is stopped and has no result. Most runs take
# less than a minute.
LONGEST_SECONDS = 600.0
# s: interval between two readings of the memory of the process. It is short
# compared with a run and costs little.
POLL_SECONDS = 0.05


OUTPUT_FILE = "output"


@dataclass(frozen=True, eq=False)
class PeerRun:
    """Results and cost of one run of CalculiX.

    Args:
        blocks: name of the output -> its last table of numbers in the .dat file.
        peak_rss_MB: peak memory of the process, MB (1e6 bytes).
        iterations: number of equilibrium iterations, with one factorisation each.
    """

    blocks: dict[str, Array]
    seconds: float
    peak_rss_MB: float
    iterations: int


def find_program() -> str:
    """Return the path of the CalculiX program."""
    result = shutil.which(PROGRAM)
    if result is None:
        raise InputError("is not installed", "CalculiX", "apt-get install calculix-ccx")
    return result


def run_calculix(text: str, longest: float = LONGEST_SECONDS) -> PeerRun:
    """Run CalculiX on an input deck.

    Args:
        longest: time limit, s.

    Raises:
        InputError: CalculiX is not installed.
        ComputationError: CalculiX stopped with an error or exceeded the time limit.
    """
    program = find_program()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "peer.inp").write_text(text, encoding="utf-8")
        start = clock.perf_counter()
        memory = _wait([program, "-i", "peer"], place, longest)
        seconds = clock.perf_counter() - start
        if not (place / "peer.dat").exists():
            raise ComputationError(
                f"gave no output: {_error_line(place / OUTPUT_FILE)}", "CalculiX"
            )
        blocks = _blocks((place / "peer.dat").read_text(encoding="utf-8").splitlines())
        iterations = _iterations((place / "peer.cvg").read_text(encoding="utf-8"))
        return PeerRun(blocks, seconds, memory, iterations)


def _wait(command: list[str], place: Path, longest: float) -> float:
    memory, start = math.nan, clock.perf_counter()
    with (
        open(place / OUTPUT_FILE, "wb") as output,
        subprocess.Popen(
            command, cwd=place, stdout=output, stderr=subprocess.STDOUT, env=os.environ | ONE_THREAD
        ) as process,
    ):
        try:
            while process.poll() is None:
                # peak_rss is NaN once the process has ended
                memory = float(np.fmax(memory, peak_rss(process.pid)))
                if clock.perf_counter() - start > longest:
                    raise ComputationError(f"stopped after {longest:g} s", "CalculiX")
                with suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_SECONDS)
        finally:
            process.kill()
    if process.returncode:
        raise ComputationError(f"stopped: {_error_line(place / OUTPUT_FILE)}", "CalculiX")
    return memory


def _error_line(path: Path) -> str:
    lines = [line.strip(" *") for line in path.read_text(errors="replace").splitlines()]
    lines = [line for line in lines if line]
    errors = [line for line in lines if line.lower().startswith("error")]
    return (errors or lines or ["no output"])[-1]


def _iterations(text: str) -> int:
    """Count the lines of a .cvg file that begin with a step number."""
    return sum(line.split()[:1] != [] and line.split()[0].isdigit() for line in text.splitlines())


def _blocks(lines: Iterable[str]) -> dict[str, Array]:
    """Return the tables of a .dat file by the set in the title, or its first word."""
    blocks: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for line in lines:
        words = line.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            name = words[words.index("set") + 1] if "set" in words else words[0]
            rows = blocks[name] = []
            continue
        if numbers:
            rows.append(numbers)
    return {name: np.array(rows) for name, rows in blocks.items() if rows}


# Largest difference between the summed contact forces and the load, relative to the load.
# Converged solutions differ by less.
MAX_RESIDUAL = 0.01


@dataclass(frozen=True, eq=False)
class PeerAnswer:
    """Contact result and cost of CalculiX.

    Args:
        result: contact result on the contact nodes of the lattice's grid.
        prepare_seconds: time to make the grid, the initial guess and the deck, s.
        balance: sum of the vertical contact forces, divided by the load.
    """

    result: ContactResult
    run: PeerRun
    prepare_seconds: float
    nodes: int
    balance: float


def measure_by_calculix(
    case: StudyCase, grid_mm: float, longest: float = LONGEST_SECONDS
) -> Measure:
    """Return cost and results of CalculiX on a case; after an error only the status.

    Args:
        grid_mm: edge length of the hexahedra, mm.
        longest: time limit, s.
    """
    try:
        answer = press_by_calculix(case.pair, case.load, case.pose, grid_mm, longest=longest)
    except ComputationError as error:
        return Measure(str(error))
    seconds = answer.run.seconds
    return Measure(
        "ok",
        answer.prepare_seconds,
        seconds,
        seconds,
        answer.run.peak_rss_MB,
        answer.run.iterations,
        answer.nodes,
        quantities(answer.result),
        {f"{i} {j}": p for (i, j), p in raster_map(answer.result).items()},
    )


def press_by_calculix(
    pair: ContactPair,
    load: float,
    pose: Array,
    grid_mm: float,
    element: str = ELEMENT,
    longest: float = LONGEST_SECONDS,
) -> PeerAnswer:
    """Press a femoral component on an insert with CalculiX.

    Args:
        load: force along -y, N.
        pose: pose_femoral_in_insert, (4, 4); its y has no effect.
        grid_mm: edge length of the hexahedra, mm.
        element: element type, "C3D8I" or "C3D8".
        longest: time limit, s.

    Raises:
        InputError: CalculiX is not installed, or the deck cannot express the material or bearing.
        ComputationError: CalculiX failed, or its contact forces do not sum to the load.
    """
    start = clock.perf_counter()
    problem = press_problem(pair, load, pose, grid_mm)
    deck = Deck(problem.lattice, problem.patch, pair.material, pair.bearing, load, element)
    text = deck.text
    prepared = clock.perf_counter() - start
    run = run_calculix(text, longest)
    result, balance = peer_result(problem, run)
    return PeerAnswer(result, run, prepared, len(problem.lattice.nodes), balance)


def peer_result(problem: PressProblem, run: PeerRun) -> tuple[ContactResult, float]:
    """Return the contact result of a run, and its vertical contact force over the load.

    Raises:
        ComputationError: contact extends beyond the femoral patch of the deck, or the forces do not
            sum to the load.
    """
    if not {"NREF", "NINSERT", "contact"} <= run.blocks.keys():
        raise ComputationError("gave no contact stress", "CalculiX")
    approach = problem.depth - float(run.blocks["NREF"][-1, 2]) * MILLIMETRE
    pose = problem.pair.pose_at_approach(problem.pose, approach)
    deformed = _deformed_map(problem, run)
    force = _nodal_forces(problem, pose, run, deformed)
    balance = -float(force[:, 1].sum()) / problem.load
    if not abs(balance - 1) <= MAX_RESIDUAL:
        raise ComputationError(
            f"gave contact forces that sum to {balance:.4f} of the load", "CalculiX"
        )
    surface = problem.map
    pressure = np.linalg.norm(force, axis=1) / surface.area
    gap = _gaps(problem, pose, deformed)
    covered = covered_areas(
        surface.points, surface.triangles, surface.triangle_area,
        pressure, gap, problem.pair.material,
    )  # fmt: skip
    result = ContactResult.of(
        PreparedContact(problem.pair, surface), pose, pressure, gap, force, covered=covered,
        iterations=run.iterations, residual=abs(balance - 1),
    )  # fmt: skip
    return result, balance


def _deformed_map(problem: PressProblem, run: PeerRun) -> ContactMap:
    displacement = run.blocks["NINSERT"]
    displacement = displacement[np.argsort(displacement[:, 0]), 1:] * MILLIMETRE
    lattice = replace(problem.lattice, nodes=problem.lattice.nodes + displacement)
    return contact_map(lattice, problem.pair.insert)[1]


def _gaps(problem: PressProblem, pose: Array, deformed: ContactMap) -> Array:
    """Return the vertical gaps (c,) above the deformed nodes, m; inf where no facet is above."""
    above, _ = problem.floor.over(deformed.points, pose)
    return np.nan_to_num(above[:, 1] - deformed.points[:, 1], nan=np.inf)


def _nodal_forces(problem: PressProblem, pose: Array, run: PeerRun, deformed: ContactMap) -> Array:
    """Return the forces (c, 3) on the contact nodes, N: pressure times deformed tributary area."""
    stress = run.blocks["contact"]
    pressure = np.zeros(len(deformed.points))
    place = np.searchsorted(problem.nodes, stress[:, 0].astype(np.int64) - 1)
    pressure[place] = np.maximum(stress[:, 1], 0.0) * MEGAPASCAL
    loaded = pressure > 0
    if not problem.touchable[loaded].all():
        raise ComputationError("found contact outside the femoral patch of the deck", "CalculiX")
    _, normals = problem.floor.over(deformed.points, pose)
    return np.where(loaded[:, None], (pressure * deformed.area)[:, None] * normals, 0.0)
