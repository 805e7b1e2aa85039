"""The patient's URDF: ankle, six knee joints, patella, and masses and inertias by de Leva.

The foot is light and does not move: it is a point mass at the ankle centre, on the tibia link.
"""

import numpy as np

from knee_bend import anthropometry as body
from knee_bend import dimensions as d

KNEE = (
    ("knee_ap", "prismatic", "1 0 0"),
    ("knee_si", "prismatic", "0 1 0"),
    ("knee_ml", "prismatic", "0 0 1"),
    ("knee_axial_rotation", "revolute", "0 -1 0"),
    ("knee_adduction", "revolute", "-1 0 0"),
    ("knee_flexion", "revolute", "0 0 1"),
)
PATELLA = (
    ("patella_ap", "prismatic", "1 0 0"),
    ("patella_si", "prismatic", "0 1 0"),
    ("patella_rotation", "revolute", "0 0 1"),
)
PATELLA_GYRATION = 15.0
RANGES = {"prismatic": (-0.2, 0.2), "revolute": (-3.2, 3.2)}


def insert_height(si_start):
    """Return the height (mm) of the insert frame above the ankle; knee centre: femoral origin."""
    return round(body.SHANK.length - si_start, 3)


def urdf(si_start):
    """Return the URDF's text; `si_start` (mm) is the femoral origin's height when standing."""
    origin = f"0 {insert_height(si_start) * 1e-3:.6f} 0"
    lines = ['<?xml version="1.0"?>', '<robot name="deep_knee_bend">', '  <link name="ground"/>']
    lines += _link("tibia", *_tibia())
    lines += _link("femur", *_femur())
    lines += _link("patella", *_patella())
    lines.append('  <link name="hip"/>')
    ankle = f"0 {d.ANKLE_HEIGHT_SHARE * d.HEIGHT * 1e-3:.6f} 0"
    lines += _joint("ankle", "revolute", "0 0 1", "ground", "tibia", ankle)
    lines += _series(KNEE, "tibia", "femur", origin)
    lines += _series(PATELLA, "femur", "patella", "0 0 0")
    hip = f"0 {body.THIGH.length * 1e-3:.6f} 0"
    lines += [
        '  <joint name="hip_centre" type="fixed">',
        f'    <parent link="femur"/><child link="hip"/><origin xyz="{hip}"/>',
        "  </joint>",
    ]
    return "\n".join([*lines, "</robot>", ""])


def _tibia():
    """Return mass, centre (m) and principal moments of shank with foot; the origin is the ankle."""
    height = (body.SHANK.length - body.SHANK.centre) * 1e-3
    mass = body.SHANK.mass + body.FOOT_MASS
    centre = body.SHANK.mass * height / mass
    extra = body.SHANK.mass * (height - centre) ** 2 + body.FOOT_MASS * centre**2
    return mass, (0.0, centre, 0.0), _moments(body.SHANK) + np.array([extra, 0.0, extra])


def _femur():
    height = (body.THIGH.length - body.THIGH.centre) * 1e-3
    return body.THIGH.mass, (0.0, height, 0.0), _moments(body.THIGH)


def _patella():
    centre = np.array(d.PATELLA_CENTRE_OF_MASS) * 1e-3
    return d.PATELLA_MASS_KG, centre, np.full(3, d.PATELLA_MASS_KG * (PATELLA_GYRATION * 1e-3) ** 2)


def _moments(segment):
    return np.array(
        [segment.inertia_sagittal, segment.inertia_longitudinal, segment.inertia_transverse]
    )


def _link(name, mass, centre, moments):
    place = " ".join(f"{x:.6f}" for x in centre)
    ixx, iyy, izz = (f"{m:.9f}" for m in moments)
    return [
        f'  <link name="{name}">',
        "    <inertial>",
        f'      <origin xyz="{place}"/>',
        f'      <mass value="{mass:.6f}"/>',
        f'      <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>',
        "    </inertial>",
        "  </link>",
    ]


def _series(joints, first, last, origin):
    """Return the elements of consecutive joints, with massless links between them."""
    lines, parent = [], first
    for name, kind, axis in joints:
        child = last if name == joints[-1][0] else f"{name}_link"
        if child != last:
            lines.append(f'  <link name="{child}"/>')
        lines += _joint(name, kind, axis, parent, child, origin)
        parent, origin = child, "0 0 0"
    return lines


def _joint(name, kind, axis, parent, child, origin):
    lower, upper = RANGES[kind]
    return [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/>',
        f'    <axis xyz="{axis}"/>',
        f'    <limit lower="{lower}" upper="{upper}" effort="1e6" velocity="1e3"/>',
        "  </joint>",
    ]
