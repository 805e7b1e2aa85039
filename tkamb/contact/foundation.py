"""Elastic foundation: a bed of independent springs under a rigid femoral component."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.bed import Bed, sample_bed
from tkamb.contact.materials import Material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import ContactPair, PreparedContact
from tkamb.contact.pressing import (
    LOAD_TOLERANCE,
    approach_at,
    failed_result,
    pose_at_approach,
    press_by_search,
)
from tkamb.contact.probe import CondyleWrench, ProbedContact
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.contact.summary import medial_points, summarise_condyles, wrench_of
from tkamb.contact.validity import peak_flags
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster

Law = Literal["nonlinear", "linear"]

NEAR = 1e-3
"""m; columns nearer than this take part in the search for a load."""
DEEPEST_STRAIN = 0.5
"""Share of the thickness that the femoral component may penetrate."""
THINNEST = 1e-6
"""m; a layer thinner than this, at the insert's rim, counts as this thick."""
NEARBY = 1.5e-3
"""m; the columns nearer than this are looked at while the femur moves by less."""


@dataclass(frozen=True, eq=False)
class FoundationState(PreparedContact):
    """The bed and the ray caster of the femoral component.

    Args:
        pair: the two bodies.
        bed: the sampled articular surface.
        femoral_rays: static, in the femoral frame.
        split: z between the condyles in the femoral frame, m, or None.
    """

    pair: ContactPair
    bed: Bed
    femoral_rays: RayCaster
    split: float | None

    @property
    def points(self) -> Array:  # type: ignore[override]
        """Map points (n, 3) m, insert frame."""
        return self.bed.points

    @property
    def triangles(self) -> NDArray[np.int64]:  # type: ignore[override]
        """Map triangles (k, 3)."""
        return self.bed.triangles


@dataclass(frozen=True)
class ElasticFoundation(ContactModel):
    """A layer of local thickness h bonded to a rigid plate, pressed by a rigid body.

    Each column of the layer is a spring of its own, without lateral strain and without
    friction. With d the penetration along the insert's normal, E and nu of the material at
    the origin, sigma its uniaxial curve, and the confined modulus

        M = E (1 - nu) / ((1 + nu)(1 - 2 nu))      (nu = 0.45: M = 3.79 E)

    the pressure is

        linear:      p = M d/h
        nonlinear:   p = sigma( (M/E) * -ln(1 - d/h) )

    The nonlinear law has two parts. The column keeps its cross-section, so true stress is p
    and true strain is -ln(1 - d/h) (Blankevoort 1991). The polyethylene softens at the
    pressure it carries: M is scaled with the secant modulus E_s of the uniaxial curve at
    the stress p, p = (M/E) E_s(p) eps, as in Bei & Fregly (2004); since sigma = E_s(sigma)
    * eps this is the curve itself at (M/E) eps. A truly confined column would hardly yield,
    its stress being nearly hydrostatic; under a contact patch as wide as the insert is
    thick it is not confined, and this choice stands for that. With a linear material it is
    Blankevoort's law p = -M ln(1 - d/h).

    Limits: neighbours do not help to carry, so that pressure ends at the edge of the
    overlap and peaks at rims are too high; d >= h/2 is OUT_OF_RANGE. Walls parallel
    to y carry nothing. A mobile bearing is pressed like a fixed one.

    Args:
        resolution: m, spacing of the map points.
        law: "nonlinear" or "linear".

    References:
        Blankevoort, Kuiper, Huiskes & Grootenboer, J Biomech 24:1019 (1991),
        doi:10.1016/0021-9290(91)90019-J; Bei & Fregly, Med Eng Phys 26:777 (2004),
        doi:10.1016/j.medengphy.2004.07.004.
    """

    name: ClassVar[str] = "foundation"
    assumes: ClassVar[str] = (
        "a thin layer of independent springs on a rigid plate, softening with pressure"
    )
    needs: ClassVar[str] = "a closed insert; milliseconds"

    resolution: float = 1e-3
    law: Law = "nonlinear"

    def prepare(self, pair: ContactPair) -> FoundationState:
        """Sample the articular surface, build the ray casters and what finds first touch."""
        bed = sample_bed(pair.insert, self.resolution)
        pair.first_touch.travel(np.eye(4))
        return FoundationState(pair, bed, pair.femoral_rays, condyle_split(pair.femoral))

    def evaluate(
        self, state: FoundationState, pose: Array, guess: ContactResult | None = None
    ) -> ContactResult:
        """Return the contact at a pose; see `ContactModel`."""
        if not np.isfinite(pose).all():
            return failed_result(state, pose, "the pose is not finite")
        bed = state.bed
        gap = gaps_along_normals(bed, state.femoral_rays, pose)
        strain = np.maximum(-gap, 0.0) / np.maximum(bed.thickness, THINNEST)
        if (strain >= DEEPEST_STRAIN).any():
            return failed_result(state, pose, "the penetration exceeds half the insert's thickness")
        pressure = layer_pressure(self.law, state.pair.material, strain)
        nodal_force = -(pressure * bed.area)[:, None] * bed.normals
        medial, lateral = summarise_condyles(
            medial_points(bed.points, pose, state.split),
            bed.points,
            pressure,
            bed.area,
            nodal_force,
            bed.thickness,
        )
        return ContactResult(
            pose=np.array(pose, float),
            points=bed.points,
            normals=bed.normals,
            pressure=pressure,
            area=bed.area,
            gap=gap,
            nodal_force=nodal_force,
            wrench_on_insert=wrench_of(bed.points, nodal_force),
            medial=medial,
            lateral=lateral,
            approach=partial(approach_at, state.pair, np.array(pose, float)),  # type: ignore[arg-type]
            status=ContactStatus.OK,
            flags=tuple(peak_flags(medial, lateral)),
        )

    def press(
        self, state: FoundationState, load: float, pose: Array, guess: ContactResult | None = None
    ) -> ContactResult:
        """Find the approach that carries `load` (N); see `ContactModel`.

        The search looks only at the columns near the femoral component; the whole bed is
        evaluated at its end, and searched again if that finds another reaction.
        """
        nearby = _NearColumns(self.law, state, pose)
        result = press_by_search(self, state, load, pose, guess, nearby.reaction)
        if result.status is ContactStatus.OK and result.residual <= LOAD_TOLERANCE:
            return result
        return press_by_search(self, state, load, pose, guess)

    def probe(self, state: FoundationState, guess: ContactResult | None = None) -> Any:
        """Return the probe with near columns and exact stiffness; see `ContactModel`."""
        return FoundationProbe(self.law, state)


