"""The knee drawn in a user's own MeshCat window."""

import weakref
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import meshcat.geometry as geometry
import numpy as np
import pinocchio as pin

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR, Array, mirrored_pose, transform
from tkamb.knee.pressed import contact_of_equations

if TYPE_CHECKING:
    from tkamb.contact.result import ContactResult
    from tkamb.geometry.surface import Surface
    from tkamb.knee.knee import Knee

COLOURS = {"femoral": 0xB8C4CE, "insert": 0xEFEBDD, "patella": 0xEFEBDD}
LIGAMENT, MUSCLE, ARROW = 0x2E7D32, 0xB71C1C, 0x1A1A1A


# m: radius of the force arrows. It is easy to see.
ARROW_RADIUS = 1.5e-3
# m: radius of ligaments, muscles and the patellar ligament. It is easy to see.
STRAND_RADIUS = 8e-4
# m: distance of the camera from the knee. The implant then fills the window.
LOOK_DISTANCE = 0.15
# m: height above the insert's origin at which the camera looks. The height of the joint.
LOOK_HEIGHT = 0.02
# 1: direction to the camera, insert frame of a right knee: anterior, superior, lateral.
# Both condyles and the pressure map are in view.
LOOK_DIRECTION = (0.77, 0.40, 0.50)


PRESSURE_COLOURS = np.array([[0.27, 0.0, 0.33], [0.13, 0.57, 0.55], [0.99, 0.91, 0.14]])
"""RGB from no pressure to the peak: three colours of viridis, whose lightness increases evenly."""


def show_knee(
    knee: "Knee",
    viewer: Any,
    q: Array,
    contact: "ContactResult | None" = None,
    node: str = "knee",
    newton: float = 5e-5,
    peak: float | None = None,
    opacity: float = 0.35,
    look: bool | None = None,
) -> None:
    """Draw a knee at q.

    Implant, pressure map, ligaments, lines of the extensor mechanism and an arrow for the force on
    each condyle appear below the viewer's root node. A second call with the same node replaces the
    first drawing.

    Args:
        viewer: a `pin.visualize.MeshcatVisualizer`, or a `meshcat.Visualizer`.
        contact: contact from `Knee.press` or `Knee.evaluate`; the femur is drawn at its pose. None:
            the contact at q.
        newton: length of an arrow per newton, m/N.
        peak: pressure of the last colour, Pa; None: the peak pressure.
        opacity: opacity of the femoral component, 0 to 1.
        look: whether the whole drawing moves so that the knee is upright before the camera, seen
            from anterior and lateral; None: at the first drawing in a window.

    Raises:
        InputError: the viewer is not a MeshCat viewer.
    """
    window, root = _window(viewer)
    tree = window[root][node] if root else window[node]
    tree.delete()
    first = getattr(window, "window", window) not in _SEEN
    data = knee.create_data()
    kinematics = knee._kinematics(data, q)
    insert = data.data.oMi[knee.bridge.insert.joint] * knee.bridge.insert.placement
    world = insert.homogeneous
    if look or (look is None and first):
        _look_at(window, world, knee.left)
    _SEEN.add(getattr(window, "window", window))
    if contact is None and knee.contact is not None:
        contact = knee.evaluate(q)
    contact = None if contact is None else contact_of_equations(contact, knee.left)
    femur = kinematics.pose if contact is None else contact.pose

    def in_world(points: Array) -> Array:
        return transform(world, points @ MIRROR if knee.left else points)

    to_side = mirrored_pose if knee.left else np.asarray
    femur_in_world = world @ to_side(femur)
    _solid(tree["femoral"], knee.femoral, femur_in_world, knee.left, "femoral", opacity)
    _solid(tree["insert"], knee.insert, world, knee.left, "insert", 0.6)
    poses, patella = knee._drawn_links(q, femur, data)
    if patella:
        _solid(
            tree["patella"],
            knee.button,
            world @ to_side(poses["patella"]),
            knee.left,
            "patella",
            1.0,
        )
    for bundle in knee.ligaments:
        if set(bundle.links) <= set(poses):
            path = in_world(bundle.points(poses))
            _strand(tree["ligaments"][bundle.name], path, LIGAMENT)
    for name, path in knee._extensor_paths(poses).items():
        _strand(tree["extensor"][name], in_world(path), MUSCLE)
    if contact is not None and np.isfinite(contact.pressure).all():
        _map(tree["pressure"], contact, knee.contact.state.triangles, in_world, peak)  # type: ignore[union-attr]
        for side, condyle in (("medial", contact.medial), ("lateral", contact.lateral)):
            if condyle is None:
                continue
            force = contact.nodal_force[_side(contact, knee, side)].sum(axis=0)
            start = condyle.centre_of_pressure
            path = in_world(np.array([start, start - newton * force]))
            _strand(tree["force"][side], path, ARROW, ARROW_RADIUS)


