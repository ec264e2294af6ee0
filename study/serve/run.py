"""``softgrasp serve``: a certified model behind HTTP, on this machine alone unless another address is named."""

from __future__ import annotations

import ipaddress
import json
import socket
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import h5py
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem import SceneError
from softgrasp.fem.errors import shortened
from softgrasp.reduction import load_certified
from softgrasp.study.serve.protocol import KEYS, MODELS, Served, allowed

LARGEST = 50_000_000  # byte of a request
OTHERS = ("HEAD", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT")  # methods of HTTP beside GET and POST
PATIENCE = 30.0  # time that a client may take for its request [s]


def served_model(path: Path, inputs: str) -> Served:
    """A certified model with the parameters that vary. Raises SceneError: file or names are wrong."""
    names = tuple(name.strip() for name in inputs.split(","))
    if set(names) - set(KEYS) or len(set(names)) < len(names):
        raise SceneError(f"--inputs {shortened(inputs)}: give some of {', '.join(KEYS)}, each once")
    if not (path.is_file() and h5py.is_hdf5(path)):
        raise SceneError(f"{path}: name the certified model that softgrasp reduce SCENE --tolerance wrote")
    model = load_certified(path)
    if model.drive is None:
        raise SceneError(f"{path} has no motion; reduce its scene again")
    return Served(model, model.drive, names)


def make_server(served: Served, host: str, port: int) -> HTTPServer:
    """A server that answers one request after the other. Raises SceneError: the address cannot be used."""

    class Handler(BaseHTTPRequestHandler):
        timeout = PATIENCE

        def do_GET(self) -> None:
            self._reply(*served.answer("GET", self.path, {}))

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdecimal() or int(length) > LARGEST:
                self._refuse(f"the request must say its length, at most {LARGEST} bytes")
                return
            try:
                body = json.loads(self.rfile.read(int(length)))
            except (ValueError, RecursionError):
                self._refuse("the request is no JSON")
                return
            self._reply(*served.answer("POST", self.path, body))

        def _other(self) -> None:
            self._reply(*served.answer(self.command, self.path, {}))

        def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
            """What is no HTTP, or a method that HTTP does not have, as the protocol answers."""
            text = message or explain or str(code)
            self._reply(code, {"error": {"type": "InvalidInput", "message": text}})

        def _refuse(self, text: str) -> None:
            self._reply(400, {"error": {"type": "InvalidInput", "message": text}})

        def _reply(self, status: int, answer: dict[str, object]) -> None:
            data = json.dumps(answer).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            if status == HTTPStatus.METHOD_NOT_ALLOWED:
                self.send_header("Allow", ", ".join(allowed(self.path)))
            if status != HTTPStatus.OK:  # the rest of the request was not read
                self.send_header("Connection", "close")
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

        def log_message(self, *_: object) -> None:
            """No line for each request."""

    for method in OTHERS:
        setattr(Handler, f"do_{method}", Handler._other)

    class Server(HTTPServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

    try:
        return Server((host, port), Handler)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise SceneError(f"--host {host} --port {port}: {why}; choose another address or port") from None


def is_local(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def run_serve(path: Path, console: Console, *, host: str, port: int, inputs: str) -> None:
    """Answer requests until Ctrl-C, see ``softgrasp serve --help``. On one rank.

    Raises SceneError: file, address or names are wrong, or there are several ranks.
    """
    if MPI.COMM_WORLD.size > 1:
        raise SceneError("serve answers on one rank; start it without mpiexec")
    served = served_model(path, inputs)
    with make_server(served, host, port) as server:
        at = f"http://{f'[{host}]' if ':' in host else host}:{server.server_port}"
        names = served.model.fine.outputs.names
        console.print(
            f"{at}: models {' and '.join(MODELS)}; input {', '.join(served.inputs)}; output {', '.join(names)} at "
            f"{served.drive.steps + 1} instants; bounds are {served.bounds_are}; Ctrl-C ends",
            soft_wrap=True, markup=False, highlight=False,
        )  # fmt: skip
        if not is_local(host):
            console.print("warning: other machines reach this address, and nothing asks who they are", style="yellow")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            console.print("ended")
