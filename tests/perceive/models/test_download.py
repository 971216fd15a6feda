"""Models from the web: whole and checked, or not at all; a real server on loopback that breaks, lies and is gone."""

import dataclasses
import fcntl
import hashlib
import json
import socket
import threading
import tomllib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path

import pytest

from jobs.cli import main
from pipeline.core import third_party_models
from pipeline.core.errors import DownloadError
from pipeline.core.third_party_models import CATALOGUE, manifest_text
from pipeline.perceive.models.download import download
from pipeline.perceive.models.manifest import Manifest, read_manifest

CONTENT = bytes(range(256)) * 4000  # about a megabyte: several blocks
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """Serves CONTENT under every path; `breaks` answers end after half of what they promised."""

    daemon_threads = True
    breaks, ranges, status, content = 0, True, 200, CONTENT

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = []

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/model.onnx"


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        server, wanted = self.server, self.headers.get("Range", "")
        server.asked.append(wanted)
        if server.status != 200:
            self.send_error(server.status)
            return
        begin = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted and server.ranges else 0
        body = server.content[begin:]
        if begin >= len(server.content):
            self.send_error(416)
            return
        self.send_response(206 if begin else 200)
        if begin:
            self.send_header(
                "Content-Range", f"bytes {begin}-{len(server.content) - 1}/{len(server.content)}"
            )
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if server.breaks:
            server.breaks -= 1
            body = body[: len(body) // 2]
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    server = Server()
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def fetched(server, file, sha256=SHA256, told=None):
    told = [] if told is None else told
    return download(server.url, file, len(CONTENT), sha256, lambda done, *_: told.append(done), pause_s=0.001)


def test_a_file_comes_whole_and_is_not_asked_for_twice(server, tmp_path):
    file, told = tmp_path / "models" / "model.onnx", []
    assert fetched(server, file, told=told)
    assert file.read_bytes() == CONTENT
    assert all(a < b for a, b in pairwise(told))
    assert told[-1] == len(CONTENT)
    assert not fetched(server, file)
    assert server.asked == [""]
    assert [f.name for f in file.parent.iterdir()] == ["model.onnx"]


def test_a_break_in_the_middle_goes_on_from_there(server, tmp_path):
    server.breaks, told = 2, []
    assert fetched(server, tmp_path / "model.onnx", told=told)
    assert (tmp_path / "model.onnx").read_bytes() == CONTENT
    half, quarter = len(CONTENT) // 2, len(CONTENT) // 4
    assert server.asked == ["", f"bytes={half}-", f"bytes={half + quarter}-"]
    assert all(a < b for a, b in pairwise(told))  # nothing came twice


def test_after_the_last_try_the_next_call_goes_on(server, tmp_path):
    server.breaks = 3
    with pytest.raises(DownloadError, match="the next call continues from there"):
        fetched(server, tmp_path / "model.onnx")
    assert not (tmp_path / "model.onnx").exists()
    assert fetched(server, tmp_path / "model.onnx")
    assert server.asked[-1].startswith("bytes=")
    assert (tmp_path / "model.onnx").read_bytes() == CONTENT


def test_a_server_without_ranges_sends_all_of_it_again(server, tmp_path):
    server.breaks, server.ranges = 1, False
    assert fetched(server, tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").read_bytes() == CONTENT


@pytest.mark.parametrize("how", ["other", "longer"])
def test_another_file_is_not_kept_and_leaves_the_one_before(how, server, tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"of an earlier release")
    server.content = CONTENT[::-1] if how == "other" else CONTENT + b"more"
    words = {"other": f"not {SHA256}: this is not the file", "longer": "more than 1,024,000 bytes come"}[how]
    with pytest.raises(DownloadError, match=words):
        fetched(server, tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").read_bytes() == b"of an earlier release"
    server.content = CONTENT
    assert fetched(server, tmp_path / "model.onnx")
    assert (tmp_path / "model.onnx").read_bytes() == CONTENT


def test_a_missing_file_is_asked_for_once_and_a_failing_server_three_times(server, tmp_path):
    for server.status, asked in ((404, 1), (503, 3)):
        server.asked.clear()
        with pytest.raises(DownloadError, match=f"the server answers {server.status}"):
            fetched(server, tmp_path / "model.onnx")
        assert len(server.asked) == asked


def test_without_a_network_the_error_says_what_to_do(tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/model.onnx"
        with pytest.raises(DownloadError, match="no connection") as told:
            download(url, tmp_path / "model.onnx", 10, SHA256, pause_s=0.001)
    assert not list(tmp_path.iterdir())
    assert f"copy the file from another machine to {tmp_path / 'model.onnx'}" in str(told.value)
    (tmp_path / "model.onnx").write_bytes(CONTENT)
    assert not download(url, tmp_path / "model.onnx", len(CONTENT), SHA256)


def test_two_at_once_are_told(server, tmp_path):
    with (tmp_path / ".model.onnx.part").open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another process downloads"):
            fetched(server, tmp_path / "model.onnx")


def test_the_command_shows_the_licence_places_manifests_and_says_the_line(
    server, tmp_path, capsys, monkeypatch
):
    made = [dataclasses.replace(m, size_bytes=len(CONTENT), sha256=SHA256) for m in CATALOGUE]
    monkeypatch.setattr(third_party_models, "CATALOGUE", tuple(made))
    mirror = server.url.rsplit("/", 1)[0]
    assert main(["models", "fetch", "--into", str(tmp_path / "models"), "--mirror", mirror]) == 0
    shown = capsys.readouterr()
    said = json.loads(shown.out.splitlines()[-1])
    assert said["fetched"] == [m.name for m in CATALOGUE]
    for model in CATALOGUE:
        assert model.licence_url in "".join(shown.err.split())
        manifest = read_manifest(tmp_path / "models" / f"{model.name}.toml", Manifest)
        assert (manifest.sha256, manifest.task) == (SHA256, model.task)
    entered = tomllib.loads(said["enter_in_fleet_toml"])["rigs"]["NAME"]["camera"]["semantics"]
    assert all(Path(entered[key]).exists() for key in ("segmenter", "detector"))
    assert main(["models", "fetch", "no-such"]) == 2
    changed = tmp_path / "models" / f"{CATALOGUE[0].name}.toml"
    changed.write_text(changed.read_text().replace("[512, 1024]", "[256, 512]"))
    assert main(["models", "fetch", "--into", str(tmp_path / "models"), "--mirror", mirror]) == 0
    assert "[256, 512]" in changed.read_text()


def test_manifests_of_the_catalogue_are_read():
    for model in CATALOGUE:
        read = tomllib.loads(manifest_text(model))
        assert Manifest.model_validate(read).output.label_set in ("ade20k", "coco")
        assert model.url.startswith("https://")
        assert len(model.sha256) == 64
