"""Drawings of a run, the viewer's server and its command; no browser is needed."""

import http.client
import json
import re
import shlex
import shutil
import socket
from dataclasses import replace
from importlib.resources import files

import h5py
import numpy as np
import pytest

from tkamb.cli import main
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.surface import Surface
from tkamb.io.scene.case import load_case
from tkamb.knee.wrapping import TautPath
from tkamb.run.maps import ContactMaps
from tkamb.run.results_folder import read_results
from tkamb.show.view import CAMERAS
from tkamb.show.view.drawing import SLACK, TENDON, PressureMap, rgb
from tkamb.show.view.lines import _tendon, ligament_strands
from tkamb.show.view.payload import PRESSURE_LEVELS, Block, _insert_transform, map_levels, shade
from tkamb.show.view.run import open_run
from tkamb.show.view.show import Show, serve_in_background
from viewed import copied_scene, shipped_run, short_results


@pytest.fixture(scope="module")
def folder():
    return shipped_run()


@pytest.fixture(scope="module")
def show(folder):
    return Show([open_run(folder)], frame=-1)


@pytest.fixture
def server(show):
    server = show.server()
    serve_in_background(server)
    yield server
    server.close()


def ask(server, method, path, body=None, below=None, **headers):
    """Return status and content of a request for a path below the token or another root."""
    response = answer(server, method, path, body, below, **headers)
    return response.status, response.read()


def answer(server, method, path, body=None, below=None, **headers):
    where, own, _ = server.url.removeprefix("http://").split("/")
    connection = http.client.HTTPConnection(*where.split(":"), timeout=60)
    root = f"/{own}" if below is None else below
    connection.request(method, root + path, body, {"Host": where} | headers)
    return connection.getresponse()


def sphere(rings=60):
    import trimesh

    ball = trimesh.creation.uv_sphere(radius=0.03, count=[rings, rings])
    return Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64), "ball")


def test_contact_points_are_read_from_the_run_or_computed_again(folder, tmp_path):
    """A contact.h5 of an earlier release has no contact points. The drawing is the same."""
    old = tmp_path / "old"
    shutil.copytree(folder, old)
    with h5py.File(old / "contact.h5", "r+") as file:
        assert file["contact_points_m"].shape == (len(file["time_s"]), 3, 3)
        assert np.isfinite(file["contact_points_m"][()]).all()
        del file["contact_points_m"], file["contact_normals"]
    read, computed = open_run(folder), open_run(folder)
    object.__setattr__(computed.results, "maps", ContactMaps(old / "contact.h5"))
    for one, other in zip(read.geometries(), computed.geometries(), strict=True):
        assert one.condyles.keys() == other.condyles.keys() == {"medial", "lateral"}
        for side, contact in one.condyles.items():
            np.testing.assert_allclose(contact.point, other.condyles[side].point, atol=1e-12)
            direction = contact.direction(0.05)
            np.testing.assert_allclose(direction, other.condyles[side].direction(0.05), atol=1e-12)
        for part in ("contact_point", "contact_normal"):
            parts = [getattr(geometry.extensor, part) for geometry in (one, other)]
            np.testing.assert_allclose(*parts, atol=1e-12)
        np.testing.assert_array_equal(one.state.pose("patella"), other.state.pose("patella"))


def test_the_wrapped_part_of_a_tendon_has_another_colour(show):
    quadriceps = next(one for one in show.drawings[0].strands if one.name == "quadriceps")
    wrap = show.runs[0].results["quadriceps_wrap_deg"]
    for frame, degrees in enumerate(wrap):
        kinds = len(np.unique(quadriceps.colours[frame], axis=0))
        assert kinds == (2 if degrees > 1.0 else 1)


def test_strands_are_as_long_as_their_lines(show):
    run, drawing = show.runs[0], show.drawings[0]
    for row, frame in enumerate(run.frames):
        state = run.recording.loads(frame).geometry.state
        for path in run.recording.extensor.lines.paths(state):
            lengths = [
                np.linalg.norm(np.diff(one.points[row], axis=0), axis=1).sum()
                for one in drawing.strands
                if one.layer == "extensor lines"
            ]
            assert min(abs(length - path.length) for length in lengths) < 1e-9


def test_levels_are_proportional_to_pressure_and_negative_outside_the_contact():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [0, 0, 1], [1, 0, 1]])
    triangles = np.array([[0, 1, 4], [1, 2, 5], [1, 5, 4]])
    pressure = np.array([[4.0, 2.0, 0, 0, 0, 0]])
    gap = np.array([[0.0, 0, 3e-5, 1e-4, 1e-5, 2e-5]])
    level = map_levels(PressureMap(points, triangles, pressure, gap), 4.0)[0]
    assert list(level[:2]) == [
        PRESSURE_LEVELS,
        round(PRESSURE_LEVELS / 2),
    ]
    assert (level[2:] < 0).all()
    assert level[2] < level[5] < level[4]


