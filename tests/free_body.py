"""Free bodies of a leg, written from the raw files alone: numpy and scipy, nothing of tkamb.

Read here: URDF, scene file, tables, markers and meshes. Computed here: where each segment is
and how it accelerates, its weight and inertia, ground reaction, ligament tensions. Balanced
here: shank and foot (six equations), patella (three), thigh with patella at the hip (six).
What the product lends is stated by `Lent`: geometry of contact and of the muscle line.
Everything in `Loads` is N and N·m; points of `Lent` are in the insert frame.
"""

import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

G = np.array([0.0, -9.80665, 0.0])
STEP = 5e-4
"""s; of the differences that give velocities and accelerations."""
KNEE = ("knee_ap", "knee_si", "knee_ml", "knee_axial_rotation", "knee_adduction", "knee_flexion")
PATELLA = ("patella_ap", "patella_si", "patella_rotation")


@dataclass
class Lent:
    """Geometry taken from the product, insert frame: no load, no mass, no rate.

    Args:
        condyles: side -> (point (3,), unit normal (3,) into the femur) of those that carry.
        unloaded: sides that do not carry.
        slack: the extensor mechanism does not carry.
        quadriceps: (link, point (3,), force (3,) per newton of tension), wraps included.
        patellar_ligament: likewise.
        patellofemoral: (point (3,), unit normal (3,) into the patella).
    """

    condyles: dict
    unloaded: tuple
    slack: bool
    quadriceps: list
    patellar_ligament: list
    patellofemoral: tuple


# Reading


def read_table(path):
    """Return the columns of a .csv or .sto file."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    if Path(path).suffix == ".sto":
        lines = lines[[line.strip() for line in lines].index("endheader") + 1 :]
    names = lines[0].replace(",", " ").split()
    rows = [line.replace(",", " ").split() for line in lines[1:] if line.strip()]
    return dict(zip(names, np.array(rows, float).T, strict=True))


def read_markers(path, names, start, end):
    """Return times (n,) and marker -> (n, 3), in the file's unit, between two times."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    labels = [label for label in lines[3].split("\t")[2:] if label.strip()]
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    rows = [row for row in rows if start <= float(row[1]) <= end]
    column = {name: 2 + 3 * labels.index(name) for name in names}
    places = {n: np.array([row[c : c + 3] for row in rows], float) for n, c in column.items()}
    return np.array([row[1] for row in rows], float), places


def read_stl(path):
    """Return the corners (k, 3, 3) of a binary STL."""
    data = Path(path).read_bytes()[84:]
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    return np.frombuffer(data, kind)["corners"].astype(float)


def volume_centroid(corners):
    """Return the centroid of a closed mesh."""
    volumes = np.linalg.det(corners)
    return volumes @ corners.mean(axis=1) * 0.75 / volumes.sum()


