"""`tkamb data get` from a local server and a folder writes only complete, checked files."""

import hashlib
import http.server
import inspect
import json
import socket
import sys
import threading
from pathlib import Path

import pytest

from tkamb.cli import main
from tkamb.commands import import_model as command
from tkamb.io.datasets import DataFile, Dataset, read_dataset

SHARED = Path(__file__).parents[2] / "shared" / "data" / "dm"
CONTENT = {
    "model.osim": b"<model/>" * 40,
    "geometry/part.stl": b"solid" * 2000,
    "motion/walk.sto": b"1 2 3\n" * 300,
}
PUBLISHED = {
    "model.osim": "models/A model.osim",
    "geometry/part.stl": "Geometry/Part decimated.stl",
    "motion/walk.sto": "motion/walk.sto",
}


def file_of(name, **changed):
    entry = {"commit": "c0ffee", "path": PUBLISHED[name], **changed}
    return DataFile(name, hashlib.sha256(CONTENT[name]).hexdigest(), **entry)


@pytest.fixture
def dataset(monkeypatch):
    def use(*files):
        files = files or tuple(map(file_of, CONTENT))
        made = Dataset("small", "CC0", "http://repository", "http://127.0.0.1:9", Path("x"), files)
        monkeypatch.setattr(command, "read_dataset", lambda name: made)

    use()
    return use