_SEEN: "weakref.WeakSet[Any]" = weakref.WeakSet()
"""Windows in which a knee was drawn."""


def _look_at(window: Any, insert: Array, is_left: bool) -> None:
    """Move all that Python draws so that the knee is upright before the camera.

    No message moves MeshCat's camera, which looks at its world's origin with z up. Its grid and
    axes, which do not move, are hidden.
    """
    turn = np.column_stack([np.eye(3)[0], np.eye(3)[2], -np.eye(3)[1]])  # insert x, y, z
    view = np.eye(4)
    view[:3, :3] = turn @ insert[:3, :3].T
    middle = insert[:3, 3] + LOOK_HEIGHT * insert[:3, 1]
    view[:3, 3] = -view[:3, :3] @ middle
    window["/meshcat"].set_transform(view)
    for node in ("/Grid", "/Axes"):
        window[node].set_property("visible", False)
    # The camera's own axes are y up: those of the insert.
    side = np.array([1.0, 1.0, -1.0 if is_left else 1.0])
    place = LOOK_DISTANCE * side * np.array(LOOK_DIRECTION)
    window["/Cameras/default/rotated/<object>"].set_property("position", place.tolist())


def _window(viewer: Any) -> tuple[Any, str]:
    inner = getattr(viewer, "viewer", viewer)
    if not hasattr(inner, "set_object"):
        raise InputError(
            f"{type(viewer).__name__} is not a MeshCat viewer",
            "Knee.show",
            "give a pin.visualize.MeshcatVisualizer after initViewer()",
        )
    return inner, getattr(viewer, "viewerRootNodeName", "") if inner is not viewer else ""


def _side(contact: "ContactResult", knee: "Knee", side: str) -> Any:
    from tkamb.contact.result import medial_points

    assert knee.contact is not None
    medial = medial_points(contact.points, contact.pose, knee.contact.pair.split)
    return medial if side == "medial" else ~medial


def _solid(
    node: Any, surface: "Surface | None", pose: Array, is_left: bool, part: str, opacity: float
) -> None:
    if surface is None:
        return
    mesh = surface.mirrored() if is_left else surface
    material = geometry.MeshPhongMaterial(
        color=COLOURS[part], opacity=opacity, transparent=opacity < 1.0
    )
    node.set_object(geometry.TriangularMeshGeometry(mesh.vertices, mesh.faces), material)
    node.set_transform(pose)


def _strand(node: Any, points: Array, colour: int, radius: float = STRAND_RADIUS) -> None:
    for k, (start, end) in enumerate(pairwise(points)):
        along = end - start
        length = float(np.linalg.norm(along))
        if length == 0.0:
            continue
        pose = np.eye(4)
        pose[:3, :3] = pin.Quaternion.FromTwoVectors(
            np.array([0.0, 1.0, 0.0]), along / length
        ).matrix()
        pose[:3, 3] = (start + end) / 2.0
        material = geometry.MeshLambertMaterial(color=colour)
        node[str(k)].set_object(geometry.Cylinder(length, radius), material)
        node[str(k)].set_transform(pose)


def _map(
    node: Any, contact: "ContactResult", triangles: Array, in_world: Any, peak: float | None
) -> None:
    loaded = triangles[(contact.pressure[triangles] > 0.0).any(axis=1)]
    if not len(loaded):
        return
    peak_pressure = float(contact.pressure.max()) if peak is None else peak
    share = np.clip(contact.pressure / peak_pressure, 0.0, 1.0)
    ramp = np.linspace(0.0, 1.0, len(PRESSURE_COLOURS))
    colours = np.stack([np.interp(share, ramp, channel) for channel in PRESSURE_COLOURS.T], axis=1)
    # Above the insert's surface, which would hide a part of the map.
    points = in_world(contact.points + 1e-4 * contact.normals)
    material = geometry.MeshBasicMaterial(vertexColors=True)  # both sides are drawn
    node.set_object(geometry.TriangularMeshGeometry(points, loaded, colours), material)
