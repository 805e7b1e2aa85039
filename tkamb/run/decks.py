"""The contact of one frame as an input file (deck) of CalculiX or FEBio 4, in mm, N and MPa.

Both decks contain the hexahedra of the insert, and a rigid, faceted patch of the femoral component
that moves along y only. Contact nodes lie on the smooth surface that approximates the insert's
mesh, as in the lattice.

CalculiX: contact is node to surface by penalty, and a node's force its pressure times its tributary
area of the deformed faces. The patch is a layer of wedges under the whole load. It starts in the
insert at the approach of the foundation model (not the run's solution), and CalculiX finds the
equilibrium.

FEBio: the insert is an isotropic elastic (St. Venant-Kirchhoff) solid in finite deformation.
Contact is sliding-elastic and frictionless, by augmented Lagrangian. The patch is displaced from
first touch by the approach of the run, and FEBio returns the force. A load cannot be prescribed,
since the stiffness is zero at first touch.

Reference: FEBio User Manual 4.0, chapter 3, the input file format.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from tkamb.contact.lattice.meshing.cells import FACES
from tkamb.contact.lattice.meshing.contact_map import ContactMap, contact_map
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.lattice.problem import SurfaceFromBelow
from tkamb.contact.materials import Material, RambergOsgood
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.registry import contact_class, contact_model
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.surface import Surface
from tkamb.io.given_material import given_material
from tkamb.io.texts import environment
from tkamb.run.identity import case_of_results
from tkamb.run.metrics import lateral_axis_name, map_rows
from tkamb.run.results import Results
from tkamb.run.results_folder import SUMMARY_NAME, read_results
from tkamb.units import MEGAPASCAL, MILLIMETRE

# N/mm³: contact stiffness. The penetration is then 0.3 µm at 30 MPa.
PENALTY = 1e5


PATCH_THICKNESS = np.array([0.0, 1e-3, 0.0])
"""m: thickness of the layer of wedges that models the rigid femoral component."""


ELEMENT = "C3D8I"
"""Hexahedra with full integration and incompatible modes, which do not lock in bending."""


@dataclass(frozen=True, eq=False)
class Deck:
    """A contact problem for CalculiX.

    Args:
        lattice: nodes and hexahedra of the insert.
        patch: part of the femoral component that can touch, at its initial pose, insert frame.
        load: load along -y, N.
        element: "C3D8" (full integration, locks as nu approaches 0.5) or "C3D8I" (incompatible
            modes).
    """

    lattice: Lattice
    patch: Surface
    material: Material
    bearing: Bearing
    load: float
    element: str = ELEMENT
    comments: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The deck in mm, N and MPa."""
        if self.bearing != "fixed":
            raise InputError("can only fix the whole bottom of the insert", "CalculiX's deck")
        lattice, patch, n = self.lattice, self.patch, len(self.lattice.nodes)
        places = np.concatenate([lattice.nodes, patch.vertices, patch.vertices + PATCH_THICKNESS])
        wedges = patch.faces[:, [0, 2, 1]] + n
        wedges = np.concatenate([wedges, wedges + len(patch.vertices)], axis=1)
        return _rendered(
            "calculix.inp",
            comments=self.comments,
            nodes=places / MILLIMETRE,
            centre=len(places) + 1,
            element=self.element,
            cells=lattice.cells + 1,
            wedges=wedges + 1,
            bottom=lattice.bottom_nodes + 1,
            insert_nodes=n,
            slaves=np.unique(lattice.contact_triangles) + 1,
            law=_law(self.material),
            penalty=PENALTY,
            is_linear=self.material.is_linear,
            load=self.load,
        )


def _rendered(name: str, **facts: Any) -> str:
    plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in facts.items()}
    return environment("tkamb.run", html=False).get_template(name).render(plain) + "\n"


def _law(material: Material) -> str:
    modulus, ratio, law = material.young_modulus / MEGAPASCAL, material.poisson_ratio, material.law
    if type(law) is RambergOsgood:
        stress = law.reference_stress / MEGAPASCAL
        return f"*DEFORMATION PLASTICITY\n{modulus},{ratio},{stress},{law.exponent},{law.alpha}"
    if material.is_linear:
        return f"*ELASTIC\n{modulus},{ratio}"
    raise InputError("has a law that CalculiX does not have", f"material '{material.name}'")


# 1: steps of the displacement. FEBio divides a step that fails.
LOAD_STEPS = 10


