"""A small leg for tests: ankle, tibia, knee, femur, patella and hip, with simple numbers."""

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.geometry.frames import pose, transform
from tkamb.knee.chain import Chain, ChainMotion
from tkamb.knee.equations import Extensor, KneeGeometry
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import CondylePoint, Unknown

INERTIA = {
    "tibia": (4.2, "0.01 0.22 0.005", "0.06 0.008 0.061 0.001 0.0004 -0.0006"),
    "femur": (10.5, "0.012 0.24 -0.004", "0.2 0.04 0.21 0.002 -0.001 0.003"),
    "patella": (0.1, "0.004 0.001 0.002", "2e-5 2.5e-5 3e-5 1e-6 2e-6 -1e-6"),
}
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


def leg_urdf(inertia: dict | None = None, hip: str = "0.003 0.42 -0.01") -> str:
    """Return the URDF of a right leg, root `ground`, insert tilted 3 deg in the tibia."""
    inertia = INERTIA if inertia is None else inertia
    links = "".join(_link(name, inertia) for name in ("ground", "tibia", "femur", "patella", "hip"))
    joints = _joint("ankle", "revolute", "0 0 1", "ground", "tibia", "0.05 0.08 0.01", "0 0.1 0")
    for chain, start, end, origin in (
        (KNEE, "tibia", "femur", ("-0.005 0.39 0.002", "0 0.02 0.05")),
        (PATELLA, "femur", "patella", ("0 0 0.001", "0 0 0")),
    ):
        for number, (name, kind, axis) in enumerate(chain):
            parent = start if number == 0 else f"{chain[number - 1][0]}_link"
            child = end if number == len(chain) - 1 else f"{name}_link"
            links += "" if child == end else f'<link name="{child}"/>'
            where = origin if number == 0 else ("0 0 0", "0 0 0")
            joints += _joint(name, kind, axis, parent, child, *where)
    joints += _joint("hip_mount", "fixed", "0 0 1", "femur", "hip", hip, "0 0 0")
    return f'<robot name="leg">{links}{joints}</robot>'


def _link(name: str, inertia: dict) -> str:
    if name not in inertia:
        return f'<link name="{name}"/>'
    mass, centre, tensor = inertia[name]
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    values = " ".join(f'{k}="{v}"' for k, v in zip(keys, tensor.split(), strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}" rpy="0.1 -0.2 0.3"/>'
        f'<mass value="{mass}"/><inertia {values}/></inertial></link>'
    )


def _joint(name: str, kind: str, axis: str, parent: str, child: str, xyz: str, rpy: str) -> str:
    limit = '<limit lower="-9" upper="9" effort="1e9" velocity="1e9"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def leg(with_patella: bool = True) -> Chain:
    """Return the leg as a chain."""
    return Chain(leg_urdf(), with_patella)


def random_motion(chain: Chain, rng: np.random.Generator) -> ChainMotion:
    """Return a random motion within 140 deg of flexion, with high rates."""
    k = len(chain.joints)
    scale = np.array([0.02, 0.02, 0.005, 0.2, 0.1, 1.2, 0.03, 0.03, 0.8])[:k]
    centre = np.array([0, 0.02, 0, 0, 0, 1.2, 0.045, 0.0, -0.2])[:k]
    joints = np.stack(
        [
            centre + scale * rng.uniform(-1, 1, k),
            scale * rng.uniform(-5, 5, k),
            scale * rng.uniform(-40, 40, k),
        ]
    )
    return ChainMotion(
        pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3)),
        rng.uniform(-2, 2, 6),
        rng.uniform(-9, 9, 6),
        joints,
    )


FLEXION = np.radians(30.0)
UP = np.array([0.0, 1.0, 0.0])
HALF = 0.024
"""m: half the distance of the condyles' contact points."""


def bent_knee():
    """Return a leg without motion, at 30 deg of flexion, with all lines and no ground reaction."""
    chain = leg()
    joints = np.zeros((3, 9))
    joints[0] = [0.0, 0.03, 0.0, 0.0, 0.0, FLEXION, 0.045, 0.01, -0.3]
    state = chain.at(ChainMotion(pose(np.eye(3), np.zeros(3)), np.zeros(6), np.zeros(6), joints))
    at = {
        "origin": transform(state.pose("femur"), np.array([0.03, 0.2, 0.0])),
        "insertion": transform(state.pose("patella"), np.array([0.008, 0.02, 0.0])),
        "proximal": transform(state.pose("patella"), np.array([0.006, -0.02, 0.0])),
        "tuberosity": np.array([0.04, -0.04, 0.0]),
        "contact": transform(state.pose("patella"), np.array([-0.006, 0.0, 0.0])),
    }
    pull = line("femur", at["origin"], "patella", at["insertion"])
    extensor = Extensor(
        line("patella", at["proximal"], "tibia", at["tuberosity"]),
        at["contact"],
        state.pose("patella")[:3, 0],
        ("quadriceps",),
    )
    condyles = {
        side: CondylePoint(np.array([0.0, 0.0, z]), UP, np.array([0.02, 0.0, 0.0]), 0.0)
        for side, z in (("medial", -HALF), ("lateral", HALF))
    }
    muscle = Unknown("muscle_quadriceps", pull)
    return KneeGeometry(state, None, (), condyles, frozenset(), extensor, (muscle,))


def line(link, start, other, end):
    """Return the loads of one newton of tension between two points."""
    pull = ((end - start) / np.linalg.norm(end - start))[None]
    return PointForces(link, start[None], pull), PointForces(other, end[None], -pull)
