"""The window of `tkamb live`: its page, its server and the messages between them."""

import json
import math
import os
import shutil
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.errors import InputError, TkambError, must_be, real_numbers
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    SIDES,
    Array,
    knee_coordinates,
    knee_pose,
)
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.knee import Knee
from tkamb.run.known_errors import NOT_MEASURED
from tkamb.show.pages import asset, policy_sources, render
from tkamb.show.style import SIDE_COLOURS
from tkamb.show.view.bench import BenchRequest, still_motion
from tkamb.show.view.bench_patella import BenchPatella
from tkamb.show.view.bench_scene import write_knee
from tkamb.show.view.drawing import (
    INSERT,
    METAL,
    RECORDED,
    SLACK,
    Drawing,
    Marker,
    PressureMap,
    Solid,
    Strand,
    rgb,
    strain_colours,
)
from tkamb.show.view.live import LiveAnswer, LiveKnee, setting
from tkamb.show.view.page import PACKAGE, POLICY, meshcat_script
from tkamb.show.view.payload import pack, packed_map
from tkamb.show.view.server import NotYet, ViewServer
from tkamb.show.view.show import serve_in_background
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

SCRIPTS = ("scene.js", "moving.js", "controls.js", "live.js")
DEFAULT_FOLDER = Path("out") / "live"
COARSE = ("foundation", 2.0)
"""Contact model and spacing (mm) that are used while a slider moves."""
PATELLA_NODES = ("patella/patellar button", "patella/patella")
"""Nodes of the page that have the pose of the patella."""
STRAIN_LIMIT = 0.1
"""1: upper end of the colour scale of ligament strains."""
SCALES_MPA = (5.0, 10.0, 20.0, 30.0, 50.0, 80.0, 120.0, 200.0, 500.0, 1000.0)
"""MPa: possible upper ends of the pressure scale. The smallest one above the peak is used."""


