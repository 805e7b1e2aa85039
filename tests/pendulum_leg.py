"""A leg of four bodies as an OpenSim model, its motion, and the arguments of an import."""

from pathlib import Path

import numpy as np

from tkamb.io.importing.model_fit import ModelChain
from tkamb.io.opensim.read import read_osim
from tkamb.show.storage import write_trc


def pendulum_osim(path: Path, changes: dict[str, str] | None = None) -> Path:
    """Write a model of a free pelvis, femur, tibia and foot, with markers. Return its path."""
    joints = [
        ("FreeJoint", "root", "/ground", "/bodyset/pelvis", "0 0 0", 6),
        ("BallJoint", "hip_r", "/bodyset/pelvis", "/bodyset/femur_r", "-0.04 -0.1 0.08", 3),
        ("PinJoint", "knee_r", "/bodyset/femur_r", "/bodyset/tibia_r", "0 -0.4 0", 1),
        ("PinJoint", "ankle_r", "/bodyset/tibia_r", "/bodyset/foot_r", "0 -0.42 0", 1),
    ]
    masses = {"pelvis": 40.0, "femur_r": 9.0, "tibia_r": 3.5, "foot_r": 1.0}
    bodies = "".join(
        f'<Body name="{n}"><mass>{m}</mass><mass_center>0 -0.1 0</mass_center>'
        "<inertia>0.1 0.05 0.1 0 0 0</inertia></Body>"
        for n, m in masses.items()
    )
    sets = "".join(_joint(*joint) for joint in joints)
    rng = np.random.default_rng(5)
    markers = ""
    for body, count in (("pelvis", 4), ("femur_r", 3), ("tibia_r", 3), ("foot_r", 4)):
        for k in range(count):
            place = " ".join(f"{v:.4f}" for v in rng.normal(0, 0.06, 3) - [0, 0.1, 0])
            markers += (
                f'<Marker name="M.{body}.{k}"><socket_parent_frame>/bodyset/{body}'
                f"</socket_parent_frame><location>{place}</location></Marker>"
            )
    text = (
        '<?xml version="1.0"?><OpenSimDocument Version="40000"><Model name="leg">'
        f'<gravity>0 -9.80665 0</gravity><BodySet name="b"><objects>{bodies}</objects></BodySet>'
        f'<JointSet name="j"><objects>{sets}</objects></JointSet>'
        f'<MarkerSet name="m"><objects>{markers}</objects></MarkerSet></Model></OpenSimDocument>'
    )
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def _joint(kind: str, name: str, parent: str, child: str, place: str, count: int) -> str:
    coordinates = "".join(
        f'<Coordinate name="{name}_{k}"><default_value>0</default_value>'
        "<range>-3 3</range><clamped>false</clamped><locked>false</locked></Coordinate>"
        for k in range(count)
    )
    frames = "".join(
        f'<PhysicalOffsetFrame name="{name}_{end}"><socket_parent>{body}</socket_parent>'
        f"<translation>{at}</translation><orientation>0 0 0</orientation></PhysicalOffsetFrame>"
        for end, body, at in (("p", parent, place), ("c", child, "0 0 0"))
    )
    return (
        f'<{kind} name="{name}"><socket_parent_frame>{name}_p</socket_parent_frame>'
        f"<socket_child_frame>{name}_c</socket_child_frame>"
        f"<coordinates>{coordinates}</coordinates><frames>{frames}</frames></{kind}>"
    )


def moving_leg(osim: Path, frames: int = 60) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return coordinates (n, 11) of a knee bend, and marker label -> positions (n, 3) m."""
    model = read_osim(osim)
    chain = ModelChain(model, list(model.markers))
    q = chain.default(frames)
    names = list(model.coordinates)
    q[:, names.index("knee_r_0")] = -np.linspace(0.1, 1.2, frames)
    q[:, names.index("hip_r_2")] = np.linspace(0.0, 0.5, frames)
    q[:, names.index("ankle_r_0")] = 0.2
    q[:, names.index("root_4")] = 0.95
    places = chain.places(q)
    return q, dict(zip(model.markers, np.moveaxis(places, 1, 0), strict=True))


def recorded_leg(tmp_path: Path, **changes) -> list[str]:
    """Write model and recording, and return the arguments of an import without implant."""
    osim = pendulum_osim(tmp_path / "leg.osim", changes.pop("osim", None))
    _, markers = moving_leg(pendulum_osim(tmp_path / "plain.osim"))
    rename = changes.pop("rename", lambda name: "S:" + name.replace(".", ""))
    write_trc(
        tmp_path / "leg.trc",
        np.arange(60) / 60.0,
        {rename(name): path * changes.get("stretch", 1.0) for name, path in markers.items()},
        60.0,
    )
    arguments = {
        "--trc": tmp_path / "leg.trc",
        "--side": "right",
        "--mass-kg": "53.5",
        "--out": tmp_path / "out",
    }
    return ["import", str(osim), *(str(v) for pair in arguments.items() for v in pair)]


def changed(arguments: list[str], **options: str | None) -> list[str]:
    """Return the arguments with options replaced or added. Options with value None are removed."""
    result = list(arguments)
    for name, value in options.items():
        option = "--" + name.replace("_", "-")
        if option in result:
            at = result.index(option)
            del result[at : at + 2]
        if value is not None:
            result += [f"{option}={value}"]
    return result