def pose(rotation, position):
    """Return the 4x4 pose."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, position
    return result


def axes_matrix(text):
    """Return R with v_here = R v_file of "-x,+y,-z"."""
    rows = [np.eye(3)["xyz".index(axis[1])] * (-1 if axis[0] == "-" else 1) for axis in text]
    return np.array(rows)


# Curves


def interpolated(time, values):
    """Return the quintic spline through the samples."""
    return make_interp_spline(time, values, 5)


def smoothed(time, values, cutoff):
    """Return s that minimises sum w (x - s)^2 + (2 pi cutoff)^-6 int s'''^2 dt."""
    values = np.asarray(values, float)
    spans = int(np.ceil((time[-1] - time[0]) * cutoff * 4))
    step = (time[-1] - time[0]) / spans
    knots = time[0] + step * np.arange(-5, spans + 6)
    design = BSpline.design_matrix(np.clip(time, knots[5], knots[-6]), knots, 5).toarray()
    nodes, weights = np.polynomial.legendre.leggauss(3)
    at = (knots[5:-6, None] + step * (nodes + 1) / 2).ravel()
    third = BSpline(knots, np.eye(spans + 5), 5).derivative(3)(at)
    bend = third.T @ (np.tile(weights * step / 2, spans)[:, None] * third)
    scaled = np.gradient(time)[:, None] * design
    normal = design.T @ scaled + (2 * np.pi * cutoff) ** -6.0 * bend
    return BSpline(knots, np.linalg.solve(normal, scaled.T @ values), 5)


def smoothed_cycle(time, values, cutoff):
    """Return the smoothing spline of one closed cycle: the middle one of three."""
    once = np.array(values, float)
    once[0] = once[-1] = 0.5 * (once[0] + once[-1])
    period = time[-1] - time[0]
    times = np.concatenate([time[:-1] - period, time[:-1], time + period])
    return smoothed(times, np.concatenate([once[:-1], once[:-1], once]), cutoff)


# The leg


class Leg:
    """A scene's leg: poses and accelerations of its segments, loads that are known."""

    def __init__(self, scene_path):
        self.folder = Path(scene_path).parent
        self.scene = tomllib.loads(Path(scene_path).read_text(encoding="utf-8"))
        root = ET.parse(self.folder / self.scene["patient"]["urdf"]).getroot()
        self.links = {link.get("name"): link for link in root.findall("link")}
        self.parent = {j.find("child").get("link"): j for j in root.findall("joint")}
        motion = self.scene["motion"]
        self.cutoff = motion["cutoff_Hz"]
        self.patella = None
        if motion["interpretation"] == "pose":
            self._read_cycle()
        else:
            self._read_coordinates()

    def file(self, *keys):
        """Return the path that the scene names."""
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

    def _read_cycle(self):
        motion = self.scene["motion"]
        table = read_table(self.file("motion", "file"))
        column = lambda kind: np.stack(  # noqa: E731
            [table[motion["columns"][f"{kind}_{k}"]] for k in (1, 2, 3)], axis=1
        )
        turns = Rotation.from_euler(motion["sequence"], column("rotation")).as_matrix()
        insert, femoral = self.scene["implant"]["insert"], self.scene["implant"]["femoral"]
        turn = axes_matrix(insert["axes"].split(","))
        corners = read_stl(self.file("implant", "insert", "mesh")).reshape(-1, 3) @ turn.T
        flat = corners[corners[:, 1] < corners[:, 1].min() + 1e-6]
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
        out = axes_matrix(femoral["axes"].split(","))
        rotation = turn @ turns @ out.T
        place = column("translation") @ turn.T - middle
        angles = Rotation.from_matrix(rotation).as_euler("YXZ") * [-1, -1, 1]
        start, end = motion["cycle_s"]
        self.time = np.linspace(start, end, motion["frames"])
        curve = smoothed_cycle(self.time, np.concatenate([place, angles], axis=1), self.cutoff)
        self.knee = lambda t: curve(t)

    @cached_property
    def shank(self):
        """Return time -> pose of the tibia link in the laboratory."""
        table = self.scene["tibia"]
        if table["kind"] == "sagittal":
            rows = read_table(self.file("tibia", "file"))
            lean = interpolated(rows[table["columns"]["time"]], rows[table["columns"]["angle"]])
            ankle = np.array(table["ankle_mm"]) / 1e3
            return lambda t: pose(Rotation.from_euler("z", -lean(t), degrees=True).as_matrix(), ankle)
        stamps, poses = self._fitted_shank()
        place = smoothed(stamps, poses[:, :3, 3], self.cutoff)
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        for one, other in zip(quaternions, quaternions[1:], strict=False):
            other *= np.sign(one @ other)
        turn = smoothed(stamps, quaternions, self.cutoff)
        return lambda t: pose(Rotation.from_quat(turn(t)).as_matrix(), place(t))

    def _fitted_shank(self):
        table = self.scene["tibia"]
        joints = table["joint_centre"]
        names = [*table["markers_mm"], *(name for j in joints for name in j["markers_mm"])]
        path = self.file("tibia", "file")
        stamps, seen = read_markers(path, names, self.time[0] - 1.5, self.time[-1] + 1.5)
        here = axes_matrix(table["laboratory_axes"].split(","))
        seen = {name: places @ here.T / 1e3 for name, places in seen.items()}
        own = list(table["markers_mm"].values()) + [joint["tibia_mm"] for joint in joints]
        poses = []
        for k in range(len(stamps)):
            points = [seen[name][k] for name in table["markers_mm"]]
            for joint in joints:
                carried = fit(joint["markers_mm"].values(), [seen[n][k] for n in joint["markers_mm"]])
                centre = np.array(joint["centre_mm"]) / 1e3
                points.append(carried[:3, :3] @ centre + carried[:3, 3])
            poses.append(fit(own, points))
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
        """Return the pose of the insert frame: the origin of the knee's first joint."""
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

        It is m (a - g) at the centre of mass and the rate of angular momentum about it.
        """
        inertial = self.links[link].find("inertial")
        if inertial is None:  # a patella: 0.1 kg, a point at its button's centroid
            table = self.scene["implant"]["patella"]
            scale = {"m": 1.0, "mm": 1e-3}[table["unit"]]
            turn = axes_matrix(table.get("axes", "+x,+y,+z").split(","))
            own = pose(np.eye(3), turn @ volume_centroid(read_stl(self.file("implant", "patella", "mesh"))) * scale)
            mass, tensor = 0.1, np.zeros((3, 3))
        else:
            own = self._origin(inertial)
            mass = float(inertial.find("mass").get("value"))
            entry = {key: float(value) for key, value in inertial.find("inertia").items()}
            tensor = np.array(
                [[entry["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"]
            )
        before, here, after = (self.in_laboratory(link, t + d) @ own for d in (-STEP, 0.0, STEP))
        acceleration = (after[:3, 3] - 2 * here[:3, 3] + before[:3, 3]) / STEP**2
        spins = []
        for one, other in ((before, here), (here, after)):
            turn = Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T)
            middle = Rotation.from_rotvec(turn.as_rotvec() / 2).as_matrix() @ one[:3, :3]
            spins.append(middle @ tensor @ middle.T @ turn.as_rotvec() / STEP)
        force = mass * (acceleration - G)
        return np.concatenate([force, np.cross(here[:3, 3], force) + (spins[1] - spins[0]) / STEP])

    @cached_property
    def ground(self):
        """Return time -> ground reaction (force, moment about the laboratory's origin)."""
        table = self.scene["ground_reaction"]
        rows, columns = read_table(self.file("ground_reaction", "file")), table["columns"]
        turn = axes_matrix(table.get("laboratory_axes", "+x,+y,+z").split(","))
        triple = lambda kind: np.stack(  # noqa: E731
            [rows[columns[f"{kind}_{k}"]] for k in (1, 2, 3)], axis=1
        )
        force = triple("force") @ turn.T
        point = triple("point") @ turn.T * {"m": 1.0, "mm": 1e-3}[table["length_unit"]]
        moment = triple("moment") @ turn.T if "moment_1" in columns else np.zeros_like(force)
        stamps = rows[columns["time"]]
        loaded = force[:, 1] >= table.get("unloaded_N", 20.0)
        for k in range(3):
            point[:, k] = np.interp(stamps, stamps[loaded], point[loaded, k])
        wrench = np.concatenate([force, np.cross(point, force) + moment], axis=1)
        if table["cutoff_Hz"] == "none":
            return interpolated(stamps, wrench)
        near = (stamps > self.time[0] - 1.5) & (stamps < self.time[-1] + 1.5)
        return smoothed(stamps[near], wrench[near], table["cutoff_Hz"])

    def ligaments(self, t):
        """Return (tension, proximal point, distal point) of each bundle, laboratory."""
        result = []
        for bundle in self.scene["ligament"]:
            ends = []
            for end in ("proximal", "distal"):
                place = self.in_laboratory(bundle[end]["link"], t)
                ends.append(place[:3, :3] @ np.array(bundle[end]["point_mm"]) / 1e3 + place[:3, 3])
            length = np.linalg.norm(ends[1] - ends[0])
            result.append((tension(bundle, length), *ends))
        return result


def fit(own_mm, seen):
    """Return the pose that carries points (m, 3) mm nearest to those seen (m, 3) m."""
    own, seen = np.array(list(own_mm)) / 1e3, np.array(seen)
    turn, _ = Rotation.align_vectors(seen - seen.mean(axis=0), own - own.mean(axis=0))
    return pose(turn.as_matrix(), seen.mean(axis=0) - turn.apply(own.mean(axis=0)))


def tension(bundle, length):
    """Return a bundle's tension: two lines (Shin 2007), or a quadratic toe (Blankevoort 1991)."""
    slack = bundle["slack_length_mm"] / 1e3
    strain = (length - slack) / slack
    if strain <= 0:
        return 0.0
    if bundle["law"] == "two-line":
        k = bundle["stiffness_N_per_mm"] * 1e3
        return k / 2 * (length - slack) if strain < 0.06 else k * (length - 1.03 * slack)
    k = bundle["stiffness_N_per_strain"]
    return k * strain**2 / 0.12 if strain < 0.06 else k * (strain - 0.03)
