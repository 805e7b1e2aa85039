"""Knees whose patella has six degrees of freedom, made of the shipped knee."""

from dataclasses import replace

import numpy as np

import tkamb
from released_patella import SLACK
from scenes import MODEL
from tkamb.geometry.frames import PATELLA_BODY_COORDINATES
from tkamb.geometry.surface import Surface

CHOICE = {"contact.model": "foundation", "contact.patellofemoral.model": "foundation"}
Z = np.array([0.0, 0.0, 1.0])
HEADS = {"quadriceps": 500.0, "vastus_medialis": 250.0, "vastus_lateralis": 300.0}


def read_plane():
    """Return knee, motion and ground reaction of the shipped scene."""
    return tkamb.read_scene(tkamb.load_scene(MODEL / "scene.toml", CHOICE))


def body_knee(
    plain,
    model="foundation",
    femoral=None,
    button=None,
    resolution=1e-3,
    even=False,
    released=False,
    **more,
):
    """Return a knee with three heads, two strands and two retinacula.

    Args:
        plain: the shipped knee.
        model: contact model of the button.
        femoral, button: other surfaces; None: those of `plain`.
        resolution: m.
        even: whether the lines are symmetric about the sagittal plane.
        released: whether the forces of the patella act in all results.
        more: other arguments of `tkamb.Knee`.
    """
    if released:
        size = sum(HEADS.values())
        more |= {
            "released_patella": PATELLA_BODY_COORDINATES,
            "head_shares": {name: tension / size for name, tension in HEADS.items()},
        }
    muscle, line = plain.extensor.quadriceps, plain.extensor.patellar_ligament
    origin, insertion = (np.array(point.position) for point in muscle.points)
    proximal, distal = np.array(line.proximal.position), np.array(line.distal.position)
    lateral = 0.020 if even else 0.030
    tuberosity = distal * [1.0, 1.0, 0.0] if even else distal

    def head(name, side, across):
        ends = (origin + side * across * Z, insertion + side * 0.012 * Z)
        return tkamb.Muscle(name, (("femur", tuple(ends[0])), ("patella", tuple(ends[1]))))

    def strand(name, side):
        ends = proximal + side * 0.008 * Z, tuberosity + side * 0.005 * Z
        return tkamb.Ligament(
            name,
            tkamb.LinkPoint("patella", ends[0]),
            tkamb.LinkPoint(line.distal.link, ends[1]),
            tkamb.TwoLine(stiffness=4e5),
            slack_length=0.050,
        )

    def retinaculum(name, side):
        return tkamb.Ligament(
            name,
            tkamb.LinkPoint("femur", np.array([0.0, 0.0, side * 0.042])),
            tkamb.LinkPoint("patella", np.array([0.002, 0.0, side * 0.018])),
            tkamb.TwoLine(stiffness=2e4),
            slack_length=1e-3 * SLACK,
        )

    return tkamb.Knee(
        plain.model,
        implant=tkamb.Implant(
            femoral or plain.femoral, plain.insert, button or plain.button, placed=True
        ),
        extensor=replace(plain.extensor),
        ligaments=[
            strand("strand_medial", -1.0),
            strand("strand_lateral", 1.0),
            retinaculum("retinaculum_medial", -1.0),
            retinaculum("retinaculum_lateral", 1.0),
        ],
        muscles=[head("vastus_medialis", -1.0, 0.020), head("vastus_lateralis", 1.0, lateral)],
        patellofemoral_contact=tkamb.contact_model(model, resolution=resolution),
        **more,
    )


def symmetric(surface):
    """Return the right half (z >= 0) of a surface, joined with its mirror image."""
    right = surface.faces[(surface.triangles[:, :, 2] > -1e-9).all(axis=1)]
    used, faces = np.unique(right, return_inverse=True)
    faces, vertices = faces.reshape(-1, 3), surface.vertices[used].copy()
    seam = np.abs(vertices[:, 2]) < 1e-9
    vertices[seam, 2] = 0.0
    number = np.arange(len(vertices)) + len(vertices)
    number[seam] = np.flatnonzero(seam)
    both = np.concatenate([vertices, vertices * [1.0, 1.0, -1.0]])
    joined = np.concatenate([faces, number[faces][:, ::-1]])
    kept, joined = np.unique(joined, return_inverse=True)
    return Surface(both[kept], joined.reshape(-1, 3).astype(np.int64), surface.name)
