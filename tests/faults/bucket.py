"""An object store on this machine, by moto, that can be told to answer some share of its requests with an error.

python -m tests.faults.bucket: serves until its standard input ends; the first line it says is its address.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from typing import Any

_ERRORS = {
    "503": ("503 Service Unavailable", "ServiceUnavailable", "Service is unable to handle request."),
    "403": ("403 Forbidden", "InvalidAccessKeyId", "The Access Key Id you provided does not exist in our records."),
}

App = Callable[[dict[str, Any], Callable[..., Any]], Iterable[bytes]]


class Unsteady:
    """A WSGI application in front of another.

    PUT /_share/SEED/P/STATUS makes it answer a share P of all other requests with an error, one half of these after
    they took effect; its answer says how often it did so since it was last told. PUT /_conditions/HOW says how it
    takes conditions: as the standard has it, where 412 says it all ("standard"), or not at all ("ignored"); else as
    Amazon does.
    """

    def __init__(self, app: App) -> None:
        self._app, self._share, self._random, self._error = app, 0.0, random.Random(), _ERRORS["503"]
        self.n_failed, self._conditions = 0, ""

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        path = environ["PATH_INFO"]
        if path.startswith("/_share/"):
            seed, share, status = path.split("/")[2:]
            self._random.seed(seed)
            self._share, self._error = float(share), _ERRORS[status]
            start("200 OK", [])
            failed, self.n_failed = self.n_failed, 0
            return [str(failed).encode()]
        if path.startswith("/_conditions/"):
            self._conditions = path.split("/")[2].replace("amazon", "")
            start("200 OK", [])
            return [b""]
        if self._conditions and environ.pop("HTTP_IF_NONE_MATCH", None):
            return self._conditional_put(environ, start)
        chance = self._random.random()
        if chance >= self._share:
            return self._app(environ, start)
        self.n_failed += 1
        if chance < self._share / 2:  # it takes effect, and nobody is told
            b"".join(self._app(environ, lambda *answer: None))
        else:
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        status, code, words = self._error
        start(status, [("Content-Type", "text/xml")])
        return [f"<Error><Code>{code}</Code><Message>{words}</Message></Error>".encode()]

    def _conditional_put(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        look = {**environ, "REQUEST_METHOD": "HEAD", "CONTENT_LENGTH": "0", "wsgi.input": io.BytesIO()}
        statuses: list[str] = []
        b"".join(self._app(look, lambda status, *_: statuses.append(status)))
        if self._conditions == "ignored" or not statuses[0].startswith("200"):
            return self._app(environ, start)
        environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        start("412 Precondition Failed", [("Content-Type", "text/xml")])
        return [b"<Error><Code>PreconditionFailed</Code><Message>it is there</Message></Error>"]


def serve() -> None:
    """Serve until the standard input ends."""
    import logging
    import threading

    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    app = Unsteady(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True)
    print(f"http://127.0.0.1:{server.server_port}", flush=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdin.read()
    os._exit(0)


@contextlib.contextmanager
def bucket(name: str = "bucket") -> Iterator[str]:
    """A server with one bucket, found by whatever asks S3 in this process and its children; its address."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.faults.bucket"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        address = process.stdout.readline().strip()
        settings = {
            "AWS_ENDPOINT_URL": address,
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_MAX_ATTEMPTS": "1",  # the library's own patience, which takes seconds, is not what is tested
        }
        before = dict(os.environ)
        os.environ.update(settings)
        try:
            ask(f"{address}/{name}", "PUT")
            yield address
        finally:
            os.environ.clear()
            os.environ.update(before)
            process.stdin.close()


def ask(url: str, method: str = "GET") -> bytes:
    """What the server answers to a plain request."""
    signed = {"Authorization": "AWS4-HMAC-SHA256 Credential=key/20260101/us-east-1/s3/aws4_request"}
    with urllib.request.urlopen(urllib.request.Request(url, method=method, headers=signed)) as answer:
        return answer.read()


if __name__ == "__main__":
    serve()