class LiveWindow:
    """A knee on the bench, its page and the folder for saved scenes.

    Args:
        folder: folder for saved scenes, which are called kept-1, kept-2 and so on.
        frame: recorded frame at which the window opens.
    """

    def __init__(self, knee: LiveKnee, folder: Path, frame: int = 0) -> None:
        self.knee, self.folder, self.frame = knee, folder, frame
        self.start = knee.recorded(frame)
        self.title = f"{knee.case.scene.patient.side.capitalize()} knee, live"

    def set_resolution(self, resolution_mm: float) -> None:
        """Set the spacing of the map at the beginning; the default is the scene's."""
        self.start = replace(self.start, resolution_mm=resolution_mm)

    def server(self, port: int = 0) -> ViewServer:
        """Return the server of the window, not yet started."""
        return ViewServer(self.page(), pack([self._drawing()]), None, port, self.question)

    def question(self, name: str, content: dict[str, Any]) -> bytes:
        """Return the answer to one message of the page.

        Args:
            name: "live" computes a state. "save" computes it without an initial guess and writes
                it as a scene.

        Raises:
            TkambError: the name is unknown, the state is impossible, or a newer request arrived.
        """
        if name == "live":
            request, number = BenchRequest.read(content), self.knee.overtake()
            coarse = (request.contact, request.resolution_mm) == COARSE
            if not coarse and (words := self.knee.preparing(request)):
                raise NotYet(words)
            return self._packed(self.knee.answer(request, number))
        if name == "save":
            return self._keep(BenchRequest.read(content))
        raise TkambError("no such request")

    def page(self) -> str:
        """Return the page. It works only with the server."""
        scripts = [
            "\n" + text.replace("</script", "<\\/script")
            for text in (meshcat_script(), *(asset(PACKAGE, name) for name in SCRIPTS))
        ]
        return render(
            PACKAGE,
            "live.html",
            title=self.title,
            policy=POLICY.format(scripts=policy_sources(*scripts), connect="'self'"),
            style=asset(PACKAGE, "style.css") + asset(PACKAGE, "live.css"),
            request=self._request(),
            scripts=scripts,
        )

    def _request(self) -> dict[str, Any]:
        motion = self.knee.case.motion
        columns = {
            "flexion_deg": ("flexion", DEGREE),
            "adduction_deg": ("adduction", DEGREE),
            "axial_rotation_deg": ("axial_rotation", DEGREE),
            "ap_mm": ("ap", MILLIMETRE),
            "ml_mm": ("ml", MILLIMETRE),
        }
        places = {
            key: motion.coordinates[:, KNEE_COORDINATES.index(name)] / unit
            for key, (name, unit) in columns.items()
        }
        frames = range(len(motion.time))
        poses = knee_pose(motion.coordinates)
        return {
            "frame": self.frame,
            "frames": len(frames),
            "start": asdict(self.start),
            "models": list(self.knee.models()),
            "thickness_mm": None if self.knee.design is None else self.knee.design.thickness,
            "most_load_N": max(4000.0, 5.0 * self.knee.case.body_weight),
            "coarse": list(COARSE),
            "recorded": [{key: float(places[key][k]) for key in places} for k in frames],
            "ghosts": [poses[k].T.ravel().tolist() for k in frames],
        }

    def _packed(self, answer: LiveAnswer, saved: str | None = None) -> bytes:
        button = None if answer.patella is None else answer.patella.map
        peak = float(answer.pressure.max(initial=0.0)) / MEGAPASCAL
        peak = max(peak, 0.0 if button is None else button.peak)
        scale = next((top for top in SCALES_MPA if peak <= top), SCALES_MPA[-1])
        shown = PressureMap(
            answer.points,
            answer.triangles,
            answer.pressure[None] / MEGAPASCAL,
            answer.gap[None],
        )
        words = self._words(answer, scale) | {"saved": saved}
        return packed_map(shown, scale, json.dumps(words, allow_nan=False), button)

    def _words(self, answer: LiveAnswer, scale: float) -> dict[str, Any]:
        numbers = {name: x for name, x in answer.numbers.items() if math.isfinite(x)}
        forces = [numbers.get(f"{side}_force_N", 0.0) for side in SIDES]
        if sum(forces) > 0:
            numbers["medial_share"] = 100.0 * forces[0] / sum(forces)
        strands = {
            name: (
                ends,
                strain_colours(
                    answer.numbers[f"ligament_{name}_strain_percent"] / 100.0, STRAIN_LIMIT
                ),
            )
            for name, ends in answer.ligaments.items()
        }
        poses = {"femoral component/femoral component": answer.pose}
        if answer.patella is not None:
            strands |= {one.name: (one.points[0], one.colours[0]) for one in answer.patella.strands}
            poses |= dict.fromkeys(PATELLA_NODES, answer.patella.pose)
            poses["pressure map/button"] = answer.patella.button
        return {
            "status": answer.status,
            "request": asdict(answer.request),
            "label": f"{answer.request.contact} at {answer.request.resolution_mm:g} mm",
            "map": "/".join(map(str, setting(answer.request))),
            "error": _error_words(answer.error),
            "scale_MPa": scale,
            "numbers": numbers,
            "poses": {name: _finite(pose.T) for name, pose in poses.items()},
            "strands": {
                name.replace("/", "-"): {
                    "points": _finite(points),
                    "colours": np.broadcast_to(colours, points.shape).ravel().tolist(),
                }
                for name, (points, colours) in strands.items()
            },
            "centres": {
                f"{side} centre": centre.tolist() for side, centre in answer.centres.items()
            },
        }

    def _keep(self, request: BenchRequest) -> bytes:
        """Save the state as a scene; return its answer without an initial guess and its file.

        Raises:
            NotYet: the contact model is being prepared.
            TkambError: the state has no result, or the scene cannot be written.
        """
        if words := self.knee.preparing(request):
            raise NotYet(words)
        answer = self.knee.answer(request, from_rest=True)
        if answer.failed:
            raise TkambError(f"not saved: {answer.status.removeprefix('failed: ')}")
        return self._packed(answer, str(self.knee.save(request, self._next_folder())))

    def _next_folder(self) -> Path:
        number = 1
        while (self.folder / f"kept-{number}").exists():
            number += 1
        return self.folder / f"kept-{number}"

    def _drawing(self) -> Drawing:
        case: Case = self.knee.case
        assert case.femoral is not None and case.insert is not None
        recorded = knee_pose(case.motion.coordinates[self.frame])[None]
        still = np.eye(4)[None]
        metal = ("femoral component", "femoral component", case.femoral, METAL, 0.3)
        ghost = ("recorded femoral component", "recorded pose", case.femoral, RECORDED, 0.12)
        coarse = replace(self.start, contact=COARSE[0], resolution_mm=COARSE[1])
        answer = self.knee.answer(coarse)
        zeros = np.zeros((1, len(answer.points)))
        hidden = np.full((1, 3), np.nan)
        colour = np.tile(rgb(SLACK), (1, 1, 1))
        patella = self.knee.patella
        return Drawing(
            title="on the bench",
            side=case.scene.patient.side,
            body_weight=case.body_weight,
            contact=coarse.contact,
            labels=("",),
            times=np.zeros(1),
            statuses=("ok",),
            readings=(),
            solids=(
                Solid("insert", "insert", case.insert, INSERT, 1.0, still),
                Solid(*metal, recorded),
                Solid(*ghost, recorded),
                *(patella.solids() if patella else ()),
            ),
            strands=tuple(
                Strand(
                    one.name,
                    "ligaments",
                    np.full((1, 2 + 2 * len(one.wraps), 3), np.nan),
                    np.repeat(colour, 2 + 2 * len(one.wraps), axis=1),
                    1e-3,
                )
                for one in self.knee.bench.bundles
            )
            + (patella.tubes() if patella else ()),
            arrows=(),
            markers=tuple(
                Marker(f"{side} centre", "contact points", SIDE_COLOURS[side], hidden, 8e-4)
                for side in SIDES
            ),
            map=PressureMap(answer.points, answer.triangles, zeros, zeros + 1.0),
            strain_limit=STRAIN_LIMIT,
            button_map=patella.hidden.map if patella else None,
        )


