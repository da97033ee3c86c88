"""A stand-in for the Hub: the endpoints that huggingface_hub uses for data sets, on a port of this machine."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

import huggingface_hub
import pytest

LARGE = (".safetensors", ".parquet")  # as in the .gitattributes of the Hub's data sets


class Hub(ThreadingHTTPServer):
    """Data sets in memory; what git LFS has brought is in `objects` too, by its SHA-256.

    `cut` holds how often an answer with this file breaks off in the middle. While it is `closed`, nobody may write.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, dict[str, bytes]] = {}
        self.objects: dict[str, bytes] = {}
        self.cut: dict[str, int] = {}
        self.asked: list[str] = []
        self.closed = False

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    @property
    def storage(self) -> str:
        """Where large files lie: for the client another host, as on the Hub."""
        return f"http://localhost:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"
    sha = "0123456789abcdef0123456789abcdef01234567"

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        self.server.asked.append(path)
        if match := re.fullmatch(r"/api/datasets/([^/]+/[^/]+)(?:/revision/(.+))?", path):
            self.give_repository(match[1], match[2] or "main")
        elif match := re.fullmatch(r"/datasets/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            self.give_file(match[1], match[3])
        elif match := re.fullmatch(r"/objects/([^/]+/[^/]+)/(.+)", path):
            self.give(match[2], self.server.files[match[1]][match[2]], {})
        else:
            self.answer(404, {"error": "no such page"})

    do_HEAD = do_GET

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        path = urlsplit(self.path).path
        if self.server.closed:
            self.answer(401, {"error": "Invalid username or password."})
        elif path == "/api/repos/create":
            wanted = json.loads(body)
            repository = f"{wanted.get('organization')}/{wanted['name']}"
            self.server.files.setdefault(repository, {})
            self.answer(200, {"url": f"{self.server.address}/datasets/{repository}"})
        elif path == "/api/validate-yaml":
            self.answer(200, {"errors": [], "warnings": []})
        elif match := re.fullmatch(r"/api/datasets/(.+)/preupload/main", path):
            modes = [
                {
                    "path": file["path"],
                    "uploadMode": "lfs" if file["path"].endswith(LARGE) else "regular",
                    "shouldIgnore": False,
                }
                for file in json.loads(body)["files"]
            ]
            self.answer(200, {"files": modes})
        elif path.endswith(".git/info/lfs/objects/batch"):
            objects = [
                each | {"actions": {"upload": {"href": f"{self.server.storage}/objects/{each['oid']}"}}}
                for each in json.loads(body)["objects"]
            ]
            self.answer(200, {"transfer": "basic", "objects": objects})
        elif match := re.fullmatch(r"/api/datasets/(.+)/commit/main", path):
            for line in body.splitlines():
                operation = json.loads(line)
                value = operation["value"]
                if operation["key"] == "file":
                    self.server.files[match[1]][value["path"]] = base64.b64decode(value["content"])
                elif operation["key"] == "lfsFile":
                    self.server.files[match[1]][value["path"]] = self.server.objects[value["oid"]]
                elif operation["key"] == "deletedFile":
                    del self.server.files[match[1]][value["path"]]
            address = f"{self.server.address}/datasets/{match[1]}/commit/{self.sha}"
            self.answer(200, {"commitUrl": address, "commitOid": self.sha, "hookOutput": ""})
        else:
            self.answer(404, {"error": path})

    def do_PUT(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        oid = self.path.removeprefix("/objects/")
        if hashlib.sha256(content).hexdigest() == oid:
            self.server.objects[oid] = content
            self.answer(200, {})
        else:
            self.answer(400, {"error": "another checksum"})

    def give_repository(self, repository: str, revision: str) -> None:
        if repository not in self.server.files:
            self.answer(404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"})
        elif revision not in ("main", self.sha):
            self.answer(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
        else:
            names = [{"rfilename": name} for name in self.server.files[repository]]
            self.answer(200, {"id": repository, "sha": self.sha, "siblings": names, "private": False})

    def give_file(self, repository: str, name: str) -> None:
        content = self.server.files.get(repository, {}).get(name)
        if content is None:
            self.answer(404, {"error": "Entry not found"}, {"X-Error-Code": "EntryNotFound"})
            return
        sha256 = hashlib.sha256(content).hexdigest()
        headers = {"X-Repo-Commit": self.sha}
        if name.endswith(LARGE):
            headers |= {"X-Linked-Etag": f'"{sha256}"', "X-Linked-Size": str(len(content))}
            place = f"{self.server.storage}/objects/{repository}/{name}"
            self.answer(302, {}, headers | {"Location": place})
        else:
            self.give(name, content, headers | {"ETag": f'"{sha256}"'})

    def give(self, name: str, content: bytes, headers: dict[str, str]) -> None:
        headers |= {"Content-Length": str(len(content))}
        if self.server.cut.get(name, 0):
            self.server.cut[name] -= 1
            content = content[: len(content) // 2]
            self.close_connection = True
        self.send(200, content, headers)

    def answer(self, status: int, content: dict[str, Any], headers: dict[str, str] | None = None) -> None:
        body = json.dumps(content).encode()
        about = {"Content-Type": "application/json", "Content-Length": str(len(body))}
        self.send(status, body, about | (headers or {}))

    def send(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        return


def point_at(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What HF_ENDPOINT and HF_HUB_DISABLE_XET do when huggingface_hub is imported.

    With hf_xet, the client would upload by Xet's protocol alone, whatever the Hub answers.
    """
    template = f"{address}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", address)
    monkeypatch.setattr(huggingface_hub.constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)


@contextmanager
def serving(server: Hub, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The stand-in answers, and huggingface_hub asks it."""
    point_at(server.address, monkeypatch)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
