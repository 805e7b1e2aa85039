"""Ligament bundles: straight lines between two links that pull and never push.

With slack length L0 and strain eps = (L - L0)/L0, eps1 = 0.03:

    two-line (k in N/m)                         quadratic toe (k_eps in N per unit strain)
    F = 0                      eps <= 0         F = 0                        eps <= 0
    F = (k/2) (L - L0)         eps <= 2 eps1    F = k_eps eps²/(4 eps1)      eps <= 2 eps1
    F = k (L - (1 + eps1) L0)  otherwise        F = k_eps (eps - eps1)       otherwise

Both are continuous; the first has a kink at 2 eps1, the second has none.

References: Abdel-Rahman & Hefzy, Med Eng Phys 20:276 (1998); Blankevoort & Huiskes,
J Biomech Eng 113:263 (1991), doi:10.1115/1.2894883.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.body.load import PointForces
from tkamb.errors import InputError, names_near
from tkamb.geometry.frames import Array, transform
from tkamb.scene.tables import Attachment, LigamentTable
from tkamb.units import DEGREE, MILLIMETRE

TOE_STRAIN = 0.03
"""eps1: the toe region ends at twice this strain, the same for every ligament."""

FARTHEST_REFERENCE = 15.0 * DEGREE
"""rad: a recorded frame farther than this from the reference flexion is no reference pose."""

Law = Literal["two-line", "quadratic-toe"]


def two_line_force(length: ArrayLike, slack_length: ArrayLike, stiffness: ArrayLike) -> Array:
    """Return the tension (N) of the two-line law; `stiffness` in N/m, lengths in m."""
    length, slack = np.asarray(length, float), np.asarray(slack_length, float)
    toe = 0.5 * np.asarray(stiffness) * (length - slack)
    line = np.asarray(stiffness) * (length - (1.0 + TOE_STRAIN) * slack)
    strain = (length - slack) / slack
    return np.where(strain <= 0.0, 0.0, np.where(strain <= 2.0 * TOE_STRAIN, toe, line))


def quadratic_toe_force(length: ArrayLike, slack_length: ArrayLike, stiffness: ArrayLike) -> Array:
    """Return the tension (N) of the quadratic-toe law; `stiffness` in N per unit strain."""
    length, slack = np.asarray(length, float), np.asarray(slack_length, float)
    strain = (length - slack) / slack
    toe = np.asarray(stiffness) * strain**2 / (4.0 * TOE_STRAIN)
    line = np.asarray(stiffness) * (strain - TOE_STRAIN)
    return np.where(strain <= 0.0, 0.0, np.where(strain <= 2.0 * TOE_STRAIN, toe, line))


@dataclass(frozen=True, eq=False)
class Ligament:
    """One bundle on a straight line between a point of one link and a point of another.

    Args:
        name: as in the scene.
        proximal_link: link of the proximal end.
        proximal_point: (3,) m, in that link's frame.
        distal_link: link of the distal end.
        distal_point: (3,) m, in that link's frame.
        law: which of the two laws.
        stiffness: N/m for "two-line", N per unit strain for "quadratic-toe".
        slack_length: m.
    """

    name: str
    proximal_link: str
    proximal_point: Array
    distal_link: str
    distal_point: Array
    law: Law
    stiffness: float
    slack_length: float

    def ends(self, poses: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return proximal and distal end (..., 3) in the insert frame.

        Args:
            poses: link -> pose_link_in_insert, (4, 4) or (f, 4, 4).
        """
        proximal = transform(poses[self.proximal_link], self.proximal_point)
        return proximal, transform(poses[self.distal_link], self.distal_point)

    def length(self, poses: Mapping[str, Array]) -> Array:
        """Return the distance (...,) between the ends, m."""
        proximal, distal = self.ends(poses)
        return np.asarray(np.linalg.norm(distal - proximal, axis=-1))

    def strain(self, length: ArrayLike) -> Array:
        """Return (L - L0)/L0."""
        return np.asarray(length, float) / self.slack_length - 1.0

    def force(self, length: ArrayLike) -> Array:
        """Return the tension (N), never negative, at a length (m)."""
        law = two_line_force if self.law == "two-line" else quadratic_toe_force
        return law(length, self.slack_length, self.stiffness)

    def loads(self, poses: Mapping[str, Array]) -> tuple[float, tuple[PointForces, PointForces]]:
        """Return the tension (N) and what it does to the two links, at one frame.

        The two forces are equal and opposite and lie on the line through both ends.
        """
        proximal, distal = self.ends(poses)
        length = float(np.linalg.norm(distal - proximal))
        tension = float(self.force(length))
        pull = (tension / length * (distal - proximal))[None]
        return tension, (
            PointForces(self.proximal_link, proximal[None], pull),
            PointForces(self.distal_link, distal[None], -pull),
        )