@dataclass(frozen=True)
class LinearFoundation(ElasticFoundation):
    """The elastic foundation with its linear law, p = M d/h."""

    name: ClassVar[str] = "foundation-linear"
    assumes: ClassVar[str] = "a thin layer of independent linear springs on a rigid plate"

    law: Law = "linear"


class _NearColumns:
    """The reaction of the columns that lie near the femoral component."""

    def __init__(self, law: Law, state: FoundationState, pose: Array) -> None:
        self._law, self._state, self._pose = law, state, pose
        self._reach, self._near = -np.inf, state.bed

    def reaction(self, approach: float) -> float:
        """Return the reaction (N) at an approach (m); inf where it is out of range."""
        bed, pair = self._state.bed, self._state.pair
        pose = pose_at_approach(pair, self._pose, approach)
        if approach > self._reach:
            gap = gaps_along_normals(bed, self._state.femoral_rays, pose)
            self._near, self._reach = bed.part(gap < NEAR), approach + NEAR / 2
        near = self._near
        gap = gaps_along_normals(near, self._state.femoral_rays, pose)
        strain = np.maximum(-gap, 0.0) / np.maximum(near.thickness, THINNEST)
        if (strain >= DEEPEST_STRAIN).any():
            return np.inf
        pressure = layer_pressure(self._law, pair.material, strain)
        return float((pressure * near.area) @ near.normals[:, 1])


def layer_pressure(law: Law, material: Material, strain: Array) -> Array:
    """Return the pressure (n,), Pa, of a column compressed by `strain` = d/h in [0, 1)."""
    if law == "linear":
        return material.confined_modulus * strain
    stiffening = material.confined_modulus / material.young_modulus
    pressure = np.zeros_like(strain)
    loaded = strain > 0
    pressure[loaded] = material.stress(-stiffening * np.log1p(-strain[loaded]))
    return pressure


def layer_slope(law: Law, material: Material, strain: Array) -> Array:
    """Return d pressure / d strain (n,), Pa, of `layer_pressure`."""
    if law == "linear":
        return np.full_like(strain, material.confined_modulus)
    stiffening = material.confined_modulus / material.young_modulus
    tangent = material.tangent(-stiffening * np.log1p(-strain))
    return np.asarray(tangent * stiffening / (1.0 - strain))


