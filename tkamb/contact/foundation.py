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
    Meeting,
    Neighbourhood,
    SampledContact,
    SurfaceSamples,
    meet,
)
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import SIDES, Array, Mask
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
"""m: upper limit of the range of gaps in which `FoundationProbe.smoothed` counts a column partly.
The range is the change of the gap across the column."""
SUMS = 70
"""Number of sums over the columns of one condyle; see `_add_up`."""


@dataclass(frozen=True)
class ElasticFoundation(ContactModel):
    """A layer of local thickness h bonded to a rigid plate, pressed by a rigid body.

    Each column of the layer is an independent spring without lateral strain and without friction.
    The contact stores the energy sum A W(d), with dW/dd = p. Its force is the gradient of this
    energy: with the insert's normal n, and the normal m of the femoral component where the column
    meets it, a column loads the insert with -p A m/(m . n), at that place. p is therefore the
    normal traction on the femoral surface, of which the column covers A/|m . n|. The femoral
    surface is the smooth one that the mesh approximates, `CurvedSurface`.

    Let d be the penetration along the insert's normal, E and nu the material's constants at zero
    strain, and sigma its uniaxial curve. With the confined modulus

        M = E (1 - nu) / ((1 + nu)(1 - 2 nu))      (nu = 0.45: M = 3.79 E)

    the pressure is

        linear:      p = M d/h
        nonlinear:   p = sigma( (M/E) * -ln(1 - d/h) )

    The nonlinear law has two parts. First, the column keeps its cross-section, so the true stress
    is p and the true strain eps is -ln(1 - d/h) (Blankevoort 1991). Second, the polyethylene
    softens with pressure, as in Bei & Fregly (2004): p = (M/E) E_s(p) eps, with the secant modulus
    E_s of the uniaxial curve at the stress p. Since sigma = E_s(sigma) eps, p is the curve itself
    at (M/E) eps. A fully confined column would hardly yield, because its stress is nearly
    hydrostatic. A contact patch of a knee, however, is only as wide as the insert is thick, so its
    columns are not fully confined. With a linear material the law is Blankevoort's,
    p = -M ln(1 - d/h).

    Limits: neighbouring columns do not share load. The pressure therefore ends at the edge of the
    overlap, and peaks at rims are too high. The energy depends slightly on how the map points lie,
    whatever the facets: the map holds a ball on a plate, which nothing else holds, under the linear
    law with 32 k d J3(k a)/(k a)³ of the load, with the penetration d, the radius a of the contact
    and k = 2 pi/resolution. For a ball of 25 mm under 500 N this is up to 0.1 % at 1 mm and 0.4 %
    at 2 mm. Where a column crosses an edge of two femoral triangles, its force turns: at 2 mm the
    force of the shipped knee jumps by 0.004 N (median of 57 crossings; the largest 0.3 N), every 11
    µm along AP. A column that meets the femur at less than 6 deg is unloaded. There, and where an
    outline of the femoral component passes a column of the rim, the energy jumps
    (`scripts/measure/energy`). If the penetration is at least half of the thickness, along y or
    along the normal, the result is OUT_OF_RANGE. Walls parallel to y carry no load. A mobile
    bearing is pressed like a fixed one. The approach counts from the first touch of the triangles;
    the smooth surface lies outside them by up to their sagitta.

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
        """Find the approach that carries `load` (N); see `ContactModel`.

        The search evaluates only the columns near the femoral component. At its end all columns are
        evaluated. If their reaction differs, the search is repeated with all columns.
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
        """Return whether all columns together go out of range before they carry the load.

        If the near columns are out of range, all columns are. The reaction rises with the approach.
        One evaluation of all columns, at the largest approach in range, is therefore enough: it
        gives the largest reaction in range.
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
    """The reaction of the columns whose gap to the femoral component is less than `NEAR`.

    Attributes:
        within: m, largest evaluated approach that is in range; -inf if there is none.
        beyond: m, smallest evaluated approach that is out of range; inf if there is none.
    """

    def __init__(self, law: Law, state: SampledContact, pose: Array, guess: Guess | None) -> None:
        self._law, self.state, self.pose = law, state, pose
        self._reach, self._near, self._around = -np.inf, state.surface, Neighbourhood(state)
        if guess is not None and guess.points is state.points and not np.isnan(guess.gap).any():
            self._around.take(guess.pose, guess.gap)
        self.within, self.beyond, self._last = -np.inf, np.inf, 0.0

    def reaction(self, approach: float) -> float:
        """Return the reaction (N) at an approach (m); inf where the approach is out of range.

        When `within` and `beyond` differ by at most `APPROACH_STEP`, the reaction
        between them is that at `within`.
        """
        if self.within < approach < self.beyond <= self.within + APPROACH_STEP:
            return self._last
        pair = self.state.pair
        pose = pair.pose_at_approach(self.pose, approach)
        if approach > self._reach:
            samples, meeting = self._around.at(pose)
            close = meeting.gap < NEAR
            # This set of columns is used until the femur has moved down by half of NEAR. The other
            # half is a margin, because gaps along inclined normals may shrink faster.
            self._near, self._reach = samples.part(close), approach + NEAR / 2
            meeting = meeting.part(close)
        else:
            meeting = meet(self._near, pair.femoral, pose)
        near = self._near
        strain = np.maximum(-meeting.gap, 0.0) / np.maximum(near.thickness, LEAST_THICKNESS)
        if (strain >= DEEPEST).any():
            self.beyond = min(self.beyond, approach)
            return np.inf
        pressure = layer_pressure(self._law, pair.material, strain)
        pressure[grazing(near, meeting)] = 0.0
        reaction = -float(forces_on_insert(near, meeting, pressure)[:, 1].sum())
        if approach > self.within:
            self.within, self._last = approach, reaction
        return reaction


def grazing(samples: SurfaceSamples, meeting: Meeting) -> Mask:
    """Return whether columns (n,) meet the femoral surface edge on, or not at all."""
    cosine = np.einsum("ij,ij->i", samples.normals, meeting.gradient)
    return cosine > -LEAST_COSINE


def forces_on_insert(samples: SurfaceSamples, meeting: Meeting, pressure: Array) -> Array:
    """Return the forces (n, 3), N, of columns on the insert, -p A m/(m . n).

    Args:
        samples: the columns, with area A (n,) and normals n (n, 3).
        meeting: the femoral surface that they meet, with normals m.
        pressure: p (n,), Pa; 0 for a column that grazes the femoral surface.
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

    A column of area A starts at the point x of the insert, along the normal n. It meets the femur
    at the point h with the femoral normal m. Let c = m . n and M = [m; h cross m]. A displacement
    xi = (u, w) of the femur changes the gap g by M . xi/c, so that the wrench on the insert is

        -A p(d) M/c.

    Its derivative has four terms: d changes by -M . xi/c, h moves along n by the change of g, m
    turns by w cross m and by the femoral curvature where h slides on the femur, and c changes with
    m. The femoral surface is that of `CurvedSurface`, whose slope jumps slightly between triangles;
    apart from these jumps the stiffness is the exact tangent.

    Args:
        law: law of the layer.
        state: state that the model's `prepare` returned.
    """

    exact: ClassVar[bool] = True

    def __init__(self, law: Law, state: SampledContact) -> None:
        self._law, self._state = law, state
        self._around = Neighbourhood(state)
        self._last: tuple[Array, SurfaceSamples, Meeting] | None = None

    def at(self, pose: Array) -> ProbedContact:
        """Return the contact at a pose_femoral_in_insert (4, 4), with its stiffness."""
        pose = np.asarray(pose, float)
        samples, meeting = self._columns(pose)
        loaded = meeting.gap < 0
        return self._of(samples.part(loaded), meeting.part(loaded), pose)

    def seen(self, result: ContactResult, start: WarmStart | None = None) -> ProbedContact:
        """Return the contact at the pose of a result, from the columns that it loads; see `at`."""
        if np.isnan(result.gap).any():
            return self.at(result.pose)
        samples = self._state.surface.part(result.gap < 0)
        return self._of(samples, meet(samples, self._state.pair.femoral, result.pose), result.pose)

    def _of(self, samples: SurfaceSamples, meeting: Meeting, pose: Array) -> ProbedContact:
        if not len(meeting.gap):
            through = self._state.pair.passed_through(pose) is not None
            return ProbedContact({}, known=not through, tangent=True)
        strain = -meeting.gap / np.maximum(samples.thickness, LEAST_THICKNESS)
        if not (strain < DEEPEST).all():
            return ProbedContact({}, known=False)
        force = layer_pressure(self._law, self._state.pair.material, strain) * samples.area
        rate = self._rate(samples, meeting.gap)
        edge_on = grazing(samples, meeting)
        force[edge_on] = rate[edge_on] = 0.0
        condyles = {}
        for side, sums in self._sums(samples, meeting, force, rate, pose).items():
            if sums[0] > 0.0:
                stiffness, centre = sums[10:46].reshape(6, 6), sums[1:4] / sums[0]
                # The centre is sum(x F) / sum(F) over the columns.
                slope = sums[46:64].reshape(3, 6) - np.outer(centre, sums[64:])
                condyles[side] = CondyleWrench(-sums[4:10], centre, stiffness, slope / sums[0])
        return ProbedContact(condyles, tangent=True)

    def smoothed(self, pose: Array, contact: ProbedContact) -> ProbedContact:
        """Return the contact with its stiffness averaged over a column's width; see `Probe`.

        The stiffness of a column jumps when the column comes into contact. The transverse stiffness
        of the contact may then jump by half of its value. Here each column is weighted with the
        share of its cell inside the edge of contact; the gap is linear across the cell. This adds
        resolution²/6 to the square of a circular contact's radius.
        """
        samples, meeting = self._columns(pose)
        near = (meeting.gap < WIDEST_EDGE) & ~grazing(samples, meeting)
        samples, meeting = samples.part(near), meeting.part(near)
        gap, length = meeting.gap, np.linalg.norm(meeting.gradient, axis=1)
        cosine = np.abs(np.einsum("ij,ij->i", meeting.gradient, samples.normals)) / length
        change = samples.resolution * np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / cosine
        edge = np.clip(change, APPROACH_STEP, WIDEST_EDGE)
        share = np.clip(0.5 - gap / edge, 0.0, 1.0)
        within = replace(meeting, gap=np.minimum(gap, 0.0))
        strain = -within.gap / np.maximum(samples.thickness, LEAST_THICKNESS)
        force = layer_pressure(self._law, self._state.pair.material, strain) * samples.area
        sums = self._sums(samples, within, force, self._rate(samples, within.gap) * share, pose)
        condyles = {
            side: replace(condyle, stiffness=sums[side][10:46].reshape(6, 6))
            for side, condyle in contact.condyles.items()
        }
        return replace(contact, condyles=condyles)

    def loaded_points(self, pose: Array, contact: ProbedContact, slopes: bool) -> LoadedPoints:
        """Return the pressures of the loaded columns.

        A displacement changes the gap of a column by M . xi/c, and so its pressure p(d/h) by
        -p' M . xi/(c h).

        Args:
            pose: (4, 4) pose_femoral_in_insert.
            contact: contact at that pose.
            slopes: whether to return the derivative of the pressures.
        """
        samples, meeting = self._columns(pose)
        loaded = (meeting.gap < 0) & ~grazing(samples, meeting)
        samples, meeting = samples.part(loaded), meeting.part(loaded)
        strain = -meeting.gap / np.maximum(samples.thickness, LEAST_THICKNESS)
        pressure = layer_pressure(self._law, self._state.pair.material, strain)
        medial = medial_points(samples.points, pose, self._state.pair.split)
        if not slopes:
            return LoadedPoints(pressure, samples.area, medial, None)
        met, places = meeting.gradient, samples.points + meeting.gap[:, None] * samples.normals
        rate = self._rate(samples, meeting.gap) / samples.area
        growth = -rate / np.einsum("ij,ij->i", met, samples.normals)
        slope = growth[:, None] * np.hstack([met, np.cross(places, met)])
        return LoadedPoints(pressure, samples.area, medial, slope)

    def _columns(self, pose: Array) -> tuple[SurfaceSamples, Meeting]:
        if self._last is None or not np.array_equal(self._last[0], pose):
            self._last = pose.copy(), *self._around.at(pose)
        return self._last[1:]

    def _rate(self, samples: SurfaceSamples, gap: Array) -> Array:
        """Return the derivative (n,), N/m, of the columns' forces by their penetrations."""
        thickness = np.maximum(samples.thickness, LEAST_THICKNESS)
        slope = layer_slope(self._law, self._state.pair.material, -gap / thickness)
        return slope * samples.area / thickness

    def _sums(
        self,
        samples: SurfaceSamples,
        meeting: Meeting,
        force: Array,
        rate: Array,
        pose: Array,
    ) -> dict[str, Array]:
        """Return the sums (`SUMS`,) over the columns of each side, see `_add_up`."""
        medial = medial_points(samples.points, pose, self._state.pair.split)
        sums = np.zeros((2, SUMS))
        columns = samples.points, samples.normals
        met = meeting.gradient, meeting.curvature, meeting.gap
        _add_up(*columns, *met, force, rate, medial, sums)
        return dict(zip(SIDES, sums, strict=True))