def test_a_slack_tendon_is_grey_and_the_free_part_of_a_taut_one_is_red():
    path = TautPath(np.array([[0.0, 0, 0], [1, 0, 0]]), 1.0, 0.0)
    strand = _tendon("quadriceps", [path, path], np.array([True, False]))
    assert (strand.colours[0] == rgb(SLACK)).all()
    assert (strand.colours[1] == rgb(TENDON)).all()


def test_a_failed_frame_shows_no_pressure():
    missing = np.full((1, 3), np.nan)
    level = map_levels(PressureMap(np.eye(3), np.array([[0, 1, 2]]), missing, missing), 10.0)
    assert (level < 0).all()


def test_a_failed_frame_does_not_affect_the_strain_scale(folder):
    """The pose of a failed frame may have very large strains."""
    run = open_run(folder)
    states = [one.state for one in run.geometries()]
    strands, limit = ligament_strands(run.recording, states, run.results)
    strains = {}
    for one in run.recording.ligaments:
        poses = {
            end.link: np.stack([s.pose(end.link) for s in states])
            for end in (one.proximal, one.distal)
        }
        strains[one.name] = one.strain(one.length(poses))
    assert limit == pytest.approx(max(map(np.max, strains.values())))
    worst = int(np.argmax(np.max(list(strains.values()), axis=0)))
    columns = dict(run.results.columns)
    columns["status"] = ["failed: x" if k == worst else "ok" for k in range(len(states))]
    strands, limit = ligament_strands(run.recording, states, replace(run.results, columns=columns))
    largest = [np.max(np.delete(one, worst)) for one in strains.values()]
    assert limit == pytest.approx(max(largest))
    assert all((strand.colours[worst] == rgb(SLACK)).all() for strand in strands)


def test_shading_keeps_every_triangle_and_repeats_vertices_on_sharp_edges():
    import trimesh

    box = trimesh.creation.box((0.02, 0.02, 0.02))
    surface = Surface(np.asarray(box.vertices), np.asarray(box.faces, np.int64), "box")
    drawn = shade(surface)
    assert len(drawn.faces) == 12 and len(drawn.vertices) == 24
    np.testing.assert_allclose(drawn.vertices[drawn.faces], surface.triangles, atol=1e-8)
    smooth = shade(sphere(), 20_000)
    assert len(smooth.vertices) == len(sphere().vertices)


def test_arrays_of_the_payload_are_aligned():
    block = Block()
    first = block.put([1, 2, 3], "uint8")
    second = block.put([1.5], "float32")
    assert (first["at"], second["at"]) == (0, 4)


def test_the_server_listens_on_loopback_only(server):
    assert server.url.startswith("http://127.0.0.1:")
    assert ask(server, "GET", "/")[0] == 200
    assert ask(server, "GET", "/nothing")[0] == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "knee.example"},
        {"Origin": "http://knee.example"},
        {"Origin": "null"},
        {"Origin": "HOST"},
    ],
)
def test_other_hosts_and_sites_are_refused(server, headers):
    host = server.url.split("/")[2]
    headers = {name: value.replace("HOST", host) for name, value in headers.items()}
    assert ask(server, "GET", "/scene.bin", **headers)[0] == 403
    body = json.dumps({"frame": 0, "model": "hertz"})
    assert ask(server, "POST", "/contact", body, **headers)[0] == 403


@pytest.mark.parametrize("below", ["", "/x", "/" + "A" * 24, "//"])
def test_an_address_without_the_token_is_refused(server, below):
    token = server.url.rstrip("/").rsplit("/", 1)[1]
    assert len(token) >= 20
    assert ask(server, "GET", "/", below=below)[0] == 403
    assert ask(server, "GET", "/scene.bin", below=below)[0] == 403
    body = json.dumps({"frame": 0, "model": "hertz"})
    status, content = ask(server, "POST", "/contact", body, below=below)
    assert status == 403 and token.encode() not in content


def test_each_window_has_another_token(show, server):
    other = show.server()
    assert other.url.split("/")[3] != server.url.split("/")[3]
    serve_in_background(other)
    other.close()


