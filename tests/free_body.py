"""Free-body equilibrium of one leg (shank and foot, patella, thigh), without tkamb."""

from dataclasses import dataclass, field

import numpy as np

from raw_leg import STEP

FRICTION = 0.05
STANDSTILL = 1e-3
"""Sliding speed below which friction fades, as in tkamb, m/s."""


@dataclass
class Lent:
    """Geometry computed by tkamb, insert frame, m.

    Args:
        condyles: side -> contact point (3,) and unit normal (3,) into the femur.
        unloaded: sides that carry no load.
        slack: whether the extensor mechanism is slack.
        quadriceps: (link, point (3,), force (3,) per newton of tension) of each load of the
            quadriceps, also where it wraps.
        patellar_ligament: the same for the patellar ligament.
        patellofemoral: contact point (3,) and unit normal (3,) into the patella.
        others: further muscles from shank to thigh: start (3,) in the tibia link, end (3,) in the
            femur link, tension, N.
        reserve: reserve moment on the shank about insert z, N·m.
        wrapped: ligament that wraps -> its length, m, and the ends (3,), (3,) of its part between
            femur and tibia.
    """

    condyles: dict
    unloaded: tuple
    slack: bool
    quadriceps: list
    patellar_ligament: list
    patellofemoral: tuple
    others: list = field(default_factory=list)
    reserve: float = 0.0
    wrapped: dict = field(default_factory=dict)


