"""Ligament bundles: straight or wrapping lines between two links that pull and never push.

`generic_ligaments` scales a set of bundles to the implant, for a patient without measured
ligaments. Femoral ends are relative to the axis of the posterior condyles, near which collaterals
are nearly isometric. The proportions are those of an average knee: check the strain table before
using any force.

References: Abdel-Rahman & Hefzy, Med Eng Phys 20:276 (1998) (stiffness); Blankevoort & Huiskes,
J Biomech Eng 113:263 (1991), doi:10.1115/1.2894883 (strains at extension).
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, cross_matrix, inverse, transform
from tkamb.geometry.surface import Surface
from tkamb.knee.chain import Chain
from tkamb.knee.ligament_laws import LIGAMENT_LAWS, LigamentLaw, StackedLaws, TwoLine
from tkamb.knee.load import LinkPoint, PointForces
from tkamb.knee.wrap_object import WrapObject
from tkamb.units import DEGREE, MILLIMETRE

# rad: largest difference between the reference flexion and the flexion of the nearest frame.
# At a larger difference the strain differs.
MAX_REFERENCE_DISTANCE = 15.0 * DEGREE


@dataclass(frozen=True, eq=False)
class Ligament:
    """One bundle between a point of one link and a point of another, straight or over surfaces.

    Tension acts along the taut path (`tkamb.knee.ligament_paths`).

    Args:
        law: tension by length: `TwoLine(stiffness=...)` with N/m, `QuadraticToe(stiffness=...)`
            with N per unit strain, or another `LigamentLaw`.
        slack_length: slack length, m; NaN: it is computed from the reference strain.
        reference_strain: strain at the reference pose, 1.
        reference_flexion: flexion of the reference pose, rad.
        wraps: surfaces that the bundle wraps; the body of each is a link. A section is wrapped from
            the proximal to the distal end. Empty: the bundle is straight.

    Raises:
        InputError: the law is no `LigamentLaw`.
    """

    name: str
    proximal: LinkPoint
    distal: LinkPoint
    law: LigamentLaw
    slack_length: float = float("nan")
    reference_strain: float = float("nan")
    reference_flexion: float = 0.0
    wraps: tuple[WrapObject, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.law, LigamentLaw):
            names = LIGAMENT_LAWS.names()
            hint = "give an object, such as law=tkamb.TwoLine(stiffness=...), stiffness in N/m"
            if isinstance(self.law, str) and self.law not in names:
                hint = names_near(self.law, names)
            raise InputError(f"{self.law!r} is no law", f"ligament {self.name}", hint)

    def ends(self, poses: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return proximal and distal end (..., 3), m, in the insert frame."""
        proximal = transform(poses[self.proximal.link], self.proximal.position)
        return proximal, transform(poses[self.distal.link], self.distal.position)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links of ends and surfaces, each once."""
        bodies = (wrap.body for wrap in self.wraps)
        return tuple(dict.fromkeys((self.proximal.link, self.distal.link, *bodies)))

    def on_links(self, placed: Mapping[str, tuple[str, Array]]) -> "Ligament":
        """Return the bundle on other links (link -> other, pose_link_in_other) that move alike."""

        def point(end: LinkPoint) -> LinkPoint:
            link, pose = placed[end.link]
            return LinkPoint(link, transform(pose, end.position))

        wraps = tuple(wrap.on(*placed[wrap.body]) for wrap in self.wraps)
        return replace(self, proximal=point(self.proximal), distal=point(self.distal), wraps=wraps)

    def points(self, poses: Mapping[str, Array]) -> Array:
        """Return points (..., n, 3), m, along the path in the insert frame, ends included."""
        if self.wraps:
            from tkamb.knee.ligament_paths import bundle_paths  # imports numba

            return bundle_paths((self,), poses).points[0]
        return np.stack(self.ends(poses), axis=-2)

    def length(self, poses: Mapping[str, Array]) -> Array:
        """Return the length (...,) of the path, m; NaN if there is no taut path."""
        if self.wraps:
            from tkamb.knee.ligament_paths import bundle_paths  # imports numba

            return bundle_paths((self,), poses).length[0]
        proximal, distal = self.ends(poses)
        return np.asarray(np.linalg.norm(distal - proximal, axis=-1))

    def strain(self, length: ArrayLike) -> Array:
        """Return the strain (L - L0)/L0 at a length L (m)."""
        return np.asarray(length, float) / self.slack_length - 1.0

    def force(self, length: ArrayLike) -> Array:
        """Return the tension (N), never negative, at a length (m)."""
        return self.law.tension(length, self.slack_length)


PROXIMAL, DISTAL = "proximal", "distal"
"""Names of the two bodies of `BundleArrays`."""
# m: step of the finite differences of bundles that wrap. A path is exact to 1e-11,
# and its curvature changes over millimetres.
DIFFERENCE_STEP = 1e-6
# m: arm that turns the step into a rotation. The order of the knee's radius.
DIFFERENCE_ARM = 0.03


@dataclass(frozen=True, eq=False)
class BundleArrays:
    """m straight bundles between two bodies as arrays, and the bundles that wrap.

    Args:
        proximal: proximal ends in one frame, (m, 3), m.
        distal: distal ends in one frame, (m, 3), m.
        slack_length: slack lengths, (m,), m.
        wrapping: bundles that wrap, with the links `PROXIMAL` and `DISTAL`.
    """

    proximal: Array
    distal: Array
    laws: StackedLaws
    slack_length: Array
    wrapping: tuple[Ligament, ...] = ()

    @classmethod
    def between(cls, bundles: Sequence[Ligament]) -> "BundleArrays":
        """Return bundles with ends and surfaces on the links `PROXIMAL` and `DISTAL`."""
        straight = [bundle for bundle in bundles if not bundle.wraps]
        ends = [{e.link: e.position for e in (b.proximal, b.distal)} for b in straight]
        first, last = (np.array([end[link] for end in ends]) for link in (PROXIMAL, DISTAL))
        wrapping = tuple(bundle for bundle in bundles if bundle.wraps)
        return replace(cls.of(straight, first, last), wrapping=wrapping)

    @classmethod
    def of(cls, bundles: Sequence[Ligament], proximal: Array, distal: Array) -> "BundleArrays":
        """Return the arrays of straight bundles with the given ends (m, 3), m."""
        return cls(
            proximal.reshape(-1, 3),
            distal.reshape(-1, 3),
            StackedLaws.of([bundle.law for bundle in bundles]),
            np.array([bundle.slack_length for bundle in bundles], float),
        )

    def pulls(self, proximal: Array, distal: Array) -> tuple[Array, Array]:
        """Return tensions (..., m), N, and forces (..., m, 3), N, on distal ends."""
        along = proximal - distal
        length = np.sqrt((along * along).sum(axis=-1))
        tension = self.laws.tension(length, self.slack_length)
        return tension, (tension / length)[..., None] * along

    def tangent(self, pose: Array) -> Array:
        """Return the derivative (6, 6) of `wrench` by a small displacement of the proximal body.

        The pull T u on a distal end changes by (T/L (I - u u^T) + T' u u^T) dx, with the
        displacement dx of the proximal end, the length L and the law's slope T'. Bundles that wrap
        have central differences. `pose` is of the proximal in the distal frame.
        """
        proximal = transform(pose, self.proximal)
        along = proximal - self.distal
        length = np.linalg.norm(along, axis=-1)
        tension, _ = self.pulls(proximal, self.distal)
        slope, ratio = self.laws.slope(length, self.slack_length), tension / length
        directions = along / length[:, None]
        square = directions[:, :, None] * directions[:, None, :]
        change = ratio[:, None, None] * np.eye(3) + (slope - ratio)[:, None, None] * square
        by_rotation = -change @ cross_matrix(proximal)
        by_displacement = np.concatenate([change, by_rotation], axis=2)
        moment = cross_matrix(self.distal) @ by_displacement
        total = np.concatenate([by_displacement.sum(axis=0), moment.sum(axis=0)])
        if self.wrapping:
            from tkamb.knee.contact import DifferenceSettings, differences

            settings = DifferenceSettings(step=DIFFERENCE_STEP, arm=DIFFERENCE_ARM)
            total += differences(self._wrapping_wrench, pose, settings)
        return total

    def wrench(self, poses: Array) -> Array:
        """Return the wrench (..., 6) on the distal body, about its frame's origin.

        `poses` (..., 4, 4) are of the proximal in the distal frame.
        """
        proximal = self.proximal @ poses[..., :3, :3].swapaxes(-1, -2) + poses[..., None, :3, 3]
        _, pull = self.pulls(proximal, self.distal)
        moment = pull.reshape(*pull.shape[:-2], -1) @ self._levers
        total = np.concatenate([pull.sum(axis=-2), moment], axis=-1)
        return total + self._wrapping_wrench(poses) if self.wrapping else total

    @cached_property
    def _levers(self) -> Array:
        """Matrix (3 m, 3) that maps the m pulls on the distal ends to their moment."""
        return cross_matrix(self.distal).swapaxes(1, 2).reshape(-1, 3)

    def _wrapping_wrench(self, poses: Array) -> Array:
        from tkamb.knee.ligament_paths import taut_wrenches  # imports numba

        placed = {PROXIMAL: poses, DISTAL: np.eye(4)}
        return np.asarray(taut_wrenches(self.wrapping, placed)[1][DISTAL].sum(axis=0))


def ligament_loads(
    ligaments: Sequence[Ligament], poses: Mapping[str, Array]
) -> tuple[Array, tuple[PointForces, ...]]:
    """Return the tensions (n,), N, and the loads on the links; their sum is zero.

    All straight bundles give one load per link, all that wrap another. `poses` (4, 4) are in the
    insert frame.

    Raises:
        ComputationError: a bundle has no taut path over its surfaces.
    """
    wraps = np.array([bool(bundle.wraps) for bundle in ligaments])
    if not wraps.any():
        return _straight_loads(ligaments, poses)
    from tkamb.knee.ligament_paths import taut_wrenches  # imports numba

    loads: list[PointForces] = []
    tension = np.zeros(len(ligaments))
    straight = [bundle for bundle in ligaments if not bundle.wraps]
    if straight:
        tension[~wraps], straight_loads = _straight_loads(straight, poses)
        loads += straight_loads
    tension[wraps], on_links = taut_wrenches([b for b in ligaments if b.wraps], poses)
    for link, wrenches in on_links.items():
        wrench = wrenches.sum(axis=0)
        loads.append(PointForces(link, np.zeros((1, 3)), wrench[None, :3], wrench[3:]))
    return tension, tuple(loads)


def _straight_loads(
    ligaments: Sequence[Ligament], poses: Mapping[str, Array]
) -> tuple[Array, tuple[PointForces, ...]]:
    points = [*(bundle.proximal for bundle in ligaments), *(bundle.distal for bundle in ligaments)]
    links = np.array([point.link for point in points]).reshape(2, -1)
    link_poses = np.array([poses[point.link] for point in points], float)
    positions = np.array([point.position for point in points], float)
    ends = np.einsum("nij,nj->ni", link_poses[:, :3, :3], positions) + link_poses[:, :3, 3]
    ends = ends.reshape(2, -1, 3)
    tension, pull = BundleArrays.of(ligaments, *ends).pulls(*ends)
    loads = []
    for link in dict.fromkeys(links.ravel().tolist()):
        on_link = links == link
        forces = np.concatenate([-pull[on_link[0]], pull[on_link[1]]])
        loads.append(PointForces(link, ends[on_link], forces))
    return tension, tuple(loads)


def build_ligaments(
    ligaments: Sequence[Ligament], poses: Mapping[str, Array], flexion: Array
) -> tuple[Ligament, ...]:
    """Return the bundles with slack lengths.

    A missing slack length follows from the reference strain eps_r and the length L_r in the frame
    nearest to the reference flexion: L0 = L_r/(1 + eps_r). `poses` (f, 4, 4) are in the insert
    frame, `flexion` (f,) in rad.
    """
    flexion = np.asarray(flexion, float)
    return tuple(_with_slack_length(bundle, poses, flexion) for bundle in ligaments)


def _with_slack_length(bundle: Ligament, poses: Mapping[str, Array], flexion: Array) -> Ligament:
    where = f"ligament {bundle.name}"
    for link in bundle.links:
        if link not in poses:
            raise InputError(f"no link '{link}'", where, names_near(link, poses))
    reference = nearest_frame(flexion, bundle.reference_flexion)
    length = float(bundle.length(_frame(poses, reference)))
    if np.isnan(length):
        raise InputError(
            f"has no taut path over {', '.join(wrap.name for wrap in bundle.wraps)} at "
            f"{flexion[reference] / DEGREE:.0f} deg of flexion",
            where,
            "no end may lie inside a cylinder, a sphere or a section: check the surface's place",
        )
    if length == 0.0:
        raise InputError("both ends are the same point", where)
    # A slack length that is given needs no reference pose.
    if not np.isnan(bundle.slack_length):
        return bundle
    if abs(flexion[reference] - bundle.reference_flexion) > MAX_REFERENCE_DISTANCE:
        raise InputError(
            f"its reference pose is at {bundle.reference_flexion / DEGREE:g} deg of flexion, but "
            f"the nearest recorded frame is at {flexion[reference] / DEGREE:.0f} deg",
            where,
            "give slack_length_mm, or a reference strain at a flexion that was recorded; check the "
            f"motion's angle_unit: flexion is read as {np.nanmin(flexion) / DEGREE:.3g} to "
            f"{np.nanmax(flexion) / DEGREE:.3g} deg",
        )
    # The definition of the strain, e = L / L0 - 1, solved for L0.
    return replace(bundle, slack_length=length / (1.0 + bundle.reference_strain))


def nearest_frame(flexion: Array, target: float) -> int:
    """Return the index of the flexion (f,), rad, nearest to a target."""
    return int(np.nanargmin(np.abs(flexion - target)))


def strain_table(
    ligaments: Sequence[Ligament],
    poses: Mapping[str, Array],
    flexion: Array,
    at_deg: Sequence[float] = (0.0, 60.0, 90.0),
    within_deg: float = 10.0,
) -> dict[str, tuple[float, ...]]:
    """Return each bundle's strain at a few flexions; an unlikely one reveals a wrong end.

    Args:
        poses: link -> pose_link_in_insert (f, 4, 4).
        flexion: flexion in these frames, (f,), rad.
        at_deg: flexions, deg, of which the nearest recorded frame is taken.
        within_deg: largest difference of that frame's flexion, deg; beyond it the strain is NaN.
    """
    frames = [nearest_frame(flexion, angle * DEGREE) for angle in at_deg]
    is_near = [
        abs(flexion[k] - angle * DEGREE) <= within_deg * DEGREE
        for k, angle in zip(frames, at_deg, strict=True)
    ]
    table = {}
    for bundle in ligaments:
        strain = [float(bundle.strain(bundle.length(_frame(poses, k)))) for k in frames]
        table[bundle.name] = tuple(s if r else np.nan for s, r in zip(strain, is_near, strict=True))
    return table


def _frame(poses: Mapping[str, Array], k: int) -> dict[str, Array]:
    return {
        link: np.asarray(p)[k] if np.ndim(p) == 3 else np.asarray(p) for link, p in poses.items()
    }


# m: an end farther than this beyond the middle of the knee is on the wrong side.
# Collateral ligaments end 20 to 45 mm from the middle, and the frames' origins lie closer to the
# middle than this distance.
WRONG_SIDE_DISTANCE = 8.0 * MILLIMETRE


_KINDS = r"(collateral|retinacul|patell[ao])"
_MEDIAL = re.compile(
    rf"mcl|mpfl|(medial|tibial)[ _-]*{_KINDS}|{_KINDS}\w*[ _-]+medial", re.IGNORECASE
)
_LATERAL = re.compile(
    rf"(?<![a-z])l[ _-]?cl|fcl|lpfl|(?<![a-z])itb|iliotibial|(lateral|fibular)[ _-]*{_KINDS}"
    rf"|{_KINDS}\w*[ _-]+lateral",
    re.IGNORECASE,
)


def check_collateral_sides(ligaments: Iterable[Ligament], chain: Chain, side: str) -> None:
    """Raise an error if a ligament's name and its position belong to different sides of the knee.

    z points laterally: the knee is a right or a mirrored left one. `side` is that of the patient's
    knee, for the message.
    """
    for bundle in ligaments:
        sign = _lateral_sign(bundle.name)
        for name, end in (("proximal", bundle.proximal), ("distal", bundle.distal)):
            lateral = _lateral_position(end, chain)
            if sign * lateral < -WRONG_SIDE_DISTANCE:
                opposite, named_side = ("lateral", "medial") if sign < 0 else ("medial", "lateral")
                raise InputError(
                    f"its {name} end lies {abs(lateral) / MILLIMETRE:.0f} mm on the {opposite} "
                    f"side of this {side} knee, but by its name it is a {named_side} ligament",
                    f"[[ligament]] {bundle.name}",
                    "change the sign of z in point_mm (z points to the right in both knees), or "
                    "correct [patient] side or the name",
                )


def _lateral_sign(name: str) -> int:
    """Return -1 for the name of a medial ligament, 1 for a lateral one, else 0."""
    medial, lateral = bool(_MEDIAL.search(name)), bool(_LATERAL.search(name))
    return int(lateral) - int(medial)


def _lateral_position(end: LinkPoint, chain: Chain) -> float:
    carrier = chain.carrier(end.link)
    position = transform(chain.link_in(end.link, carrier), end.position)
    if carrier == "tibia":
        position = transform(inverse(chain.insert_in_tibia), position)
    return float(position[2])


PREFIX = "generic_"


@dataclass(frozen=True)
class _Bundle:
    """The strain is that in extension."""

    proximal: tuple[float, float, float]
    distal: tuple[float, float, float]
    stiffness_N_per_mm: float
    reference_strain: float


BUNDLES = {
    "MCL_anterior": _Bundle((0.04, 0.01, -1.20), (0.08, -1.40, -0.84), 91.25, 0.04),
    "MCL_oblique": _Bundle((-0.03, 0.00, -1.20), (-0.38, -0.16, -0.97), 27.86, 0.04),
    "MCL_deep": _Bundle((0.03, 0.00, -1.17), (-0.08, -0.08, -1.00), 21.07, 0.03),
    "LCL": _Bundle((-0.01, 0.00, 1.17), (-0.54, -0.38, 1.10), 72.22, -0.05),
    "PCL_anterolateral": _Bundle((0.01, -0.14, -0.17), (-0.70, -0.08, 0.00), 125.0, -0.24),
    "PCL_posteromedial": _Bundle((-0.03, -0.11, -0.20), (-0.70, -0.14, -0.08), 60.0, -0.03),
    "ACL_anteromedial": _Bundle((-0.20, 0.11, 0.20), (0.22, -0.08, -0.05), 83.15, 0.06),
    "ACL_posterolateral": _Bundle((-0.11, -0.03, 0.23), (0.05, -0.08, 0.08), 83.15, 0.10),
}
"""Generic bundles of a right knee. Ends are in half widths of the part, x anterior, y superior,
z lateral. Proximal ends are relative to the condylar axis, distal ends to the insert's origin."""


def generic_ligaments(
    femoral: Surface,
    insert: Surface,
    pose_insert_in_tibia: Array,
    chosen: Sequence[str] = ("MCL", "LCL", "PCL"),
) -> tuple[Ligament, ...]:
    """Return the bundles of a generic set, scaled to an implant.

    Args:
        femoral: surface of the femoral component in the femur link's frame (right knee).
        insert: surface of the insert in the insert frame.
        pose_insert_in_tibia: pose, (4, 4).
        chosen: names of the patient's ligaments, some of MCL, LCL, PCL, ACL.

    Returns:
        Bundles between the links "femur" and "tibia"; the reference pose is extension.

    Raises:
        InputError: a ligament is unknown.
    """
    names = {name.split("_")[0] for name in BUNDLES}
    for name in chosen:
        if name not in names:
            raise InputError(
                f"no generic ligament '{name}'", None, f"there are {', '.join(sorted(names))}"
            )
    axis = condylar_axis(femoral)
    femoral_unit = 0.5 * float(np.ptp(femoral.bounds[:, 2]))
    insert_unit = 0.5 * float(np.ptp(insert.bounds[:, 2]))
    ligaments = []
    for name, bundle in BUNDLES.items():
        if name.split("_")[0] in chosen:
            proximal = axis + femoral_unit * np.array(bundle.proximal)
            distal = transform(pose_insert_in_tibia, insert_unit * np.array(bundle.distal))
            ligaments.append(
                Ligament(
                    PREFIX + name,
                    LinkPoint("femur", proximal),
                    LinkPoint("tibia", distal),
                    TwoLine(bundle.stiffness_N_per_mm / MILLIMETRE),
                    reference_strain=bundle.reference_strain,
                )
            )
    return tuple(ligaments)


def condylar_axis(femoral: Surface) -> Array:
    """Return the centre (3,) of the circle that fits the posterior condyles, m.

    The axis is parallel to z. At a flexion phi let u be downward in the femur's frame. The support,
    the maximum of u . p over the vertices p, is u . c + r for a circle of centre c and radius r;
    least squares fit c and r to those at 20 to 100 deg. The z of the centre is the middle of the
    component's width.
    """
    flexion = np.deg2rad(np.arange(20.0, 101.0, 5.0))
    down = np.column_stack([-np.sin(flexion), -np.cos(flexion)])
    support = (femoral.vertices[:, :2] @ down.T).max(axis=0)
    columns = np.column_stack([down, np.ones(len(flexion))])
    (x, y, _), *_ = np.linalg.lstsq(columns, support, rcond=None)
    return np.array([x, y, float(femoral.bounds[:, 2].mean())])
