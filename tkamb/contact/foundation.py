"""Elastic foundation: a bed of independent springs under a rigid femoral component."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from tkamb.contact.flags import narrow_flags, unsupported_flags
from tkamb.contact.materials import Material
from tkamb.contact.model import CondyleWrench, ContactModel, LoadedPoints, ProbedContact
from tkamb.contact.pressing import PRESS, press_by_search
from tkamb.contact.result import ContactResult, ContactStatus, Guess, WarmStart, medial_points
from tkamb.contact.samples import (
    DEEPEST,
    NEAR,
    Columns,
    Meeting,
    Neighbourhood,
    SampledContact,
    SurfaceSamples,
    meet,
)
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import SIDES, Array, Index, Mask
from tkamb.units import MILLIMETRE

Law = Literal["nonlinear", "linear"]


# m: smallest thickness of the layer; at the rim it replaces smaller values. It
# keeps pressure = modulus * penetration / thickness finite.
LEAST_THICKNESS = 1e-6
# m: difference of two approaches below which their reactions count as equal. With a
# stiffness of about 1e8 N/m the reactions differ by 0.1 N.
APPROACH_STEP = 1e-9
# 1: cosine of the angle between column and femoral normal (84 deg) below which the column is not
# loaded. Chosen like the least slope of a map point, `MAP_POINT.least_normal_y`: the force p A/(m
# . n) would be more than ten times the pressure's.
LEAST_COSINE = 0.1
# 1: a reaction below `REACHED_SHARE` * load - `REACHED_FORCE` cannot rise to the load within
# `APPROACH_STEP`. Map points that come into contact within this step raise the
# reaction by less than 1 % of the load.
REACHED_SHARE = 0.99
# N: see `REACHED_SHARE`. Ten times the reaction's change within `APPROACH_STEP`.
REACHED_FORCE = 1.0


TOO_DEEP = "the penetration exceeds half the insert's thickness"
OVER_THE_EDGE = (
    "the femoral component reaches over the insert's edge, deeper than half of its thickness there"
)
WIDEST_EDGE = NEAR
"""m: upper limit of the gaps in which `FoundationProbe.smoothed` counts a column partly."""
SUMS = 70
"""Number of sums over the columns of one condyle; see `_add_up`."""


@dataclass(frozen=True)
class ElasticFoundation(ContactModel):
    """A layer of local thickness h bonded to a rigid plate, pressed by a rigid body.

    Each column of the layer is an independent spring without lateral strain and without friction.
    The contact stores the energy sum A W(d), with dW/dd = p; its force is the gradient: with the
    insert's normal n, and the normal m of the smooth femoral surface (`CurvedSurface`) where the
    column meets it, a column loads the insert there with -p A m/(m . n). p is therefore the normal
    traction on the femoral surface, of which the column covers A/|m . n|.

    Let d be the penetration along the insert's normal, E and nu the material's constants at zero
    strain, and sigma its uniaxial curve. With the confined modulus

        M = E (1 - nu) / ((1 + nu)(1 - 2 nu))      (nu = 0.45: M = 3.79 E)

    the pressure is

        linear:      p = M d/h
        nonlinear:   p = sigma( (M/E) * -ln(1 - d/h) )

    In the nonlinear law the column keeps its cross-section, so the true stress is p and the true
    strain eps is -ln(1 - d/h) (Blankevoort 1991). The polyethylene softens with pressure, as in Bei
    & Fregly (2004): p = (M/E) E_s(p) eps, with the secant modulus E_s at the stress p. Since sigma
    = E_s(sigma) eps, p is the curve itself at (M/E) eps. A fully confined column would hardly
    yield, but a contact patch of a knee is only as wide as the insert is thick. With a linear
    material the law is Blankevoort's, p = -M ln(1 - d/h).

    Limits: neighbouring columns do not share load. The pressure therefore ends at the edge of the
    overlap, and peaks at rims are too high. The energy depends slightly on how the map points lie:
    the map holds a ball on a plate, which nothing else holds, under the linear law with 32 k d J3(k
    a)/(k a)³ of the load, with the penetration d, the radius a of the contact and k = 2
    pi/resolution. For a ball of 25 mm under 500 N this is up to 0.1 % at 1 mm and 0.4 % at 2 mm.
    Where a column crosses an edge of two femoral triangles, its force turns (docs/plug_in.md). A
    column that meets the femur at less than 6 deg is unloaded. There, and where an outline of the
    femoral component passes a column of the rim, the energy jumps (`scripts/measure/energy`). If
    the penetration is at least half of the thickness, along y or the normal, the result is
    OUT_OF_RANGE. Walls parallel to y carry no load. A mobile bearing is pressed like a fixed one.
    The approach counts from the first touch of the triangles; the smooth surface lies outside them
    by up to their sagitta.

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

    def evaluate(
        self, state: SampledContact, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Return the contact at a pose; see `ContactModel`."""
        if not np.isfinite(pose).all():
            return ContactResult.out_of_range(state, pose, "the pose is not finite")
        samples = state.surface
        meeting = meet(samples, state.pair.femoral, pose)
        gap = meeting.gap
        strain = np.maximum(-gap, 0.0) / np.maximum(samples.thickness, LEAST_THICKNESS)
        if (deep := strain >= DEEPEST).any():
            full_depth = (samples.depth >= samples.thickness)[deep].any()
            k = int(strain.argmax())
            words = TOO_DEEP if full_depth else OVER_THE_EDGE
            thickness = max(float(samples.thickness[k]), LEAST_THICKNESS)
            # No ray ends in a column that lies wholly inside the femur: its gap is -inf.
            depth = -gap[k] if np.isfinite(gap[k]) else state.pair.approach(pose)
            depth, limit = depth / MILLIMETRE, DEEPEST * thickness / MILLIMETRE
            measured = f"{words}: {depth:.2f} mm deep, at most {limit:.2f} mm"
            if depth < limit:
                measured = (
                    f"{words}: {depth:.2f} mm after the first touch a column of "
                    f"{thickness / MILLIMETRE:.2f} mm lies wholly inside it"
                )
            return ContactResult.out_of_range(state, pose, measured)
        pressure = layer_pressure(self.law, state.pair.material, strain)
        pressure[grazing(samples, meeting)] = 0.0
        medial = medial_points(samples.points, pose, state.pair.split)
        sides = {"medial": medial, "lateral": ~medial}
        flags = (
            *unsupported_flags(state.pair.insert, samples.points, pressure, sides),
            *narrow_flags(samples.triangles, pressure > 0, sides, "columns"),
        )
        force = forces_on_insert(samples, meeting, pressure)
        places = samples.points + np.where(pressure > 0, gap, 0.0)[:, None] * samples.normals
        return ContactResult.of(
            state, pose, pressure, gap, force, medial=medial, places=places, flags=flags
        )

    def press(
        self, state: SampledContact, load: float, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Find the approach that carries `load` (N), with the near columns alone; see
        `ContactModel`.

        If all columns then react differently, the search is repeated with all.
        """
        nearby = _NearColumns(self.law, state, pose, guess)
        unloaded = -state.pair.femoral.curved.sag
        result = press_by_search(self, state, load, pose, guess, nearby.reaction, unloaded)
        if result.status is ContactStatus.OK and result.residual <= PRESS.load_tolerance:
            return result
        # The near columns may lack a column in contact, so their failure has to be confirmed.
        if result.status is ContactStatus.OUT_OF_RANGE and self._load_out_of_range(nearby, load):
            return result
        return press_by_search(self, state, load, pose, guess, unloaded=unloaded)

    def _load_out_of_range(self, nearby: "_NearColumns", load: float) -> bool:
        """The reaction rises with the approach, so all columns at the largest approach in range
        decide.
        """
        if nearby.beyond - nearby.within > APPROACH_STEP:
            return False
        pose = nearby.state.pair.pose_at_approach(nearby.pose, nearby.within)
        result = self.evaluate(nearby.state, pose)
        reaction = -float(result.wrench_on_insert[1])
        return result.status is ContactStatus.OK and reaction < REACHED_SHARE * load - REACHED_FORCE

    def probe(self, state: SampledContact, guess: Guess | None = None) -> Any:
        """Return a probe that evaluates the near columns, with exact stiffness."""
        return FoundationProbe(self.law, state)


@dataclass(frozen=True)
class LinearFoundation(ElasticFoundation):
    """The elastic foundation with its linear law, p = M d/h."""

    name: ClassVar[str] = "foundation-linear"
    assumes: ClassVar[str] = "a thin layer of independent linear springs on a rigid plate"

    law: Law = "linear"


class _NearColumns:
    """The reaction of the near columns.

    Attributes:
        within: m, largest evaluated approach that is in range; -inf if there is none.
        beyond: m, smallest evaluated approach that is out of range; inf if there is none.
    """

    def __init__(self, law: Law, state: SampledContact, pose: Array, guess: Guess | None) -> None:
        self.state, self.pose, self._probe = state, pose, FoundationProbe(law, state)
        if guess is not None and guess.points is state.points and not np.isnan(guess.gap).any():
            self._probe.around.take(guess.pose, guess.gap)
        self.within, self.beyond, self._last = -np.inf, np.inf, 0.0

    def reaction(self, approach: float) -> float:
        """Return the reaction (N) at an approach (m); inf where the approach is out of range.

        If `within` and `beyond` differ by at most `APPROACH_STEP`, it is that at `within` between
        them.
        """
        if self.within < approach < self.beyond <= self.within + APPROACH_STEP:
            return self._last
        strain, sums = self._probe.sums(self.state.pair.pose_at_approach(self.pose, approach))
        if strain >= DEEPEST:
            self.beyond = min(self.beyond, approach)
            return np.inf
        reaction = -float(sums[:, 5].sum())
        if approach > self.within:
            self.within, self._last = approach, reaction
        return reaction


def grazing(samples: SurfaceSamples, meeting: Meeting) -> Mask:
    """Return whether columns (n,) meet the femoral surface edge on, or not at all."""
    cosine = np.einsum("ij,ij->i", samples.normals, meeting.gradient)
    return cosine > -LEAST_COSINE


def forces_on_insert(samples: SurfaceSamples, meeting: Meeting, pressure: Array) -> Array:
    """Return the forces (n, 3), N, of columns on the insert, -p A m/(m . n).

    `pressure` p (n,), Pa, is 0 for a column that grazes the femoral surface.
    """
    forces, loaded = np.zeros_like(samples.points), pressure > 0
    normals, met = samples.normals[loaded], meeting.gradient[loaded]
    size = pressure[loaded] * samples.area[loaded] / np.einsum("ij,ij->i", normals, met)
    forces[loaded] = -size[:, None] * met
    return forces


def layer_pressure(law: Law, material: Material, strain: Array) -> Array:
    """Return the pressure (n,), Pa, of columns with the compressive strain d/h (n,) in [0, 1)."""
    if law == "linear":
        return material.confined_modulus * strain
    # A confined layer is stiffer than a free bar by the factor M/E. Its pressure is therefore the
    # uniaxial stress at a strain that is larger by this factor.
    stiffening = material.confined_modulus / material.young_modulus
    pressure = np.zeros_like(strain)
    loaded = strain > 0
    # The strain is logarithmic, so that the stress tends to infinity as the thickness tends to 0.
    pressure[loaded] = material.stress(-stiffening * np.log1p(-strain[loaded]))
    return pressure


def layer_slope(law: Law, material: Material, strain: Array) -> Array:
    """Return the derivative of `layer_pressure` by the strain (n,), Pa."""
    if law == "linear":
        return np.full_like(strain, material.confined_modulus)
    stiffening = material.confined_modulus / material.young_modulus
    tangent = material.tangent(-stiffening * np.log1p(-strain))
    # Chain rule of `layer_pressure`: d ln(1 - e) / de = -1 / (1 - e).
    return tangent * stiffening / (1.0 - strain)


class FoundationProbe:
    """Forces and tangent stiffness of the near columns; see `tkamb.contact.model.Probe`.

    A column of area A along the insert's normal n meets the femur at the point h with the femoral
    normal m. Let c = m . n and M = [m; h cross m]. A displacement xi = (u, w) of the femur changes
    the gap by M . xi/c, so that the wrench on the insert is

        -A p(d) M/c.

    Its derivative has four terms: d changes by -M . xi/c, h moves along n by the change of the gap,
    m turns by w cross m and by the femoral curvature where h slides on the femur, and c changes
    with m. Apart from the jumps of the slope of `CurvedSurface` between triangles the stiffness is
    the exact tangent.
    """

    exact: ClassVar[bool] = True

    def __init__(self, law: Law, state: SampledContact) -> None:
        self._law, self._state = law, state
        self.around = Neighbourhood(state)
        self._last: tuple[Array, Index, Meeting] | None = None

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4), with its stiffness."""
        strain, sums = self.sums(pose)
        if not strain < DEEPEST:
            return ProbedContact({}, known=False)
        condyles = {
            side: CondyleWrench(
                one[4:10], one[1:4], one[10:46].reshape(6, 6), one[46:64].reshape(3, 6)
            )
            for side, one in zip(SIDES, sums, strict=True)
            if one[0] > 0.0
        }
        through = not strain and self._state.pair.passed_through(pose) is not None
        return ProbedContact(condyles, known=not through, tangent=True)

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return the contact at the pose of a result, from its loaded columns; see `at`."""
        if not np.isnan(result.gap).any():
            self.around.take(result.pose, result.gap)
        return self.at(result.pose)

    def sums(self, pose: Array) -> tuple[float, Array]:
        """Return the largest strain of the near columns, and the sums of both sides (2, `SUMS`)."""
        pose, sums = np.asarray(pose, float), np.zeros((2, SUMS))
        near, meeting = self._columns(pose)
        loaded = meeting.gap < 0
        thickness = np.maximum(self._state.surface.thickness[near], LEAST_THICKNESS)
        strain = np.where(loaded, -meeting.gap / thickness, 0.0)
        deepest = float(strain.max(initial=0.0))
        if deepest < DEEPEST:
            pressure, slope = self._pressures(strain)
            self._add_up(near, meeting, pressure, slope * loaded, pose, sums)
        return deepest, sums

    def _pressures(self, strain: Array) -> tuple[Array, Array]:
        material = self._state.pair.material
        return layer_pressure(self._law, material, strain), layer_slope(self._law, material, strain)

    def smoothed(self, pose: Array, contact: ProbedContact) -> ProbedContact:
        """Return the contact with its stiffness averaged over a column's width; see `Probe`.

        A column's stiffness jumps when it comes into contact, the transverse stiffness of the
        contact then by up to half. Here each column is weighted with the share of its cell inside
        the edge of contact; the gap is linear across the cell. This adds resolution²/6 to the
        square of a circular contact's radius.
        """
        near, meeting = self._columns(pose)
        surface, sums = self._state.surface, np.zeros((2, SUMS))
        at_edge = (meeting.gap < WIDEST_EDGE) & (meeting.patch >= 0)
        near, gap, gradient = near[at_edge], meeting.gap[at_edge], meeting.gradient[at_edge]
        along = np.einsum("ij,ij->i", gradient, surface.normals[near])
        cosine = np.abs(along) / np.linalg.norm(gradient, axis=1)
        change = surface.resolution * np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / cosine
        edge = np.clip(change, APPROACH_STEP, WIDEST_EDGE)
        share = np.clip(0.5 - gap / edge, 0.0, 1.0)
        within = Meeting(np.minimum(gap, 0.0), gradient, meeting.patch[at_edge])
        thickness = np.maximum(surface.thickness[near], LEAST_THICKNESS)
        pressure, slope = self._pressures(-within.gap / thickness)
        self._add_up(near, within, pressure, slope * share, pose, sums)
        condyles = {
            side: replace(condyle, stiffness=sums[SIDES.index(side), 10:46].reshape(6, 6))
            for side, condyle in contact.condyles.items()
        }
        return replace(contact, condyles=condyles)

    def loaded_points(self, pose: Array, contact: ProbedContact, slopes: bool) -> LoadedPoints:
        """Return the pressures of the loaded columns; with `slopes` their derivative, too.

        A displacement changes the gap of a column by M . xi/c, and so its pressure p(d/h) by -p' M
        . xi/(c h).
        """
        near, meeting = self._columns(pose)
        surface, state = self._state.surface, self._state
        cosine = np.einsum("ij,ij->i", surface.normals[near], meeting.gradient)
        loaded = (meeting.gap < 0) & (cosine <= -LEAST_COSINE)
        near, met, gap = near[loaded], meeting.gradient[loaded], meeting.gap[loaded]
        points, normals, thickness, _ = (one[near] for one in surface.columns)
        thickness = np.maximum(thickness, LEAST_THICKNESS)
        pressure, rate = self._pressures(-gap / thickness)
        medial = medial_points(points, pose, state.pair.split)
        if not slopes:
            return LoadedPoints(pressure, surface.area[near], medial, None)
        places, growth = points + gap[:, None] * normals, -rate / thickness / cosine[loaded]
        slope = growth[:, None] * np.hstack([met, np.cross(places, met)])
        return LoadedPoints(pressure, surface.area[near], medial, slope)

    def _columns(self, pose: Array) -> tuple[Index, Meeting]:
        if self._last is None or not np.array_equal(self._last[0], pose):
            self._last = np.array(pose, float), *self.around.at(pose)
        return self._last[1:]

    def _add_up(
        self,
        near: Index,
        meeting: Meeting,
        pressure: Array,
        slope: Array,
        pose: Array,
        sums: Array,
    ) -> None:
        state = self._state
        split = np.inf if state.pair.split is None else state.pair.split
        curvatures = state.pair.femoral.curved.quadratics[-1]
        columns = near, state.surface.columns, state.surface.area
        met = meeting.gap, meeting.gradient, meeting.patch
        _add_up(*columns, *met, curvatures, pressure, slope, pose, split, sums)


