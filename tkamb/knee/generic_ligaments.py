"""A generic ligament set, scaled to the implant, for a patient without measured ligaments.

Femoral ends are placed about the axis of the posterior condyles, near which the collaterals
are nearly isometric; distal ends about the insert's flat bottom. The proportions are those
of an average knee in units of half the mediolateral width of the part (femoral component,
insert). They do not belong to a real patient: check the strain table before using any force.

Stiffness: Abdel-Rahman & Hefzy, Med Eng Phys 20:276 (1998); reference strains at
extension: Blankevoort & Huiskes, J Biomech Eng 113:263 (1991), doi:10.1115/1.2894883.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, transform
from tkamb.geometry.surface import Surface
from tkamb.knee.ligaments import Ligament
from tkamb.knee.load import LinkPoint
from tkamb.units import MILLIMETRE

PREFIX = "generic_"


@dataclass(frozen=True)
class _Bundle:
    """One bundle of a right knee: ends in half widths, stiffness, strain at extension."""

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
"""Right knee, z lateral; x anterior, y superior, from the condylar axis and the insert frame."""


def generic_ligaments(
    femoral: Surface,
    insert: Surface,
    pose_insert_in_tibia: Array,
    chosen: Sequence[str] = ("MCL", "LCL", "PCL"),
) -> tuple[Ligament, ...]:
    """Return the bundles of a generic set, scaled to an implant.

    Args:
        femoral: femoral component in the femur link's frame (right knee).
        insert: insert in the insert frame.
        pose_insert_in_tibia: (4, 4).
        chosen: ligaments that the patient has, of MCL, LCL, PCL, ACL.

    Returns:
        Bundles between the links "femur" and "tibia"; the reference pose is extension.

    Raises:
        InputError: no such ligament.
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
                    "two-line",
                    bundle.stiffness_N_per_mm / MILLIMETRE,
                    reference_strain=bundle.reference_strain,
                )
            )
    return tuple(ligaments)


def condylar_axis(femoral: Surface) -> Array:
    """Return the centre (3,) of the circle that the posterior condyles roll on, m.

    It is a point of the condylar axis, which is parallel to z. At a flexion phi let u be the
    direction of the femur that faces down. The support of the component in this direction is
    h(u) = max over the vertices p of u . p. For a circle of centre c and radius r it is
    u . c + r. c and r are fitted by least squares to the supports at 20 to 100 deg of flexion. z is
    the middle of the component's width.

    Args:
        femoral: in the femur's frame.
    """
    flexion = np.deg2rad(np.arange(20.0, 101.0, 5.0))
    down = np.column_stack([-np.sin(flexion), -np.cos(flexion)])
    support = (femoral.vertices[:, :2] @ down.T).max(axis=0)
    columns = np.column_stack([down, np.ones(len(flexion))])
    (x, y, _), *_ = np.linalg.lstsq(columns, support, rcond=None)
    return np.array([x, y, float(femoral.bounds[:, 2].mean())])