def gaps_along_normals(bed: Bed, femoral_rays: RayCaster, pose: Array) -> Array:
    """Return the gap (n,) m along the insert's normals; negative = penetration.

    Rays start half-way through the insert, outside the femoral component, and go up along
    the normal; the first crossing counts. inf where no femoral surface lies above, -inf
    where the femoral component reaches deeper than where the rays start.
    """
    return gaps_and_facets(bed, femoral_rays, pose)[0]


def gaps_and_facets(bed: Bed, femoral_rays: RayCaster, pose: Array) -> tuple[Array, Array]:
    """Return the gap (n,), see `gaps_along_normals`, and the normals (n, 3) of what is met.

    The normals are those of the femoral facets, in the insert frame.
    """
    back = inverse(pose)
    normals = rotate(back, bed.normals)
    below = DEEPEST_STRAIN * np.minimum(bed.thickness, bed.depth)
    origins = transform(back, bed.points) - below[:, None] * normals
    distance, face = femoral_rays.first(origins, normals)
    met = femoral_rays.surface.face_normals[face]
    facing = np.einsum("ij,ij->i", normals, met)
    gap = np.where((face >= 0) & (facing > 0), -np.inf, distance - below)
    return gap, rotate(pose, met)


class FoundationProbe:
    """The columns near by, and their tangent; see `tkamb.contact.probe.Probe`.

    A femoral displacement u at the point that a column meets, with femoral normal m there,
    changes the gap along the insert's normal n by (m . u)/(m . n). With p'(d) the slope of the
    layer's pressure, a column of area A adds to the stiffness of the wrench on the insert

        A p'(d)/(m . n)  [n; x cross n] [m; h cross m]^T

    x the point on the insert, h the point met. The meshes' facets are taken as they are, so the
    stiffness is the exact tangent wherever no ray crosses from facet to facet.

    Args:
        law: of the layer.
        state: what its `prepare` returned.
    """

    def __init__(self, law: Law, state: FoundationState) -> None:
        self._law, self._state = law, state
        self._corners = _corners(state.femoral_rays.surface.bounds)
        self._near, self._centre = state.bed, np.full((4, 4), np.nan)

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4), with its stiffness."""
        pose = np.asarray(pose, float)
        if not self._covers(pose):
            gap = gaps_and_facets(self._state.bed, self._state.femoral_rays, pose)[0]
            self._near, self._centre = self._state.bed.part(gap < 2 * NEARBY), pose.copy()
        bed = self._near
        gap, femoral_normal = gaps_and_facets(bed, self._state.femoral_rays, pose)
        loaded = gap < 0
        if not loaded.any():
            return ProbedContact({}, tangent=True)
        bed, gap, femoral_normal = bed.part(loaded), gap[loaded], femoral_normal[loaded]
        thickness = np.maximum(bed.thickness, THINNEST)
        strain = -gap / thickness
        if not (strain < DEEPEST_STRAIN).all():
            return ProbedContact({}, known=False)
        material, law = self._state.pair.material, self._law
        force = layer_pressure(law, material, strain) * bed.area
        slope = layer_slope(law, material, strain) / thickness * bed.area
        push = screws(bed.points, bed.normals)
        along = np.einsum("ij,ij->i", femoral_normal, bed.normals)
        met = screws(bed.points + gap[:, None] * bed.normals, femoral_normal) / along[:, None]
        medial = medial_points(bed.points, pose, self._state.split)
        condyles = {}
        for side, own in (("medial", medial), ("lateral", ~medial)):
            if own.any():
                condyles[side] = CondyleWrench(
                    -force[own] @ push[own],
                    force[own] @ bed.points[own] / force[own].sum(),
                    (slope[own, None] * push[own]).T @ met[own],
                )
        return ProbedContact(condyles, tangent=True)

    def _covers(self, pose: Array) -> bool:
        """Return whether no femoral point has come nearer than the chosen columns reach."""
        if np.isnan(self._centre).any():
            return False
        moved = transform(pose, self._corners) - transform(self._centre, self._corners)
        return bool(np.linalg.norm(moved, axis=1).max() < NEARBY)


def screws(points: Array, directions: Array) -> Array:
    """Return direction and moment about the origin (n, 6) of lines through points (n, 3)."""
    return np.hstack([directions, np.cross(points, directions)])


def _corners(bounds: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