@pytest.mark.parametrize("path", ["/", "/scene.bin", "/nothing"])
def test_other_pages_may_not_embed_the_window(server, path):
    headers = answer(server, "GET", path).headers
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize(
    "line",
    [
        "GET {} ",
        "GET {}",
        "x",
        "GET {} HTTP/9",
        "POST {}contact",
        "TRACE {} HTTP/1.1",
        "GET {} x x",
    ],
)
def test_refused_request_lines_get_an_answer_with_all_headers(server, line):
    where, own, _ = server.url.removeprefix("http://").split("/")
    host, port = where.split(":")
    with socket.create_connection((host, int(port)), timeout=60) as client:
        client.sendall(f"{line.format(f'/{own}/')}\r\nHost: {where}\r\n\r\n".encode())
        content = b"".join(iter(lambda: client.recv(4096), b""))
    head, _, body = content.partition(b"\r\n\r\n")
    assert head.startswith((b"HTTP/1.0 4", b"HTTP/1.0 5")) and b"nosniff" in head
    assert b"<" not in body and b"\n" not in body


def test_the_connection_of_a_silent_client_is_closed(server, monkeypatch):
    handler = server._server.RequestHandlerClass
    monkeypatch.setattr(handler, "timeout", 0.2)
    where, own, _ = server.url.removeprefix("http://").split("/")
    host, port = where.split(":")
    request = f"POST /{own}/contact HTTP/1.1\r\nHost: {where}\r\nContent-Length: 50\r\n\r\n{{"
    for sent, expected in ((b"", b""), (b"GET /", b""), (request.encode(), b" 408 ")):
        with socket.create_connection((host, int(port)), timeout=60) as client:
            client.sendall(sent)
            content = b"".join(iter(lambda: client.recv(4096), b""))
        assert expected in content and bool(expected) == bool(content)
    assert ask(server, "GET", "/")[0] == 200


@pytest.mark.parametrize(
    ("body", "word"),
    [
        (b"", "bytes"),
        (b"[]", "object"),
        (b"{", "Expecting"),
        (b"\xff\xfe{", "decode"),
        (b"[" * 9999, "recursion"),
        (b'{"frame": 1e400, "model": "hertz"}', "integer"),
        (b'{"frame": NaN, "model": "hertz"}', "integer"),
        (b'{"frame": true, "model": "hertz"}', "integer"),
        (b'{"frame": 0, "model": ["hertz"]}', "name"),
        (b'{"frame": 1' + b"0" * 5000 + b', "model": "hertz"}', "limit"),
        (b'{"frame": 999, "model": "hertz"}', "999"),
        (b'{"frame": 0, "model": "none such"}', "none such"),
        (b'{"frame": 0, "model": "\\ud800"}', "ud800"),
    ],
)
def test_a_bad_request_gets_one_line(server, body, word):
    status, answer = ask(server, "POST", "/contact", body)
    assert status == 400 and word in answer.decode() and b"\n" not in answer


