"""A server that speaks S3 on loopback, in a process of its own, with faults that a test asks for.

    python -m tests.makers.s3_server

Prints its port. `POST /faults {"fail": N, "stall": N, "stall_s": S}` makes the next N requests answer 503, the N after
them wait; `{"mix": [FAULT, ...], "every": N}` gives every N-th request the next of these faults, round and round:

    503, 500    an answer of that number, nothing done
    slow        done after `slow_s`
    stall       done after `stall_s`: where a client waits less, it may have asked again by then
    lost        done, and the connection closed without an answer

`GET /faults` says how many requests came, how many of each fault there were, and how many bytes the answers had.
"""

import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
BUCKET = "fleet"
ERRORS = {"503": ("503 Slow Down", "SlowDown"), "500": ("500 Internal Server Error", "InternalError")}
COUNTED = {"503": "failed", "500": "failed", "slow": "slowed", "stall": "stalled", "lost": "lost"}


class Faults:
    """WSGI middleware in front of moto."""

    def __init__(self, app):
        self.app, self.lock = app, threading.Lock()
        self.plan = {"fail": 0, "stall": 0, "stall_s": 0.0, "slow_s": 0.0, "every": 1, "mix": []}
        self.counts = {"requests": 0, "failed": 0, "stalled": 0, "slowed": 0, "lost": 0}
        self.counts |= {"bytes_sent": 0, "puts": 0, "gets": 0}

    def __call__(self, environ, start_response):
        if environ["PATH_INFO"] == "/faults":
            return self.control(environ, start_response)
        with self.lock:
            self.counts["requests"] += 1
            # As object stores bill: what writes or lists, and what reads.
            lists = environ["REQUEST_METHOD"] == "GET" and "list-type" in environ["QUERY_STRING"]
            self.counts["puts" if lists or environ["REQUEST_METHOD"] in ("PUT", "POST") else "gets"] += 1
            fault = self.fault()
        if fault in ERRORS:
            # The body must be read, or the connection ends before the client has sent it.
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            status, code = ERRORS[fault]
            start_response(status, [("Content-Type", "application/xml")])
            return [f"<Error><Code>{code}</Code></Error>".encode()]
        if fault in ("slow", "stall"):
            time.sleep(self.plan[f"{fault}_s"])

        def counted(status, headers, exc_info=None):
            with self.lock:
                is_get = environ["REQUEST_METHOD"] == "GET"
                self.counts["bytes_sent"] += is_get * int(dict(headers).get("Content-Length", 0))
            return start_response(status, headers, exc_info)

        answer = self.app(environ, counted)
        if fault == "lost":
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
        return answer

    def fault(self):
        """What becomes of this request, None where nothing does."""
        plan, counts = self.plan, self.counts
        if counts["requests"] % plan["every"]:
            return None
        fault = None
        if plan["mix"]:
            fault = plan["mix"][counts["requests"] // plan["every"] % len(plan["mix"])]
        for kind, named in (("fail", "503"), ("stall", "stall")):
            if fault is None and plan[kind] > 0:
                plan[kind] -= 1
                fault = named
        if fault is not None:
            counts[COUNTED[fault]] += 1
        return fault

    def control(self, environ, start_response):
        if environ["REQUEST_METHOD"] == "POST":
            asked = json.loads(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
            self.plan |= {"every": 1, "mix": []} | asked
        start_response("200 OK", [("Content-Type", "application/json")])
        return [json.dumps(self.counts).encode()]


def main():
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log_request(self, *_args):
            """Nothing."""

    app = Faults(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True, request_handler=Quiet)
    print(server.server_port, flush=True)
    server.serve_forever()


class S3:
    """A running server: where it is, and its faults."""

    def __init__(self, port):
        self.url = f"http://127.0.0.1:{port}"
        self.environment = {
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
            "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ALLOW_HTTP": "true",
        }

    def faults(self, **plan):
        """Ask for faults; the counts so far."""
        body = json.dumps(plan).encode() if plan else None
        with urllib.request.urlopen(urllib.request.Request(f"{self.url}/faults", body)) as answer:
            return json.load(answer)


@contextmanager
def running():
    """A server with an empty bucket, gone when the block ends."""
    environment = os.environ | {"PYTHONPATH": str(REPO), "AWS_EC2_METADATA_DISABLED": "true"}
    command = [sys.executable, "-m", "tests.makers.s3_server"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )
    try:
        s3 = S3(int(process.stdout.readline()))
        urllib.request.urlopen(urllib.request.Request(f"{s3.url}/{BUCKET}", method="PUT")).close()
        yield s3
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


if __name__ == "__main__":
    main()