@compiled_as_written
def _add_up(
    points: Array,
    normals: Array,
    gradients: Array,
    curvatures: Array,
    gap: Array,
    force: Array,
    rate: Array,
    medial: Mask,
    sums: Array,
) -> None:
    """Sum the columns' forces, and their change as the femoral component moves.

    Args:
        points: (n, 3) m, start of the columns on the insert.
        normals: (n, 3) unit normals of the insert at these points.
        gradients: (n, 3) normals of the femoral surface where the columns meet it, of any length.
        curvatures: (n, 3, 3) 1/m, minus the derivative of `gradients` by the place on the femur.
        gap: (n,) m.
        force: (n,) N, pressure times area of each column.
        rate: (n,) N/m, derivative of `force` by the penetration along the insert's normal.
        medial: (n,) whether a column belongs to the medial condyle.
        sums: (2, `SUMS`) output for medial and lateral, to which the columns are added: force (N),
            force times point (3,) N·m, wrench on the femoral component (6,), stiffness of the
            wrench on the insert (6, 6), and of force times point (3, 6) and force (6,), by a
            displacement. Force is the magnitude of a column's force.
    """
    met, place, change = np.empty(6), np.empty(3), np.empty((6, 6))
    for n in range(len(points)):
        if force[n] == 0.0 and rate[n] == 0.0:
            continue
        side_sums, cosine, length = sums[0 if medial[n] else 1], 0.0, 0.0
        for i in range(3):
            met[i] = gradients[n, i]
            cosine += met[i] * normals[n, i]
            length += met[i] ** 2
            place[i] = points[n, i] + gap[n] * normals[n, i]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            met[3 + i] = place[j] * met[k] - place[k] * met[j]
        size = -force[n] / cosine
        weight = size * np.sqrt(length)
        side_sums[0] += weight
        for i in range(3):
            side_sums[1 + i] += weight * points[n, i]
        _turn(normals[n], curvatures[n], place, met, cosine, change)
        for i in range(6):
            side_sums[4 + i] -= size * met[i]
        for j in range(6):
            turned, stretched = 0.0, 0.0  # n . dm, m . dm
            for k in range(3):
                turned += normals[n, k] * change[k, j]
                stretched += met[k] * change[k, j]
            resized = met[j] * (rate[n] / cosine**2) - size * turned / cosine
            for i in range(6):
                side_sums[10 + 6 * i + j] += resized * met[i] + size * change[i, j]
            reweighed = (resized * length + size * stretched) / np.sqrt(length)
            side_sums[64 + j] += reweighed
            for i in range(3):
                side_sums[46 + 6 * i + j] += reweighed * points[n, i]


@compiled_as_written
def _turn(
    normal: Array, curvature: Array, place: Array, met: Array, cosine: float, change: Array
) -> None:
    """Write the derivative (6, 6) of M = [m; h x m] by a displacement of the femoral component.

    Args:
        normal: n (3,), of the column.
        curvature: (3, 3) 1/m, see `_add_up`.
        place: h (3,), m.
        met: M (6,).
        cosine: m . n.
        change: (6, 6) output.
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