@compiled_as_written
def _add_up(
    chosen: Index,
    columns: Columns,
    area: Array,
    gap: Array,
    gradients: Array,
    patches: Index,
    curvatures: Array,
    pressure: Array,
    slope: Array,
    pose: Array,
    split: float,
    sums: Array,
) -> None:
    """Sum the columns' forces, and their change as the femoral component moves.

    Args:
        chosen: (m,) numbers of the columns.
        area: (n,) m².
        gradients: (m, 3) normals of the femoral surface where the columns meet it, of any length.
        curvatures: (k, 3, 3) 1/m, of the patches: minus the derivative of `gradients` by the place
            on the femur, femoral frame.
        slope: (m,) Pa, derivative of `pressure` by the strain.
        split: m, see `medial_points`.
        sums: (2, `SUMS`) output for medial and lateral: force (N), centre (3,), m, wrench (6,) on
            the insert, its stiffness (6, 6), derivatives of the centre (3, 6) and of the force (6,)
            by a displacement. Force is the sum of the magnitudes of the columns' forces.
    """
    points, normals, thickness, _ = columns
    met, place, change = np.empty(6), np.empty(3), np.empty((6, 6))
    half, curvature = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(chosen)):
        column, cosine = chosen[n], 0.0
        for i in range(3):
            cosine += gradients[n, i] * normals[column, i]
        idle = pressure[n] == 0.0 and slope[n] == 0.0
        if idle or cosine > -LEAST_COSINE:  # a column that meets the femur edge on has no load
            continue
        length, across = 0.0, 0.0
        for i in range(3):
            met[i] = gradients[n, i]
            length += met[i] ** 2
            across += pose[i, 2] * (points[column, i] - pose[i, 3])
            place[i] = points[column, i] + gap[n] * normals[column, i]
        side_sums = sums[0 if across < split else 1]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            met[3 + i] = place[j] * met[k] - place[k] * met[j]
            for m in range(3):
                half[i, m] = 0.0
                for q in range(3):
                    half[i, m] += curvatures[patches[n], i, q] * pose[m, q]
        for i in range(3):
            for m in range(3):
                curvature[i, m] = 0.0
                for q in range(3):
                    curvature[i, m] += pose[i, q] * half[q, m]
        size = -pressure[n] * area[column] / cosine
        rate = slope[n] * area[column] / max(thickness[column], LEAST_THICKNESS)
        weight = size * np.sqrt(length)
        side_sums[0] += weight
        for i in range(3):
            side_sums[1 + i] += weight * points[column, i]
        _turn(normals[column], curvature, place, met, cosine, change)
        for i in range(6):
            side_sums[4 + i] += size * met[i]
        for j in range(6):
            turned, stretched = 0.0, 0.0  # n . dm, m . dm
            for k in range(3):
                turned += normals[column, k] * change[k, j]
                stretched += met[k] * change[k, j]
            resized = met[j] * (rate / cosine**2) - size * turned / cosine
            for i in range(6):
                side_sums[10 + 6 * i + j] += resized * met[i] + size * change[i, j]
            reweighed = (resized * length + size * stretched) / np.sqrt(length)
            side_sums[64 + j] += reweighed
            for i in range(3):
                side_sums[46 + 6 * i + j] += reweighed * points[column, i]
    for side_sums in sums:
        if side_sums[0] > 0.0:
            # The centre is sum(x F) / sum(F) over the columns.
            for i in range(3):
                side_sums[1 + i] /= side_sums[0]
                for j in range(6):
                    slope_of_sum = side_sums[46 + 6 * i + j] - side_sums[1 + i] * side_sums[64 + j]
                    side_sums[46 + 6 * i + j] = slope_of_sum / side_sums[0]


