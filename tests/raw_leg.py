"""A leg from the raw files: poses, accelerations and known loads of its segments.

This file and `raw_files` read URDF, scene file and tables without tkamb. Poses are in the
laboratory frame (x forward, y up, z right), SI.
"""

import itertools
import tomllib
import xml.etree.ElementTree as ET
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from raw_files import (
    axes_matrix,
    fit,
    interpolated,
    pose,
    read_markers,
    read_stl,
    read_table,
    rotation,
    smoothed,
    smoothed_cycle,
    volume_centroid,
)

G = np.array([0.0, -9.80665, 0.0])
STEP = 5e-4
"""Time step of the differences for velocities and accelerations, s."""
MARGIN = 1.5
"""Length of the recording before and after the motion that is filtered with it, s."""
METRES = {"m": 1.0, "mm": 1e-3}
KNEE = ("knee_ap", "knee_si", "knee_ml", "knee_axial_rotation", "knee_adduction", "knee_flexion")
PATELLA = ("patella_ap", "patella_si", "patella_rotation")


class Leg:
    """The leg of a scene: poses, accelerations and known loads of its segments."""

    def __init__(self, scene_path, insert_mesh_in_insert=None, patella=None):
        """Read the scene's files.

        Args:
            scene_path: path of the scene file.
            insert_mesh_in_insert: pose (4, 4) from tkamb, if the motion is in the axes of the
                insert mesh.
            patella: times (f,) and coordinates (f, 3) from tkamb, if no patella was recorded.
        """
        self.folder = Path(scene_path).parent
        self.scene = tomllib.loads(Path(scene_path).read_text(encoding="utf-8"))
        root = ET.parse(self.folder / self.scene["patient"]["urdf"]).getroot()
        self.links = {link.get("name"): link for link in root.findall("link")}
        self.parent = {j.find("child").get("link"): j for j in root.findall("joint")}
        motion = self.scene["motion"]
        self.cutoff = motion["cutoff_Hz"]
        if motion["interpretation"] == "pose":
            self._read_cycle(insert_mesh_in_insert)
            self.patella = smoothed(*patella, self.cutoff)
        else:
            self._read_coordinates()

    def file(self, *keys):
        """Return the path under these keys of the scene."""
        inner = self.scene
        for key in keys:
            inner = inner[key]
        return self.folder / inner

    # motion

    def _read_coordinates(self):
        table, columns = read_table(self.file("motion", "file")), self.scene["motion"]["columns"]
        roles = ("ap", "si", "ml", "axial_rotation", "adduction", "flexion", *PATELLA)
        units = np.array([1e-3] * 3 + [np.pi / 180] * 3 + [1e-3] * 2 + [np.pi / 180])
        values = np.stack([table[columns[role]] for role in roles], axis=1) * units
        self.time = table[columns["time"]]
        curve = interpolated(self.time, values)
        self.knee, self.patella = (lambda t: curve(t)[:6]), (lambda t: curve(t)[6:])

    def _read_cycle(self, insert_mesh_in_insert):
        motion = self.scene["motion"]
        table = read_table(self.file("motion", "file"))
        places, angles = (
            np.stack([table[motion["columns"][f"{kind}_{k}"]] for k in (1, 2, 3)], axis=1)
            for kind in ("translation", "rotation")
        )
        femoral = axes_matrix(self.scene["implant"]["femoral"]["axes"])
        mesh = Rotation.from_euler(motion["sequence"], angles).as_matrix()
        turn = insert_mesh_in_insert[:3, :3]
        femur = turn @ mesh @ femoral.T
        place = places @ turn.T + insert_mesh_in_insert[:3, 3]
        knee = Rotation.from_matrix(femur).as_euler("YXZ") * [-1, -1, 1]
        start, end = motion["cycle_s"]
        self.time = start + (end - start) * table["time"] / 100
        self.knee = smoothed_cycle(self.time, np.concatenate([place, knee], axis=1), self.cutoff)

    @cached_property
    def shank(self):
        """Return time -> pose of the tibia link in the laboratory."""
        table = self.scene["tibia"]
        if table["kind"] == "sagittal":
            rows = read_table(self.file("tibia", "file"))
            lean = interpolated(rows[table["columns"]["time"]], rows[table["columns"]["angle"]])
            ankle = np.array(table["ankle_mm"]) / 1e3
            return lambda t: pose(rotation("z", -lean(t)), ankle)
        stamps, poses = self._fitted_shank()
        place = smoothed(stamps, poses[:, :3, 3], self.cutoff)
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        for one, other in itertools.pairwise(quaternions):
            other *= np.sign(one @ other)
        turn = smoothed(stamps, quaternions, self.cutoff)
        return lambda t: pose(Rotation.from_quat(turn(t)).as_matrix(), place(t))

    def _fitted_shank(self):
        table = self.scene["tibia"]
        joints = table["joint_centre"]
        names = [*table["markers_mm"], *(name for j in joints for name in j["markers_mm"])]
        path = self.file("tibia", "file")
        stamps, markers = read_markers(path, names, self.time[0] - MARGIN, self.time[-1] + MARGIN)
        axes = axes_matrix(table["laboratory_axes"])
        markers = {name: places @ axes.T / 1e3 for name, places in markers.items()}
        in_tibia = list(table["markers_mm"].values()) + [joint["tibia_mm"] for joint in joints]
        poses = []
        for k in range(len(stamps)):
            points = [markers[name][k] for name in table["markers_mm"]]
            for joint in joints:
                neighbours = joint["markers_mm"]
                segment = fit(neighbours.values(), [markers[name][k] for name in neighbours])
                centre = np.array(joint["centre_mm"]) / 1e3
                points.append(segment[:3, :3] @ centre + segment[:3, 3])
            poses.append(fit(in_tibia, points))
        return stamps, np.array(poses)

    def in_tibia(self, link, t):
        """Return the pose of a link in the tibia link at a time."""
        result = np.eye(4)
        while link != "tibia":
            joint = self.parent[link]
            result = self._origin(joint) @ self._moved(joint, t) @ result
            link = joint.find("parent").get("link")
        return result

    def in_laboratory(self, link, t):
        """Return the pose of a link in the laboratory at a time."""
        return self.shank(t) @ self.in_tibia(link, t)

    def insert_in_laboratory(self, t):
        """Return the pose of the insert frame, which is the origin of the joint knee_ap."""
        return self.shank(t) @ self._origin(self.parent["knee_ap_link"])

    @staticmethod
    def _origin(joint):
        origin = joint.find("origin")
        place = [float(x) for x in origin.get("xyz").split()]
        turn = [float(x) for x in origin.get("rpy", "0 0 0").split()]
        return pose(Rotation.from_euler("xyz", turn).as_matrix(), place)

    def _moved(self, joint, t):
        name = joint.get("name")
        if joint.get("type") == "fixed":
            return np.eye(4)
        values = self.knee(t) if name in KNEE else self.patella(t)
        value = values[(KNEE if name in KNEE else PATELLA).index(name)]
        axis = np.array([float(x) for x in joint.find("axis").get("xyz").split()])
        if joint.get("type") == "prismatic":
            return pose(np.eye(3), axis * value)
        return pose(Rotation.from_rotvec(axis * value).as_matrix(), np.zeros(3))

    def body(self, link):
        """Return the segment that a link is fixed to: tibia, femur or patella."""
        while link not in ("tibia", "femur", "patella"):
            link = self.parent[link].find("parent").get("link")
        return link

    # loads

    def needed(self, link, t):
        """Return the wrench (force, moment about the laboratory's origin) that moves a segment.

        The force is m (a - g) at the centre of mass. The moment about the centre of mass is the
        rate of angular momentum.
        """
        centre, mass, tensor = self._inertia(link)
        before, now, after = (self.in_laboratory(link, t + d) @ centre for d in (-STEP, 0.0, STEP))
        acceleration = (after[:3, 3] - 2 * now[:3, 3] + before[:3, 3]) / STEP**2
        spins = []
        for one, other in ((before, now), (now, after)):
            turn = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T)
            middle = Rotation.from_rotvec(turn.as_rotvec() / 2).as_matrix() @ one[:3, :3]
            spins.append(middle @ tensor @ middle.T @ turn.as_rotvec() / STEP)
        force = mass * (acceleration - G)
        return np.concatenate([force, np.cross(now[:3, 3], force) + (spins[1] - spins[0]) / STEP])

    def _inertia(self, link):
        """Return pose of the centre of mass in the link, mass, inertia.

        A link without inertia is the patella, a mass of 0.1 kg at the centroid of its button.
        """
        inertial = self.links[link].find("inertial")
        if inertial is None:
            table = self.scene["implant"]["patella"]
            centroid = volume_centroid(read_stl(self.file("implant", "patella", "mesh")))
            turn = axes_matrix(table.get("axes", "+x,+y,+z"))
            return pose(np.eye(3), turn @ centroid * METRES[table["unit"]]), 0.1, np.zeros((3, 3))
        entry = {key: float(value) for key, value in inertial.find("inertia").items()}
        tensor = [[entry["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"]
        mass = float(inertial.find("mass").get("value"))
        return self._origin(inertial), mass, np.array(tensor)

    @cached_property
    def ground(self):
        """Return time -> ground reaction (force, moment about the laboratory's origin)."""
        table = self.scene["ground_reaction"]
        rows, columns = read_table(self.file("ground_reaction", "file")), table["columns"]
        turn = axes_matrix(table.get("laboratory_axes", "+x,+y,+z"))
        force, point, moment = (
            np.stack([rows[columns[f"{kind}_{k}"]] for k in (1, 2, 3)], axis=1) @ turn.T
            if f"{kind}_1" in columns
            else 0.0
            for kind in ("force", "point", "moment")
        )
        point = point * METRES[table["length_unit"]]
        stamps = rows[columns.get("time", "time")]
        loaded = force[:, 1] >= table.get("unloaded_N", 20.0)
        for k in range(3):
            point[:, k] = np.interp(stamps, stamps[loaded], point[loaded, k])
        wrench = np.concatenate([force, np.cross(point, force) + moment], axis=1)
        if table["cutoff_Hz"] == "none":
            return interpolated(stamps, wrench)
        near = (stamps > self.time[0] - MARGIN) & (stamps < self.time[-1] + MARGIN)
        return smoothed(stamps[near], wrench[near], table["cutoff_Hz"])

    def ligaments(self, t, wrapped):
        """Return (tension, proximal point, distal point) of each bundle, laboratory frame.

        `wrapped` is name -> length, m, and ends of the part between the links.
        """
        links = {b[end]["link"] for b in self.scene["ligament"] for end in ("proximal", "distal")}
        poses = {link: self.in_laboratory(link, t) for link in links}
        result = []
        for bundle in self.scene["ligament"]:
            tables = (bundle["proximal"], bundle["distal"])
            ends = [carry(poses[table["link"]], table["point_mm"]) for table in tables]
            length = np.linalg.norm(ends[1] - ends[0])
            if "wrap" in bundle:
                length, *ends = wrapped[bundle["name"]]
            result.append((tension(bundle, length), *ends))
        return result

    def ends(self, line, t):
        """Return (link, point in the laboratory frame) of both ends of a muscle line."""
        tables = [
            end for end in self.scene[line].values() if isinstance(end, dict) and "link" in end
        ]
        places = [carry(self.in_laboratory(end["link"], t), end["point_mm"]) for end in tables]
        return [(end["link"], place) for end, place in zip(tables, places, strict=True)]


def carry(body, point_mm):
    """Return a point of a body in the frame of the body's pose, m."""
    return body[:3, :3] @ np.array(point_mm) / 1e3 + body[:3, 3]


def tension(bundle, length):
    """Return a bundle's tension by the law of two lines (Shin 2007) or a toe (Blankevoort 1991)."""
    slack = bundle["slack_length_mm"] / 1e3
    strain = (length - slack) / slack
    if strain <= 0:
        return 0.0
    if bundle["law"] == "two-line":
        k = bundle["stiffness_N_per_mm"] * 1e3
        return k / 2 * (length - slack) if strain < 0.06 else k * (length - 1.03 * slack)
    k = bundle["stiffness_N_per_strain"]
    return k * strain**2 / 0.12 if strain < 0.06 else k * (strain - 0.03)