def febio_text(problem: "PressProblem", approach: float, comments: Iterable[str] = ()) -> str:
    """Return the .feb file of a contact problem.

    Args:
        approach: displacement of the femoral component along -y from first touch, m.
    """
    pair, lattice, patch = problem.pair, problem.lattice, problem.patch
    if pair.bearing != "fixed":
        raise InputError("can only fix the whole bottom of the insert", "FEBio's deck")
    if not pair.material.is_linear:
        what = "has a law that FEBio's deck does not have"
        hint = "run the frame with material = 'polyethylene-linear'"
        raise InputError(what, f"material '{pair.material.name}'", hint)
    apart = patch.vertices + np.array([0.0, problem.depth, 0.0])  # at first touch
    return _rendered(
        "febio.feb",
        comments=list(comments),
        steps=LOAD_STEPS,
        modulus=pair.material.young_modulus / MEGAPASCAL,
        ratio=pair.material.poisson_ratio,
        nodes=np.concatenate([lattice.nodes, apart]) / MILLIMETRE,
        cells=lattice.cells + 1,
        patch=patch.faces + len(lattice.nodes) + 1,
        bottom=lattice.bottom_nodes + 1,
        quads=contact_quads(lattice) + 1,
        travel=approach / MILLIMETRE,
    )


def contact_quads(lattice: Lattice) -> Index:
    """Return the boundary faces between contact nodes, (q, 4), with outward normals."""
    faces = lattice.cells[:, FACES].reshape(-1, 4)
    inside = np.repeat(lattice.nodes[lattice.cells].mean(axis=1), len(FACES), axis=0)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    touches = np.asarray(np.isin(faces, np.unique(lattice.contact_triangles)).all(axis=1))
    chosen = first[(count == 1) & touches[first]]
    quads = faces[chosen]
    corners = lattice.nodes[quads]
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    outward = np.einsum("ij,ij->i", normal, corners.mean(axis=1) - inside[chosen])
    return np.where(outward[:, None] < 0, quads[:, ::-1], quads)


# 1: nodes with a gap at first touch below this multiple of the guessed depth can touch.
# The error of the guess is smaller.
TOUCHABLE_DEPTHS = 2.0
# 1: largest y component of the normal of a femoral face in the patch. Steeper faces
# do not press on the insert.
LARGEST_NORMAL_Y = -0.3


@dataclass(frozen=True, eq=False)
class PressProblem:
    """The grid of the insert and the femoral component at its initial pose.

    Args:
        pair: insert and femoral component.
        lattice: grid of the insert with contact nodes on the smooth surface.
        nodes: contact nodes, (c,).
        map: contact surface of the insert.
        pose: pose_femoral_in_insert at the guessed depth, (4, 4).
        depth: guessed approach, m.
        touchable: mask of the contact nodes that can touch, (c,).
        patch: femoral triangles above these nodes, insert frame.
        load: load along -y, N.
    """

    pair: ContactPair
    lattice: Lattice
    nodes: Index
    map: ContactMap
    floor: SurfaceFromBelow
    pose: Array
    depth: float
    touchable: Mask
    patch: Surface
    load: float


def press_problem(pair: ContactPair, load: float, pose: Array, grid_mm: float) -> PressProblem:
    """Return a press as a finite-element problem.

    Args:
        pair: insert and femoral component.
        load: load along -y, N.
        pose: pose_femoral_in_insert, (4, 4); its y is not used.
        grid_mm: edge of the hexahedra, mm.

    Raises:
        InputError: the insert cannot be meshed.
        ComputationError: the load is not compressive.
    """
    lattice = whole_lattice(pair.insert, grid_mm * MILLIMETRE)
    nodes, surface = contact_map(lattice, pair.insert)
    smooth = lattice.nodes.copy()
    smooth[nodes, 1] += surface.lift
    floor = SurfaceFromBelow(pair.femoral, pair.femoral.rays)
    guess = contact_model("foundation", resolution=grid_mm * MILLIMETRE)
    depth = guess.press(guess.prepare(pair), load, pose).approach
    if not depth > 0:
        raise ComputationError("needs a load that presses the bodies together", "deck")
    places, _ = floor.over(surface.points, pair.pose_at_approach(pose, 0.0))
    near = places[:, 1] - surface.points[:, 1] < TOUCHABLE_DEPTHS * depth
    pressed_pose = pair.pose_at_approach(pose, depth)
    patch = _patch(pair.femoral.moved(pressed_pose), surface.points[near], grid_mm * MILLIMETRE)
    lattice = replace(lattice, nodes=smooth)
    return PressProblem(
        pair, lattice, nodes, surface, floor, pressed_pose, depth, near, patch, load
    )


def _patch(femoral: Surface, points: Array, spacing: float) -> Surface:
    """Return the downward triangles within one cell of any point, seen from above."""
    down = np.flatnonzero(femoral.face_normals[:, 1] < LARGEST_NORMAL_Y)
    middle = femoral.triangles[down].mean(axis=1)[:, ::2]
    away, _ = cKDTree(points[:, ::2]).query(middle, distance_upper_bound=spacing)
    used, faces = np.unique(femoral.faces[down[np.isfinite(away)]], return_inverse=True)
    return Surface(femoral.vertices[used], faces.reshape(-1, 3).astype(np.int64), "patch")


SUFFIX = {"ccx": ".inp", "feb": ".feb"}


