"""A Winkler foundation: vertical springs of one stiffness per area."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tkamb.contact.bed import Bed, sample_bed
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import ContactPair, PreparedContact
from tkamb.contact.pressing import approach_at
from tkamb.contact.result import ContactResult
from tkamb.contact.summary import medial_points, summarise_condyles, wrench_of
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.frames import inverse, rotate, transform
from tkamb.geometry.rays import RayCaster

UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class WinklerState(PreparedContact):
    """The bed and the femoral component's ray caster."""

    pair: ContactPair
    bed: Bed
    femoral_rays: RayCaster

    @property
    def points(self):
        """Map points (n, 3) m."""
        return self.bed.points

    @property
    def triangles(self):
        """Map triangles (k, 3)."""
        return self.bed.triangles


@dataclass(frozen=True)
class Winkler(ContactModel):
    """Pressure = modulus times vertical overlap, whatever the material and the thickness."""

    name: ClassVar[str] = "winkler"
    assumes: ClassVar[str] = "vertical springs of one stiffness per area"
    needs: ClassVar[str] = "a closed insert"

    resolution: float = 1e-3
    modulus: float = 2e11

    def prepare(self, pair):
        """Sample the articular surface."""
        bed = sample_bed(pair.insert, self.resolution)
        return WinklerState(pair, bed, pair.femoral.rays)

    def evaluate(self, state, pose, guess=None):
        """Return the contact at a pose."""
        bed, back = state.bed, inverse(pose)
        below = 0.5 * bed.thickness
        origins = transform(back, bed.points - below[:, None] * UP)
        distance, _ = state.femoral_rays.first(origins, rotate(back, UP))
        gap = distance - below
        pressure = self.modulus * np.maximum(-gap, 0.0)
        nodal_force = -(pressure * bed.area)[:, None] * bed.normals
        medial = medial_points(bed.points, pose, condyle_split(state.pair.femoral))
        condyles = summarise_condyles(
            medial, bed.points, pressure, bed.area, nodal_force, bed.thickness
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
            medial=condyles[0],
            lateral=condyles[1],
            approach=approach_at(state.pair, pose),
        )
