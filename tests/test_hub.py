"""Models go to the Hugging Face Hub, here a server of ours, and come back by the zoo's commands."""

import base64
import json
import os
import subprocess
import sys
import threading
from hashlib import sha1
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("huggingface_hub")

pytestmark = pytest.mark.expensive
COMMIT = "0" * 40
AGENT = ("--algo", "droq", "--env", "Pendulum-v1")


class Hub(BaseHTTPRequestHandler):
    """What huggingface_hub asks of https://huggingface.co for one repository, kept in memory."""

    protocol_version = "HTTP/1.1"
    files: dict[str, bytes]

    def log_message(self, *_):
        pass

    def answer(self, content, code=200, **headers):
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(code)
        told = {"Content-Length": str(len(body)), "Content-Type": "application/json", **headers}
        for name, value in told.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self):
        sent = self.rfile.read(int(self.headers["Content-Length"])).decode()
        if self.path.endswith("/repos/create"):
            self.answer({"url": f"http://{self.headers['Host']}/me/droq-Pendulum-v1"})
        elif "/preupload/" in self.path:
            told = [
                {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False}
                for file in json.loads(sent)["files"]
            ]
            self.answer({"files": told})
        elif "/commit/" in self.path:
            for line in map(json.loads, sent.splitlines()):
                if line["key"] == "file":
                    content = base64.b64decode(line["value"]["content"])
                    self.files[line["value"]["path"]] = content
            url = f"http://{self.headers['Host']}/me/droq-Pendulum-v1/commit/{COMMIT}"
            self.answer({"commitUrl": url, "commitOid": COMMIT, "commitMessage": ""})
        else:
            self.answer({"errors": [], "warnings": []})

    def do_GET(self):
        if "/tree/" in self.path:
            self.answer(
                [
                    {"type": "file", "path": name, "size": len(content), "oid": _tag(content)}
                    for name, content in self.files.items()
                ]
            )
            return
        if self.path.startswith("/api/"):
            files = [{"rfilename": name} for name in self.files]
            self.answer({"id": "me/droq-Pendulum-v1", "sha": COMMIT, "siblings": files})
            return
        content = self.files.get(self.path.partition("/resolve/")[2].partition("/")[2])
        if content is None:
            self.answer(b"", 404, X_Error_Code="EntryNotFound", X_Repo_Commit=COMMIT)
        else:
            self.answer(content, X_Repo_Commit=COMMIT, ETag=f'"{_tag(content)}"')

    do_HEAD = do_GET  # noqa: N815


def _tag(content: bytes) -> str:
    return sha1(content).hexdigest()


@pytest.fixture
def hub():
    files = {".gitattributes": b"*.zip filter=lfs diff=lfs merge=lfs -text\n"}
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("OurHub", (Hub,), {"files": files}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", files
    server.shutdown()
    server.server_close()


def zoo(folder: Path, command: str, *options: str, **environ: str) -> subprocess.CompletedProcess:
    words = (sys.executable, "-m", f"rl_zoo3.{command}", *AGENT, *map(str, options))
    own = {"HF_HOME": str(folder / "cache"), "HF_HUB_DISABLE_TELEMETRY": "1"}
    given = {"cwd": folder, "env": os.environ | own | environ, "text": True, "timeout": 300}
    return subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **given)


def test_a_model_of_ours_is_pushed_to_the_hub_loaded_and_replayed(hub, tmp_path):
    endpoint, files = hub
    few = ("learning_starts:10", "gradient_steps:2", "policy_kwargs.net_arch:[8]")
    trained = zoo(tmp_path, "train", "-f", "logs", "-n", "20", "--eval-freq", "10", "-params", *few)
    assert trained.returncode == 0, trained.stdout[-4000:]

    pushed = zoo(
        tmp_path, "push_to_hub", "-f", "logs", "-orga", "me", "--no-render", HF_ENDPOINT=endpoint
    )
    assert pushed.returncode == 0, pushed.stdout[-4000:]
    assert {"droq-Pendulum-v1.zip", "args.yml", "config.yml", "README.md"} <= set(files)
    card = files["README.md"].decode()
    assert "**DroQ** Agent playing **Pendulum-v1**" in card and "mean_reward" in card

    trusted = {"HF_ENDPOINT": endpoint, "TRUST_REMOTE_CODE": "True"}
    loaded = zoo(tmp_path, "load_from_hub", "-f", "here", "-orga", "me", **trusted)
    assert loaded.returncode == 0, loaded.stdout[-4000:]
    back = tmp_path / "here" / "droq" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    assert back.read_bytes() == files["droq-Pendulum-v1.zip"]
    shown = zoo(tmp_path, "enjoy", "-f", "here", "--no-render", "-n", "200")
    assert shown.returncode == 0 and "Mean reward" in shown.stdout, shown.stdout[-4000:]


def test_without_a_network_the_hub_says_so(tmp_path):
    loaded = zoo(
        tmp_path,
        "load_from_hub",
        *("-f", "here", "-orga", "me"),
        HF_HUB_OFFLINE="1",
        TRUST_REMOTE_CODE="True",
    )
    assert loaded.returncode and "check your connection" in loaded.stdout
