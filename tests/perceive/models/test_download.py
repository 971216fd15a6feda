"""Models from the web: whole and checked, or not at all; a real server on loopback that breaks, lies and is gone."""

import dataclasses
import hashlib
import json
import socket
import stat
import threading
import tomllib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from jobs.cli import main
from pipeline.core import models
from pipeline.core.errors import DownloadError
from pipeline.core.models import CATALOGUE
from pipeline.perceive.models.download import download
from pipeline.perceive.models.manifest import Manifest, read_manifest

CONTENT = bytes(range(256)) * 4000  # about a megabyte: several blocks
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves CONTENT under every path; `breaks` answers end after half of what they promised."""

    daemon_threads = True
    breaks, status, content = 0, 200, CONTENT

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = 0

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/model.onnx"


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        server.asked += 1
        if server.status != 200:
            self.send_error(server.status)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(server.content)))
        self.end_headers()
        body = server.content
        if server.breaks:
            server.breaks -= 1
            body = body[: len(body) // 2]
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr("pooch.core.time", SimpleNamespace(sleep=lambda _: None))
    server = Server()
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def fetched(server, file, sha256=SHA256, told=None):
    told = [] if told is None else told
    return download(server.url, file, len(CONTENT), sha256, lambda done, *_: told.append(done))


def test_a_file_comes_whole_and_is_not_asked_for_twice(server, tmp_path, capfd):
    file, told = tmp_path / "models" / "model.onnx", []
    assert fetched(server, file, told=told)
    assert file.read_bytes() == CONTENT
    assert all(a <= b for a, b in pairwise(told))
    assert told[-1] == len(CONTENT)
    assert not fetched(server, file)
    assert server.asked == 1
    assert [f.name for f in file.parent.iterdir()] == ["model.onnx"]
    assert stat.filemode(file.stat().st_mode) == "-rw-r--r--"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("how", ["other", "longer"])
def test_another_file_is_not_kept_and_leaves_the_one_before(how, server, tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"of an earlier release")
    server.content = CONTENT[::-1] if how == "other" else CONTENT + b"more"
    words = {"other": f"expected {SHA256} but got", "longer": "more than 1,024,000 bytes: not"}[how]
    with pytest.raises(DownloadError, match=words):
        fetched(server, tmp_path / "model.onnx")
    assert [f.read_bytes() for f in tmp_path.iterdir()] == [b"of an earlier release"]
    server.content = CONTENT
    assert fetched(server, tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").read_bytes() == CONTENT


@pytest.mark.usefixtures("server")
def test_without_a_network_the_error_says_what_to_do(tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/model.onnx"
        with pytest.raises(DownloadError, match="refused") as told:
            download(url, tmp_path / "model.onnx", 10, SHA256)
    assert not list(tmp_path.iterdir())
    assert f"copy the file from another machine to {tmp_path / 'model.onnx'}" in str(told.value)
    (tmp_path / "model.onnx").write_bytes(CONTENT)
    assert not download(url, tmp_path / "model.onnx", len(CONTENT), SHA256)


def test_the_command_shows_the_licence_places_manifests_and_says_the_line(
    server, tmp_path, capsys, monkeypatch
):
    made = [dataclasses.replace(m, size_bytes=len(CONTENT), sha256=SHA256) for m in CATALOGUE]
    monkeypatch.setattr(models, "CATALOGUE", tuple(made))
    mirror = server.url.rsplit("/", 1)[0]
    assert main(["models", "--fetch", "--into", str(tmp_path / "models"), "--mirror", mirror]) == 0
    shown = capsys.readouterr()
    said = json.loads(shown.out.splitlines()[-1])
    assert said["fetched"] == [m.name for m in CATALOGUE]
    for model in CATALOGUE:
        assert model.licence_url in "".join(shown.err.split())
        manifest = read_manifest(tmp_path / "models" / f"{model.name}.toml", Manifest)
        assert (manifest.sha256, manifest.task) == (SHA256, model.task)
    entered = tomllib.loads(said["enter_in_fleet_toml"])["rigs"]["NAME"]["camera"]["semantics"]
    assert all(Path(entered[key]).exists() for key in ("segmenter", "detector"))
    assert main(["models", "--fetch", "no-such"]) == 2
    changed = tmp_path / "models" / f"{CATALOGUE[0].name}.toml"
    changed.write_text(changed.read_text().replace("[512, 1024]", "[256, 512]"))
    assert main(["models", "--fetch", "--into", str(tmp_path / "models"), "--mirror", mirror]) == 0
    assert "[256, 512]" in changed.read_text()