class FreeBodies:
    """Free bodies of the leg at one instant: shank with foot, patella, and thigh.

    Args:
        leg: leg, a `raw_leg.Leg`.
        t: time, s.
        lent: geometry of contact and muscle line.
    """

    def __init__(self, leg, t, lent):
        self.leg, self.t, self.lent = leg, t, lent
        insert = leg.insert_in_laboratory(t)
        self.axes, self.origin = insert[:3, :3], insert[:3, 3]
        wrapped = {
            name: (length, *map(self._to, ends)) for name, (length, *ends) in lent.wrapped.items()
        }
        self.strands = leg.ligaments(t, wrapped)

    def loads(self):
        """Return the unknowns by name, N and N·m, insert axes.

        Shank with foot (6): tension of the patellar ligament, forces of both condyles, residual
        forces on the tibia along insert x and z midway between the contact points, residual moment
        about insert y. An unloaded condyle is replaced by a moment about insert x, a slack
        extensor mechanism by a moment about insert z. Patella (3, in the femur's sagittal plane):
        quadriceps, normal and tangential patellofemoral force. Thigh and patella (6): force and
        moment on the femur at the hip.
        """
        columns = self._on_shank()
        known = self.leg.ground(self.t) + self._ligaments(1) + self._others()
        right = self.leg.needed("tibia", self.t) - known
        values = dict(
            zip(columns, np.linalg.solve(np.stack([*columns.values()], 1), right), strict=True)
        )
        shank = sum(value * columns[name] for name, value in values.items())
        patellar = values.get("patellar_ligament", 0.0)
        if not self.lent.slack:
            values.update(self._patella(patellar))
        on_thigh = (
            self._ligaments(0)
            - self._others()
            - shank
            + patellar
            * (
                self._line(self.lent.patellar_ligament, "tibia")
                + self._line(self.lent.patellar_ligament, "patella")
            )
        )
        needed = self.leg.needed("femur", self.t) + self.leg.needed("patella", self.t)
        hip = needed - on_thigh
        centre = self.leg.in_laboratory("hip", self.t)[:3, 3]
        values["hip_force"] = hip[:3] @ self.axes
        values["hip_moment"] = (hip[3:] - np.cross(centre, hip[:3])) @ self.axes
        return values

    def _on_shank(self):
        """Return name of an unknown -> its wrench (6,) on the shank per N or N·m."""
        lent, columns = self.lent, {}
        for side, (point, normal) in lent.condyles.items():
            if side not in lent.unloaded:
                push = self._out(normal) - FRICTION * self._slip(point, normal)
                columns[f"{side}_normal"] = -wrench(self._to(point), push)
        middle = self._to(np.mean([point for point, _ in lent.condyles.values()], axis=0))
        x, y, z = self.axes.T
        columns["residual_ap"], columns["residual_ml"] = wrench(middle, x), wrench(middle, z)
        columns["residual_axial"] = np.append(np.zeros(3), y)
        if lent.unloaded:
            columns["residual_coronal"] = np.append(np.zeros(3), x)
        if lent.slack:
            columns["residual_flexion"] = np.append(np.zeros(3), z)
        else:
            columns["patellar_ligament"] = self._line(lent.patellar_ligament, "tibia")
        return columns

    def _patella(self, patellar):
        """Return quadriceps and patellofemoral force by the patella's sagittal equilibrium."""
        lent, femur = self.lent, self.leg.in_laboratory("femur", self.t)
        point, normal = lent.patellofemoral
        across = np.cross(femur[:3, 2] @ self.axes, normal)
        columns = [
            self._line(lent.quadriceps, "patella"),
            wrench(self._to(point), self._out(normal)),
            wrench(self._to(point), self._out(across)),
        ]
        right = self.leg.needed("patella", self.t)
        right = right - patellar * self._line(lent.patellar_ligament, "patella")
        # moments about the patella, because moments about the laboratory's origin are large
        centre = self.leg.in_laboratory("patella", self.t)[:3, 3]
        rows = np.array([self._sagittal(w, femur, centre) for w in (*columns, right)])
        names = ("muscle_quadriceps", "patellofemoral", "patellofemoral_tangential")
        return dict(zip(names, np.linalg.solve(rows[:3].T, rows[3]), strict=True))

    @staticmethod
    def _sagittal(w, femur, centre):
        """Return the forces along the femur's x and y, and the moment about its z (3,)."""
        moment = w[3:] - np.cross(centre, w[:3])
        return np.array([w[:3] @ femur[:3, 0], w[:3] @ femur[:3, 1], moment @ femur[:3, 2]])

    def _slip(self, point, normal):
        """Return the femur's sliding direction at a point; its length fades below `STANDSTILL`."""
        femur, tibia = (
            [self.leg.in_laboratory(link, self.t + d) for d in (-STEP, 0.0, STEP)]
            for link in ("femur", "tibia")
        )
        contact = self._to(point)
        velocity = point_velocity(femur, contact) - point_velocity(tibia, contact)
        normal = self._out(normal)
        velocity = velocity - velocity @ normal * normal
        return velocity / np.hypot(np.linalg.norm(velocity), STANDSTILL)

    def _ligaments(self, end):
        """Return the bundles' wrench on the femur (end 0) or the tibia (end 1)."""
        total = np.zeros(6)
        for force, *ends in self.strands:
            pull = ends[1 - end] - ends[end]
            total += wrench(ends[end], force * pull / np.linalg.norm(pull))
        return total

    def _others(self):
        """Return the wrench of the further muscles and the reserve on the shank."""
        total = np.append(np.zeros(3), self.lent.reserve * self.axes[:, 2])
        for start, end, force in self.lent.others:
            start, end = (
                (self.leg.in_laboratory(link, self.t) @ np.append(point, 1.0))[:3]
                for link, point in (("tibia", start), ("femur", end))
            )
            total += wrench(start, force * (end - start) / np.linalg.norm(end - start))
        return total

    def _line(self, loads, body):
        """Return the wrench of a unit tension on a segment."""
        parts = [
            wrench(self._to(point), self._out(force))
            for link, point, force in loads
            if self.leg.body(link) == body
        ]
        return sum(parts, np.zeros(6))

    def _to(self, point):
        return self.axes @ point + self.origin

    def _out(self, vector):
        return self.axes @ vector


def wrench(point, force):
    """Return force and moment about the laboratory's origin (6,) of a force at a point."""
    return np.concatenate([force, np.cross(point, force)])


def point_velocity(poses, point):
    """Return the velocity (3,) of a body's point, by central difference of its poses."""
    before, now, after = poses
    in_body = now[:3, :3].T @ (point - now[:3, 3])
    places = [pose[:3, :3] @ in_body + pose[:3, 3] for pose in (before, after)]
    return (places[1] - places[0]) / (2 * STEP)