def ligament_loads(
    ligaments: Sequence[Ligament], poses: Mapping[str, Array]
) -> tuple[Array, tuple[PointForces, ...]]:
    """Return all tensions (n,) N and what they do to the links, at one frame.

    The same as `Ligament.loads` of every bundle, gathered into one load per link.

    Args:
        ligaments: the bundles.
        poses: link -> pose_link_in_insert (4, 4).
    """
    proximal_links = np.array([bundle.proximal_link for bundle in ligaments])
    distal_links = np.array([bundle.distal_link for bundle in ligaments])
    proximal = _placed(proximal_links, [b.proximal_point for b in ligaments], poses)
    distal = _placed(distal_links, [b.distal_point for b in ligaments], poses)
    along = distal - proximal
    length = np.linalg.norm(along, axis=1)
    slack = np.array([bundle.slack_length for bundle in ligaments])
    stiffness = np.array([bundle.stiffness for bundle in ligaments])
    two_line = np.array([bundle.law == "two-line" for bundle in ligaments], bool)
    tension = np.where(
        two_line,
        two_line_force(length, slack, stiffness),
        quadratic_toe_force(length, slack, stiffness),
    )
    pull = (tension / length)[:, None] * along
    loads = []
    for link in dict.fromkeys([*proximal_links.tolist(), *distal_links.tolist()]):
        up, down = proximal_links == link, distal_links == link
        points = np.concatenate([proximal[up], distal[down]])
        loads.append(PointForces(link, points, np.concatenate([pull[up], -pull[down]])))
    return tension, tuple(loads)


def build_ligaments(
    tables: Sequence[LigamentTable], poses: Mapping[str, Array], flexion: Array
) -> tuple[Ligament, ...]:
    """Return the scene's bundles, slack lengths found where a reference strain is given.

    A reference strain eps_r holds at the frame nearest to the reference flexion, where the
    bundle has length L_r: L0 = L_r/(1 + eps_r).

    Args:
        tables: the scene's [[ligament]] tables.
        poses: link -> pose_link_in_insert (f, 4, 4).
        flexion: (f,) rad, of the same frames.

    Raises:
        InputError: unknown link, an end that lies on the other one, or no recorded frame near
            the reference flexion.
    """
    return tuple(_build(table, poses, np.asarray(flexion, float)) for table in tables)


def _build(table: LigamentTable, poses: Mapping[str, Array], flexion: Array) -> Ligament:
    stiffness = table.stiffness_N_per_strain
    if table.stiffness_N_per_mm is not None:
        stiffness = table.stiffness_N_per_mm / MILLIMETRE
    if stiffness is None:
        raise InputError("has no stiffness", f"ligament {table.name}")
    for end in (table.proximal, table.distal):
        if end.link not in poses:
            where = f"ligament {table.name}"
            raise InputError(f"no link '{end.link}'", where, names_near(end.link, poses))
    bundle = Ligament(
        table.name,
        table.proximal.link,
        _metres(table.proximal),
        table.distal.link,
        _metres(table.distal),
        table.law,
        stiffness,
        1.0,
    )
    reference = nearest_frame(flexion, table.reference_flexion_deg)
    length = float(bundle.length(_frame(poses, reference)))
    if length == 0.0:
        raise InputError("both ends are the same point", f"ligament {table.name}")
    if table.slack_length_mm is not None:
        slack = table.slack_length_mm * MILLIMETRE
    else:
        _check_reference(table, float(flexion[reference]))
        slack = length / (1.0 + float(table.reference_strain or 0.0))
    return Ligament(**{**vars(bundle), "slack_length": slack})


def _check_reference(table: LigamentTable, flexion: float) -> None:
    if abs(flexion - table.reference_flexion_deg * DEGREE) > FARTHEST_REFERENCE:
        raise InputError(
            f"its reference pose is at {table.reference_flexion_deg:g} deg of flexion, but the "
            f"nearest recorded frame is at {flexion / DEGREE:.0f} deg",
            f"ligament {table.name}",
            "give slack_length_mm, or a reference strain at a flexion that was recorded",
        )


def nearest_frame(flexion: Array, flexion_deg: float) -> int:
    """Return the index of the frame whose flexion (rad) is nearest to `flexion_deg`."""
    return int(np.nanargmin(np.abs(flexion - flexion_deg * DEGREE)))


def strain_table(
    ligaments: Sequence[Ligament],
    poses: Mapping[str, Array],
    flexion: Array,
    at_deg: Sequence[float] = (0.0, 60.0, 90.0),
    within_deg: float = 10.0,
) -> dict[str, tuple[float, ...]]:
    """Return strain per bundle at given flexions, so that a wrong insertion is seen.

    Args:
        ligaments: the bundles.
        poses: link -> pose_link_in_insert (f, 4, 4).
        flexion: (f,) rad, of the same frames.
        at_deg: flexions to look at; the nearest recorded frame is taken.
        within_deg: NaN where no recorded frame is nearer than this.

    Returns:
        name -> strain at each flexion.
    """
    frames = [nearest_frame(flexion, angle) for angle in at_deg]
    reached = [
        abs(flexion[k] - angle * DEGREE) <= within_deg * DEGREE
        for k, angle in zip(frames, at_deg, strict=True)
    ]
    table = {}
    for bundle in ligaments:
        strain = [float(bundle.strain(bundle.length(_frame(poses, k)))) for k in frames]
        table[bundle.name] = tuple(s if r else np.nan for s, r in zip(strain, reached, strict=True))
    return table


def _placed(links: NDArray[np.str_], points: list[Array], poses: Mapping[str, Array]) -> Array:
    """Return points (n, 3), each given in its own link, in the insert frame."""
    placed = np.array(points, float).reshape(-1, 3)
    for link in np.unique(links):
        rows = links == link
        placed[rows] = transform(poses[str(link)], placed[rows])
    return placed


def _metres(end: Attachment) -> Array:
    return np.asarray(end.point_mm, float) * MILLIMETRE


def _frame(poses: Mapping[str, Array], k: int) -> dict[str, Array]:
    return {
        link: np.asarray(p)[k] if np.ndim(p) == 3 else np.asarray(p) for link, p in poses.items()
    }
