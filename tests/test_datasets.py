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
    """Serves `files` (path -> content), notes paths as `asked`, and truncates files in `cut`."""

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


def is_complete(folder):
    return all((folder / name).read_bytes() == CONTENT[name] for name in files_in(folder))


def test_files_are_downloaded_once(tmp_path, dataset, server, capsys):
    assert "3 files written, 0 were there" in get(capsys, "--to", tmp_path, "--url", server.url)
    assert files_in(tmp_path) == set(CONTENT)
    assert is_complete(tmp_path)
    asked = list(server.asked)
    assert "0 files written, 3 were there" in get(capsys, "--to", tmp_path, "--url", server.url)
    assert server.asked == asked


def test_an_interrupted_download_is_resumed(tmp_path, dataset, server, capsys):
    server.cut.add("/c0ffee/Geometry/Part decimated.stl")
    get(capsys, "--to", tmp_path, "--url", server.url, status=2)
    assert files_in(tmp_path) == {"model.osim"}
    server.cut.clear()
    server.asked.clear()
    get(capsys, "--to", tmp_path, "--url", server.url)
    assert files_in(tmp_path) == set(CONTENT)
    assert is_complete(tmp_path)
    assert "/c0ffee/models/A model.osim" not in server.asked


def test_another_content_is_not_kept(tmp_path, dataset, server, capsys):
    server.files["/c0ffee/models/A model.osim"] += b" "
    output = get(capsys, "--to", tmp_path / "new", "--url", server.url, status=2)
    assert "SHA-256" in output
    assert "model.osim" in output
    assert not (tmp_path / "new").exists()


def test_a_file_that_the_server_lacks_is_an_error(tmp_path, dataset, server, capsys):
    del server.files["/c0ffee/models/A model.osim"]
    output = get(capsys, "--to", tmp_path / "new", "--url", server.url, status=2)
    assert "HTTP status 404" in output
    assert not (tmp_path / "new").exists()


def test_no_network_is_an_error_with_a_remedy(tmp_path, dataset, capsys):
    with socket.socket() as closed:  # This port is bound, but no server listens.
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        output = get(capsys, "--to", tmp_path / "new", "--url", url, status=2)
    assert "no network?" in output
    assert "--from DIR" in output
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("url", ["ftp.example", "http://", "file:///etc"])
def test_an_impossible_mirror_address_is_refused(url, tmp_path, dataset, capsys):
    get(capsys, "--to", tmp_path / "new", "--url", url, status=2)
    assert not (tmp_path / "new").exists()


def test_without_pooch_one_line_says_how_to_get_it(tmp_path, dataset, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    output = get(capsys, "--to", tmp_path / "new", status=2)
    assert "pip install 'tkamb[data]'" in output
    assert not (tmp_path / "new").exists()


def test_a_file_of_unknown_address_is_named_and_not_asked_for(tmp_path, dataset, server, capsys):
    dataset(file_of("model.osim"), file_of("motion/walk.sto", commit=None, path=None))
    output = get(capsys, "--to", tmp_path, "--url", server.url)
    assert "motion/walk.sto" in output
    assert files_in(tmp_path) == {"model.osim"}


@pytest.mark.parametrize("names", [CONTENT.keys(), PUBLISHED.values(), ["flat"]])
def test_files_are_copied_from_a_folder_of_downloads(names, tmp_path, dataset, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)  # A copy does not need pooch.
    source, to = tmp_path / "by hand", tmp_path / "new"
    flat = [Path(path).name for path in PUBLISHED.values()]
    for name, content in zip(flat if names == ["flat"] else names, CONTENT.values(), strict=True):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes(content)
    assert "3 files written" in get(capsys, "--from", source, "--to", to)
    assert files_in(to) == set(CONTENT)
    assert is_complete(to)


def test_a_damaged_download_leaves_nothing(tmp_path, dataset, capsys):
    for name, content in CONTENT.items():
        (tmp_path / "by hand" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "by hand" / name).write_bytes(content)
    (tmp_path / "by hand" / "motion" / "walk.sto").write_bytes(b"1 2 3\n")
    output = get(capsys, "--from", tmp_path / "by hand", "--to", tmp_path / "new", status=2)
    assert "walk.sto" in output
    assert not (tmp_path / "new").exists()


def test_an_empty_or_absent_folder_is_refused(tmp_path, dataset, capsys):
    assert "none of the files" in get(capsys, "--from", tmp_path, "--to", tmp_path / "n", status=2)
    assert "not a folder" in get(capsys, "--from", tmp_path / "0", "--to", tmp_path / "n", status=2)
    assert files_in(tmp_path) == set()


def test_a_changed_file_is_not_replaced(tmp_path, dataset, server, capsys):
    (tmp_path / "model.osim").write_bytes(b"mine")
    output = get(capsys, "--to", tmp_path, "--url", server.url, status=2)
    assert "does not replace your files" in output
    assert (tmp_path / "model.osim").read_bytes() == b"mine"
    assert server.asked == []


def test_a_target_that_is_a_file_is_refused(tmp_path, dataset, server, capsys):
    (tmp_path / "taken").write_bytes(b"")
    get(capsys, "--to", tmp_path / "taken", "--url", server.url, status=2)


def test_the_registry_has_all_files_of_the_scenes():
    files = {file.name: file for file in read_dataset("dm").files}
    scenes = Path(__file__).parents[1] / "models" / "dm"
    text = "".join(path.read_text() for path in scenes.glob("*.toml"))
    used = [part.split('"')[0] for part in text.split("shared/data/dm/")[1:]]
    assert len(used) > 5
    for name in used:
        assert files[name].commit is not None, name
    assert all(len(file.sha256) == 64 for file in files.values())


@pytest.mark.skipif(not SHARED.is_dir(), reason="subject DM's files (../shared/data/dm) are absent")
def test_the_real_files_are_the_registered_ones(tmp_path, capsys):
    output = get(capsys, "--from", SHARED, "--to", tmp_path / "dm")
    names = json.loads((Path(inspect.getfile(Dataset)).parent / "dm.json").read_text())["files"]
    assert f"{len(names)} files written" in output
    assert files_in(tmp_path / "dm") == set(names)
