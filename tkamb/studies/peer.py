"""CalculiX beside the built-in models: the same hexahedra, pose and load, another program.

It starts without a result of the lattice: the initial position of the femoral component is the one
at which an elastic foundation carries the load. Each position starts from zero, so that its cold
and warm times are equal. Its contact nodes lie on the smooth surface of the insert's mesh, as those
of the lattice do; the femoral component is faceted. CalculiX's pressures act on the deformed faces.
Here they are converted to nodal forces, and these, divided by the undeformed tributary areas, to
pressures as the built-in models define them.

Strain: linear cases use small strain in both programs. CalculiX's Ramberg-Osgood law uses finite
strain (true stress over the Eulerian strain of the deformed shape), the built-in models small
strain. A nonlinear comparison therefore includes the difference of these two measures.
"""

import time as clock
from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.area import covered_areas
from tkamb.contact.lattice.meshing.contact_map import ContactMap, contact_map
from tkamb.contact.pair import ContactPair, PreparedContact
from tkamb.contact.result import ContactResult
from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array
from tkamb.run.decks import ELEMENT, Deck
from tkamb.run.frame_press import PressProblem, press_problem
from tkamb.studies.calculix import CALCULIX, PeerRun, run_calculix
from tkamb.studies.cases import StudyCase
from tkamb.studies.measures import Measure
from tkamb.studies.quantities import quantities, raster_map
from tkamb.units import MEGAPASCAL, MILLIMETRE


@dataclass(frozen=True)
class PeerSettings:
    """When a result of the peer finite-element program is accepted."""

    max_residual: float = 0.01
    """Share of the load: largest difference of the summed contact forces from it. Chosen: above
    what a converged solution leaves."""


PEER = PeerSettings()


@dataclass(frozen=True, eq=False)
class PeerAnswer:
    """Result of CalculiX.

    Args:
        result: on the contact nodes of the lattice's grid, by the contract's definitions.
        run: its times, memory and iterations.
        prepare_seconds: for the grid, the guess and the input.
        nodes: of the insert.
        balance: sum of the vertical contact forces over the load.
    """

    result: ContactResult
    run: PeerRun
    prepare_seconds: float
    nodes: int
    balance: float


def measure_by_calculix(
    case: StudyCase, grid_mm: float, longest: float = CALCULIX.longest_seconds
) -> Measure:
    """Return CalculiX's measure of a case; its status says why there is none.

    Args:
        case: what to press.
        grid_mm: edge of the hexahedra.
        longest: s, after which it is stopped.
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
    longest: float = CALCULIX.longest_seconds,
) -> PeerAnswer:
    """Press a femoral component on an insert by CalculiX.

    Args:
        pair: the two bodies.
        load: N, along -y.
        pose: (4, 4) pose_femoral_in_insert; its y does not matter.
        grid_mm: edge of the hexahedra.
        element: "C3D8I" or "C3D8".
        longest: s, after which CalculiX is stopped.

    Raises:
        InputError: CalculiX is not installed, or has no such material or bearing.
        ComputationError: it failed, or what it found does not carry the load.
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
    """Return what CalculiX found by the contract's definitions, and its forces over the load.

    Raises:
        ComputationError: contact reached beyond the femoral patch of the deck, or the forces do not
        sum to the load.
    """
    if not {"NREF", "NINSERT", "contact"} <= run.blocks.keys():
        raise ComputationError("gave no contact stress", "CalculiX")
    approach = problem.depth - float(run.blocks["NREF"][-1, 2]) * MILLIMETRE
    pose = problem.pair.pose_at_approach(problem.pose, approach)
    bent = _bent(problem, run)
    force = _nodal_forces(problem, pose, run, bent)
    balance = -float(force[:, 1].sum()) / problem.load
    if not abs(balance - 1) <= PEER.max_residual:
        raise ComputationError(f"gave pressures that sum to {balance:.4f} of the load", "CalculiX")
    surface = problem.map
    pressure = np.linalg.norm(force, axis=1) / surface.area
    gap = _gaps(problem, pose, bent)
    covered = covered_areas(
        surface.points, surface.triangles, surface.triangle_area,
        pressure, gap, problem.pair.material,
    )  # fmt: skip
    result = ContactResult.of(
        PreparedContact(problem.pair, surface), pose, pressure, gap, force, covered=covered,
        iterations=run.iterations, residual=abs(balance - 1),
    )  # fmt: skip
    return result, balance


def _bent(problem: PressProblem, run: PeerRun) -> ContactMap:
    """Return the deformed contact surface."""
    displacement = run.blocks["NINSERT"]
    displacement = displacement[np.argsort(displacement[:, 0]), 1:] * MILLIMETRE
    deformed = replace(problem.lattice, nodes=problem.lattice.nodes + displacement)
    return contact_map(deformed, problem.pair.insert)[1]


def _gaps(problem: PressProblem, pose: Array, bent: ContactMap) -> Array:
    """Return the vertical gaps (c,) above the deformed nodes, m, inf where nothing is above."""
    above, _ = problem.floor.over(bent.points, pose)
    return np.nan_to_num(above[:, 1] - bent.points[:, 1], nan=np.inf)


def _nodal_forces(problem: PressProblem, pose: Array, run: PeerRun, bent: ContactMap) -> Array:
    """Return the forces (c, 3) on the contact nodes, N: pressure times deformed area."""
    stress = run.blocks["contact"]
    pressure = np.zeros(len(bent.points))
    place = np.searchsorted(problem.nodes, stress[:, 0].astype(np.int64) - 1)
    pressure[place] = np.maximum(stress[:, 1], 0.0) * MEGAPASCAL
    loaded = pressure > 0
    if not problem.touchable[loaded].all():
        raise ComputationError("touches beyond the femoral patch it was given", "CalculiX")
    _, normals = problem.floor.over(bent.points, pose)
    return np.where(loaded[:, None], (pressure * bent.area)[:, None] * normals, 0.0)
