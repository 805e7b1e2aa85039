"""Small wear cases: bodies, motions, and prescribed contacts without a contact model."""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import shapes
from scenes import write_scene
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import inverse, pose, transform
from tkamb.geometry.surface import Surface
from tkamb.studies.wear.engine import ArticularSurface, ContactEngine, CycleMaps
from tkamb.studies.wear.laws import Archard
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.simulation import WearCase

MM = 1e-3
DENSITY = 930.0


def balls():
    return shapes.joined(*(shapes.sphere(0.022, 3, (0, 0, z)) for z in (-0.022, 0.022)))


def balls_scene(folder):
    """Return the path of the shipped scene with two coarse spheres on two dishes."""
    path = write_scene(
        folder,
        drop=("patella", "quadriceps", "patellar_ligament"),
        implant__femoral__mesh="balls.stl",
        implant__insert__mesh="dishes.stl",
    )
    for name, body in (("balls.stl", balls()), ("dishes.stl", shapes.two_dishes())):
        trimesh.Trimesh(body.vertices * 1e3, body.faces).export(folder / name)
    return path


def stroke(length, frames, load, passes=2):
    """Return a translation along x by `length`, m; with two passes there and back."""
    positions = np.zeros((frames, 3))
    positions[:, 0] = np.linspace(-length / 2, length / 2, frames)
    rotation = np.broadcast_to(np.eye(3), (frames, 3, 3))
    return CycleMotion(pose(rotation, positions), np.full(frames, load), 1.0, passes)


def swing(angle, frames, load):
    """Return a rotation by `angle`, rad, about z through the femoral origin, there and back."""
    rotation_vectors = np.outer(np.linspace(-angle / 2, angle / 2, frames), [0.0, 0.0, 1.0])
    rotation = Rotation.from_rotvec(rotation_vectors).as_matrix()
    return CycleMotion(pose(rotation, np.zeros((frames, 3))), np.full(frames, load), 1.0, 2)


@dataclass
class Pressed:
    """A prescribed contact: uniform pressure on the points for which `under` is true.

    Args:
        under: function of points (n, 3) in the femoral frame that returns whether each is pressed.
        fails_below: height of the lowest upper point below which contact is lost, m.
    """

    under: object
    fails_below: float = -1.0

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        points = insert.vertices[insert.vertices[:, 1] > insert.bounds[1, 1] / 2]
        if points[:, 1].min() < self.fails_below:
            return CycleMaps(points, None, None, motion.poses, {0: "no contact is left"})
        inside = [self.under(transform(inverse(pose), points)) for pose in motion.poses]
        pressure = np.array(inside, float) * 1e6
        return CycleMaps(points, np.zeros((0, 3), np.int64), pressure, motion.poses, {})


def always(points):
    return np.ones(len(points), bool)


def plate_case(motion, law, under=always, creep=None, thickness=0.01, **more):
    articular = ArticularSurface.of_insert(shapes.plate(thickness), 2 * MM)
    return WearCase(Pressed(under, **more), articular, motion, law, DENSITY, creep)


def ball_case(insert, radius, motion, wear_factor, resolution=1.0, facets=3):
    return swinging_case(shapes.sphere(radius, facets), insert, motion, wear_factor, resolution)


def swinging_case(femoral, insert, motion, wear_factor=1e-6, resolution=2.0):
    model = contact_model("foundation", resolution=resolution * 1e-3)
    engine = ContactEngine(model, femoral, material("polyethylene"))
    articular = ArticularSurface.of_insert(insert, resolution * MM)
    return WearCase(engine, articular, motion, Archard(wear_factor), DENSITY)