class Server(http.server.ThreadingHTTPServer):
    """Serves CONTENT under a commit; `answers` maps a path to another answer."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files = {f"/c0ffee/{PUBLISHED[name]}": text for name, text in CONTENT.items()}
        self.asked, self.cut = [], set()
        self.url = f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        path = self.path.replace("%20", " ")
        self.server.asked.append(path)
        content = self.server.files.get(path)
        if content is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) // 2] if path in self.server.cut else content)

    def log_message(self, *arguments):
        pass


@pytest.fixture
def server():
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def files_in(folder):
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def get(capsys, *arguments, status=0):
    assert main(["data", "get", "dm", *map(str, arguments)]) == status
    out, err = capsys.readouterr()
    if status:
        assert out == ""
        assert err.count("\n") == 1
        return err
    assert err == ""
    return out


def whole(folder):
    return all((folder / name).read_bytes() == CONTENT[name] for name in files_in(folder))


def test_downloads_once_and_then_keeps(tmp_path, dataset, server, capsys):
    assert "3 files written, 0 were there" in get(capsys, "--to", tmp_path, "--url", server.url)
    assert files_in(tmp_path) == set(CONTENT)
    assert whole(tmp_path)
    asked = list(server.asked)
    assert "0 files written, 3 were there" in get(capsys, "--to", tmp_path, "--url", server.url)
    assert server.asked == asked


def test_an_interrupted_download_goes_on(tmp_path, dataset, server, capsys):
    server.cut.add("/c0ffee/Geometry/Part decimated.stl")
    get(capsys, "--to", tmp_path, "--url", server.url, status=2)
    assert files_in(tmp_path) == {"model.osim"}
    server.cut.clear()
    server.asked.clear()
    get(capsys, "--to", tmp_path, "--url", server.url)
    assert files_in(tmp_path) == set(CONTENT)
    assert whole(tmp_path)
    assert "/c0ffee/models/A model.osim" not in server.asked


def test_another_content_is_not_kept(tmp_path, dataset, server, capsys):
    server.files["/c0ffee/models/A model.osim"] += b" "
    said = get(capsys, "--to", tmp_path / "new", "--url", server.url, status=2)
    assert "SHA-256" in said
    assert "model.osim" in said
    assert not (tmp_path / "new").exists()


def test_a_file_that_is_gone(tmp_path, dataset, server, capsys):
    del server.files["/c0ffee/models/A model.osim"]
    said = get(capsys, "--to", tmp_path / "new", "--url", server.url, status=2)
    assert "HTTP status 404" in said
    assert not (tmp_path / "new").exists()


def test_no_network(tmp_path, dataset, capsys):
    with socket.socket() as closed:  # bound, but nobody listens
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        said = get(capsys, "--to", tmp_path / "new", "--url", url, status=2)
    assert "no network?" in said
    assert "--from DIR" in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("url", ["ftp.example", "http://", "file:///etc"])
def test_a_mirror_that_is_none(url, tmp_path, dataset, capsys):
    get(capsys, "--to", tmp_path / "new", "--url", url, status=2)
    assert not (tmp_path / "new").exists()


def test_without_pooch_one_line_says_how_to_get_it(tmp_path, dataset, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    said = get(capsys, "--to", tmp_path / "new", status=2)
    assert "pip install 'tkamb[data]'" in said
    assert not (tmp_path / "new").exists()


def test_a_file_of_unknown_address_is_named_and_not_asked_for(tmp_path, dataset, server, capsys):
    dataset(file_of("model.osim"), file_of("motion/walk.sto", commit=None, path=None))
    said = get(capsys, "--to", tmp_path, "--url", server.url)
    assert "motion/walk.sto" in said
    assert files_in(tmp_path) == {"model.osim"}


@pytest.mark.parametrize("names", [CONTENT.keys(), PUBLISHED.values(), ["flat"]])
def test_a_folder_of_downloads(names, tmp_path, dataset, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)  # not needed
    source, to = tmp_path / "by hand", tmp_path / "new"
    flat = [Path(path).name for path in PUBLISHED.values()]
    for name, content in zip(flat if names == ["flat"] else names, CONTENT.values(), strict=True):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes(content)
    assert "3 files written" in get(capsys, "--from", source, "--to", to)
    assert files_in(to) == set(CONTENT)
    assert whole(to)


def test_a_damaged_download_leaves_nothing(tmp_path, dataset, capsys):
    for name, content in CONTENT.items():
        (tmp_path / "by hand" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "by hand" / name).write_bytes(content)
    (tmp_path / "by hand" / "motion" / "walk.sto").write_bytes(b"1 2 3\n")
    said = get(capsys, "--from", tmp_path / "by hand", "--to", tmp_path / "new", status=2)
    assert "walk.sto" in said
    assert not (tmp_path / "new").exists()


def test_folders_that_hold_nothing(tmp_path, dataset, capsys):
    assert "none of the files" in get(capsys, "--from", tmp_path, "--to", tmp_path / "n", status=2)
    assert "not a folder" in get(capsys, "--from", tmp_path / "0", "--to", tmp_path / "n", status=2)
    assert files_in(tmp_path) == set()


def test_a_changed_file_is_not_replaced(tmp_path, dataset, server, capsys):
    (tmp_path / "model.osim").write_bytes(b"mine")
    said = get(capsys, "--to", tmp_path, "--url", server.url, status=2)
    assert "does not replace your files" in said
    assert (tmp_path / "model.osim").read_bytes() == b"mine"
    assert server.asked == []


def test_a_target_that_is_a_file(tmp_path, dataset, server, capsys):
    (tmp_path / "taken").write_bytes(b"")
    get(capsys, "--to", tmp_path / "taken", "--url", server.url, status=2)


def test_the_registry_names_what_the_scenes_use():
    files = {file.name: file for file in read_dataset("dm").files}
    scenes = Path(__file__).parents[1] / "models" / "dm"
    text = "".join(path.read_text() for path in scenes.glob("*.toml"))
    used = [part.split('"')[0] for part in text.split("shared/data/dm/")[1:]]
    assert len(used) > 5
    for name in used:
        assert files[name].commit is not None, name
    assert all(len(file.sha256) == 64 for file in files.values())


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real data are not here")
def test_the_real_files_are_the_registered_ones(tmp_path, capsys):
    said = get(capsys, "--from", SHARED, "--to", tmp_path / "dm")
    names = json.loads((Path(inspect.getfile(Dataset)).parent / "dm.json").read_text())["files"]
    assert f"{len(names)} files written" in said
    assert files_in(tmp_path / "dm") == set(names)