def open_live(
    path: Path, *, frame: int = 0, contact: str | None = None, folder: Path | None = None
) -> LiveWindow:
    """Return the window of a scene or of a folder of results.

    Args:
        path: a scene file, or a folder that `tkamb run` wrote.
        frame: recorded frame at which the window opens.
        contact: contact model that replaces the scene's.
        folder: folder for saved scenes; None: out/live.
    """
    from tkamb.show.view.run import read_source

    case = read_source(path, contact).case
    return LiveWindow(LiveKnee(case), folder or DEFAULT_FOLDER, frame)


def live(
    source: str | Path | Knee,
    q: Any = None,
    load: float | None = None,
    *,
    frame: int = 0,
    contact: str | None = None,
    folder: str | Path | None = None,
    quadriceps: float | None = None,
) -> ViewServer:
    """Start a page on which a user moves and loads a knee by hand (docs/live.md).

    The load acts along the insert's y axis, in addition to the ligaments between femur and tibia.
    The page does not change a `tkamb.Knee`.

    Args:
        source: a scene file, a folder that `tkamb run` wrote, or a `tkamb.Knee`.
        q: configuration of the `tkamb.Knee`, shape (nq,); or (f, nq) for the slider "recorded
            frame".
        load: first value of the load on a `tkamb.Knee`, N; default: 1000 N.
        frame: recorded frame at which the window opens.
        contact: contact model that replaces the scene's.
        folder: folder for saved scenes; None: out/live.
        quadriceps: first value of the tension on a released patella, N; default: one body weight.

    Returns:
        The server, in a thread. Its address is `url`, and `close()` stops it.

    Raises:
        InputError: the path has no scene, the scene or the knee has no contact model, or an
            argument belongs to the other kind of source.
    """
    must_be(source, (str, os.PathLike, Knee), "live", "give a scene file, a folder or a tkamb.Knee")
    window = _window_of(source, q, load, frame, contact, Path(folder or DEFAULT_FOLDER))
    if quadriceps is not None:
        window.start = BenchRequest.read(asdict(window.start) | {"quadriceps_N": quadriceps})
    server = window.server()
    serve_in_background(server)
    return server


def _window_of(
    source: str | Path | Knee,
    q: Any,
    load: float | None,
    frame: int,
    contact: str | None,
    folder: Path,
) -> LiveWindow:
    if not isinstance(source, Knee):
        if q is not None or load is not None:
            raise InputError("q and load belong to a tkamb.Knee", "live", "the scene has its own")
        return open_live(Path(source), frame=frame, contact=contact, folder=folder)
    if contact is not None:
        raise InputError("contact belongs to a scene", "live", "give knee.with_contact(...)")
    if q is None:
        raise InputError("q is missing", "live", f"give a configuration ({source.model.nq},)")
    window = LiveWindow(bench_of_knee(source, q), folder, frame)
    window.start = BenchRequest.read(
        asdict(window.start) | {"load_N": 1000.0 if load is None else load}
    )
    return window


def bench_of_knee(knee: Knee, q: Any) -> LiveKnee:
    """Return a knee on the bench.

    Args:
        q: configuration (nq,), or configurations (f, nq) for the slider "recorded frame".
    """
    if knee.contact is None or knee.femoral is None or knee.insert is None:
        raise InputError("has no contact model", "Knee", "give contact= and implant=")
    placement = insert_placement(knee.insert)
    data = knee._kinematic_data()
    poses = np.array(
        [
            knee._kinematics(data, one).pose
            for one in np.atleast_2d(real_numbers(q, "live: q", "give (nq,) or (f, nq)"))
        ]
    )
    coordinates = knee_coordinates(placement @ poses)
    session = Path(tempfile.mkdtemp(prefix="tkamb-live-"))
    try:
        case = load_case(load_scene(write_knee(knee, placement, coordinates, session)))
    except InputError:
        shutil.rmtree(session, ignore_errors=True)
        raise
    patella = None if knee.patella is None else BenchPatella(knee, np.atleast_2d(q), placement)
    return LiveKnee(replace(case, motion=still_motion(coordinates)), session, patella)


def _finite(values: Array) -> list[float] | None:
    """Return an array as a flat list; None: it has a NaN, and the page hides the object."""
    return values.ravel().tolist() if np.isfinite(values).all() else None


def _error_words(error: dict[str, Any] | str) -> str:
    if isinstance(error, str):
        return f"its error is {error}" + (" at this spacing" if error == NOT_MEASURED else "")
    return (
        f"on the studied cases its error is at most {100 * error['peak_pressure']:.2g} % in "
        f"peak pressure, {100 * error['area']:.2g} % in area"
    )