@compiled_as_written
def _turn(
    normal: Array, curvature: Array, place: Array, met: Array, cosine: float, change: Array
) -> None:
    """Write the derivative (6, 6) of M = [m; h x m] by a displacement of the femoral component.

    `normal` is n of the column, `curvature` (3, 3), 1/m, see `_add_up`, `place` h, `met` M (6,) and
    `cosine` m . n.
    """
    slide, moved = np.empty(3), np.empty(3)
    for j in range(6):
        along = met[j] / cosine  # h moves along n as the gap changes
        for i in range(3):
            moved[i] = normal[i] * along
            slide[i] = moved[i]  # motion of h on the femur: less u + w x h
        if j < 3:
            slide[j] -= 1.0
        else:
            a, b = (j - 2) % 3, (j - 1) % 3
            # w = e_j: e_j x h has the components a: -h_b, b: h_a.
            slide[a] += place[b]
            slide[b] -= place[a]
        for i in range(3):
            change[i, j] = 0.0
            for k in range(3):
                change[i, j] -= curvature[i, k] * slide[k]
        if j >= 3:
            a, b = (j - 2) % 3, (j - 1) % 3
            change[a, j] -= met[b]
            change[b, j] += met[a]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            change[3 + i, j] = place[a] * change[b, j] - place[b] * change[a, j]
            change[3 + i, j] += moved[a] * met[b] - moved[b] * met[a]