@dataclass(frozen=True, eq=False)
class FramePress:
    """The contact of one frame as a finite-element problem, with the run's results.

    Args:
        problem: problem at the pose of the frame, except for its y. The load is the vertical sum of
            the frame's nodal forces.
        approach: approach in the run, m.
        peak_pressure: largest pressure of the map, Pa.
        origin: text with frame number, folder of the run and contact model.
        lateral: direction of insert z, "lateral" or "medial".
    """

    problem: PressProblem
    approach: float
    peak_pressure: float
    origin: str
    lateral: str = "lateral"
    notes: tuple[str, ...] = ()

    def comments(self) -> tuple[str, ...]:
        """Return the lines at the top of the deck."""
        problem, millimetres = self.problem, self.approach / MILLIMETRE
        return (
            f"{self.origin}; written by tkamb; mm, N, MPa.",
            f"Insert frame: x anterior, y superior, z {self.lateral}; no friction; the bottom is "
            "fixed.",
            f"{len(problem.lattice.cells)} hexahedra; load {problem.load:.6g} N along -y.",
            f"Results of the run: approach since first touch {millimetres:.6g} mm, peak pressure "
            f"{self.peak_pressure / MEGAPASCAL:.6g} MPa.",
            *self.notes,
        )

    def deck(self, kind: str) -> str:
        """Return the deck of CalculiX ("ccx") or FEBio ("feb")."""
        problem, text = self.problem, self.comments()
        if kind == "feb":
            return febio_text(
                problem,
                self.approach,
                (*text, "Compare the size of Fy of femur.csv with the load."),
            )
        start = problem.depth / MILLIMETRE
        more = (
            f"The femoral patch begins {start:.6g} mm below first touch and is free to move along",
            f"y. Its approach is {start:.6g} mm minus U2 of the set NREF. The .dat file has the",
            "displacements and the contact pressures.",
        )
        pair = problem.pair
        deck = Deck(
            problem.lattice, problem.patch, pair.material, pair.bearing, problem.load,
            comments=(*text, *more),
        )  # fmt: skip
        return deck.text


def frame_press(folder: Path, frame: int, resolution_mm: float | None = None) -> FramePress:
    """Return the contact of one frame of a folder of results.

    Args:
        frame: row of results.csv; negative numbers count from the end.
        resolution_mm: edge of the hexahedra, mm; None: the spacing of the run.

    Raises:
        InputError: there are no results, no such frame, no map or no load, or the scene has
            changed since the run.
        ComputationError: the load is not compressive.
    """
    results = read_results(folder)
    count = len(results)
    if not -count <= frame < count:
        raise InputError(f"there is no frame {frame}", "frame", f"give one of 0 to {count - 1}")
    frame %= count
    contact = results.summary.get("contact")
    if not contact:
        raise InputError("does not name the contact model", folder / SUMMARY_NAME, "run it again")
    row, maps = map_rows(results).get(frame), results.maps
    if maps is None or row is None:
        raise InputError(f"frame {frame} has no pressure map", folder, "choose another frame")
    data = maps.frame_data(row)
    load = -float(data["nodal_force_N"][:, 1].sum())
    if not load > 0:
        raise InputError(f"frame {frame} carries no load", folder, "choose another frame")
    pair, spacing = _pair(results)
    pose = maps.femoral_pose[row]
    problem = press_problem(pair, load, pose, resolution_mm or spacing)
    model = contact_class(contact["model"])
    origin = f"Frame {frame} of {folder} by {contact['model']} at {spacing:g} mm"
    peak = float(data["pressure_Pa"].max())
    lateral, notes = lateral_axis_name(results), tuple(_notes(results, frame, pair, model))
    return FramePress(problem, pair.approach(pose), peak, origin, lateral, notes)


def _notes(
    results: Results, frame: int, pair: ContactPair, model: type[ContactModel]
) -> Iterator[str]:
    law = pair.material
    yield (
        f"Material '{law.name}', {'linear' if law.is_linear else 'nonlinear'}: "
        f"E {law.young_modulus / MEGAPASCAL:.6g} MPa, nu {law.poisson_ratio:g}; the run's model "
        f"assumes {model.assumes}."
    )
    if results.summary.get("side") == "left":
        yield "A left knee: this deck and the run's files show its mirror image, a right knee."
    if "post_force_N" in results.columns:
        force, peak = (results[name][frame] for name in ("post_force_N", "post_peak_pressure_MPa"))
        yield (
            "Load and peak pressure exclude the contact of cam and post, which is not in this "
            f"deck: {force:.6g} N, peak {peak:.6g} MPa in the run."
        )


def _pair(results: Results) -> tuple[ContactPair, float]:
    case = case_of_results(results)
    table, insert = case.scene.contact, case.scene.implant.insert
    assert table is not None and insert is not None
    assert case.femoral is not None and case.insert is not None
    pair = ContactPair(
        case.femoral, case.insert, given_material(case.scene.insert_material), insert.bearing
    )
    return pair, table.resolution_mm