def test_a_run_with_set_is_shown_with_its_keys_and_the_hint_repeats_them(tmp_path, capsys):
    scene, out = copied_scene(tmp_path / "knee"), tmp_path / "out"
    given = {"motion.frames": 11, "patient.mass_kg": 80.5, "contact.released": ["ap"]}
    words = [word for k, v in given.items() for word in ("--set", f"{k}={json.dumps(v)}")]
    assert main(["run", str(scene), "--frames", "0:11:10", *words, "--out", str(out)]) == 0
    assert open_run(out).case.body_mass == 80.5
    assert open_run(out).frames == (0, 10)
    assert main(["view", str(out), "--html", str(tmp_path / "x.html")]) == 0
    text, changed = re.subn(r'(height_mm"? = )1750', r"\g<1>1760", scene.read_text())
    assert changed == 1
    scene.write_text(text)
    capsys.readouterr()
    assert main(["view", str(out), "--html", str(tmp_path / "y.html")]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.endswith(shlex.join([str(scene), *words]))


def test_results_of_a_changed_scene_are_refused(tmp_path, capsys):
    scene = copied_scene(tmp_path / "knee")
    out = tmp_path / "out"
    out.mkdir()
    short_results(out, scene, every=100)
    text, changed = re.subn(r'(mass_kg"? = )75\.0', r"\g<1>76.0", scene.read_text())
    assert changed == 1
    scene.write_text(text)
    assert main(["view", str(out), "--html", str(tmp_path / "x.html")]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "has changed" in line and "tkamb run" in line
    assert not (tmp_path / "x.html").exists()


def test_results_of_a_changed_mesh_are_refused(tmp_path, capsys):
    scene = copied_scene(tmp_path / "knee")
    out = tmp_path / "out"
    out.mkdir()
    short_results(out, scene, every=100)
    mesh = scene.parent / "insert.stl"
    data = bytearray(mesh.read_bytes())
    data[-60] ^= 1
    mesh.write_bytes(bytes(data))
    assert main(["view", str(out), "--html", str(tmp_path / "x.html")]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "mesh or table" in line and "tkamb run" in line
    assert not (tmp_path / "x.html").exists()


def test_a_missing_browser_is_reported_in_one_line(folder, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PATH", "")
    assert main(["view", str(folder), "--png", str(tmp_path / "x.png")]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert "no browser found" in lines[-1] and "Traceback" not in "".join(lines)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--frame", "999"], "999"),
        (["--frame", "-999"], "-999"),
        (["--camera", "behind"], "behind"),
        (["--contact", "hertz"], "own"),
        (["--contact", "nothing"], "nothing"),
        (["--port", "-1"], "no port -1"),
        (["--port", "65536"], "no port 65536"),
        (["--png", "/no/such/folder/x.png"], "cannot be written"),
    ],
)
def test_bad_options_are_refused_before_anything_is_drawn(
    folder, tmp_path, capsys, monkeypatch, options, word
):
    monkeypatch.setattr("tkamb.show.view.run.match_frames", None)
    page = tmp_path / "x.html"
    written = [] if "--port" in options else ["--html", str(page)]
    assert main(["view", str(folder), *written, *options]) == 2
    assert word in capsys.readouterr().err.strip().splitlines()[-1]
    assert not page.exists()


def test_a_scene_that_is_run_for_the_viewer_is_read_once(folder, tmp_path, monkeypatch):
    results = read_results(folder)
    read, run = [], []

    def counted(scene):
        read.append(load_case(scene))
        return read[-1]

    def simulated(case, **given):
        run.append(case)
        return results

    monkeypatch.chdir(tmp_path)  # this folder has no results of the scene
    for module in ("tkamb.show.view.run", "tkamb.run.simulation"):
        monkeypatch.setattr(f"{module}.load_case", counted)
    monkeypatch.setattr("tkamb.show.view.run.simulate", simulated)
    page = tmp_path / "x.html"
    scene = results.summary["scene"]
    assert main(["view", str(scene), "--frame", "1", "--html", str(page)]) == 0
    assert len(read) == 1 and run == read


def test_the_command_prints_the_written_file(folder, tmp_path, capsys):
    page = tmp_path / "knee.html"
    assert main(["view", str(folder), "--html", str(page)]) == 0
    assert capsys.readouterr().out == f"page: {page}\n"


def test_a_folder_without_results_is_refused(tmp_path, capsys):
    assert main(["view", str(tmp_path)]) == 2
    assert "results.csv" in capsys.readouterr().err


def test_only_a_picture_needs_a_browser(show, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    show.write_html(tmp_path / "knee.html")
    assert (tmp_path / "knee.html").stat().st_size < 25e6
    with pytest.raises(ComputationError):
        show.write_png(tmp_path / "knee.png")
    with pytest.raises(InputError):
        Show(show.runs, frame=77)


def test_a_left_knee_is_mirrored_by_the_transform_of_the_page(show):
    right, left = (
        np.reshape(command.lower()["matrix"], (4, 4)).T
        for command in (_insert_transform("/tkamb/0", side) for side in ("right", "left"))
    )
    anterior, superior, lateral = np.eye(4)[:3]
    np.testing.assert_allclose(right @ superior, [0, 0, 1, 0])
    np.testing.assert_allclose(left @ superior, [0, 0, 1, 0])
    np.testing.assert_allclose(left @ anterior, right @ anterior)
    np.testing.assert_allclose(left @ lateral, -(right @ lateral))


def test_arrows_of_a_coupled_run_add_up_to_its_contact_force(tmp_path):
    scene = copied_scene(tmp_path / "knee")
    text = scene.read_text().replace(
        'model = "foundation"', 'model = "foundation"\ncoupling = "points"'
    )
    scene.write_text(text)
    out = tmp_path / "out"
    out.mkdir()
    short_results(out, scene, every=50)
    show = Show([open_run(out)])
    results, arrows = show.runs[0].results, {one.name: one for one in show.drawings[0].arrows}
    pressed = arrows["medial condyle"].forces + arrows["lateral condyle"].forces
    given = np.stack([results["force_ap_N"], -results["force_si_N"], results["force_ml_N"]], axis=1)
    np.testing.assert_allclose(pressed, given, atol=1e-3 * np.abs(given).max())


def test_command_line_and_page_have_the_same_cameras():
    text = files("tkamb.show.view").joinpath("assets", "controls.js").read_text(encoding="utf-8")
    block = text.split("const CAMERAS = {")[1].split("\n};")[0]
    assert tuple(re.findall(r'^  "([^"]+)":', block, re.MULTILINE)) == CAMERAS


def test_the_view_of_the_button_needs_its_map():
    with pytest.raises(InputError, match="no map of the patellar button"):
        Show([open_run(shipped_run())], camera="button")
