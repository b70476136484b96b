"""Models behind a UM-Bridge server as responses.

The protocol: https://um-bridge-benchmarks.readthedocs.io, version 1.0.
"""

from __future__ import annotations

import base64
import json
import os
import re
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote

import numpy as np
import urllib3
from urllib3.connection import HTTPConnection
from urllib3.exceptions import HTTPError, LocationParseError, ProtocolError, ReadTimeoutError

from prbayes._finding import Finding, report
from prbayes._validate import Floats, plain_text, positive_number, wrong_value
from prbayes.response.call import scalar
from prbayes.response.outputs import Outputs


def umbridge(
    url: str,
    name: str = "forward",
    *,
    config: Mapping[str, Any] | None = None,
    timeout: float | None = None,
    patience: float = 60.0,
) -> scalar:
    """Turn a model behind a UM-Bridge server into a response, of one output or several.

    The names and sizes of the server's models are requested at once. A `Simulator` compares them
    with its inputs and with ``observed`` before anything is computed.

    Parameters
    ----------
    url : str
        Address of the server, such as ``"http://localhost:4242"``. A name and a password in it
        are sent (HTTP Basic), and a query is kept; messages show neither.
    name : str
        Name of one of its models.
    config : mapping, optional
        Settings that are passed to the model with each request, as JSON.
    timeout : float, optional
        Seconds to wait for a response, in the server's queue as well. By default there is no limit
        as long as the server's machine answers.
    patience : float
        Seconds to wait for a server that went away before the response fails.

    Returns
    -------
    callable
        The response, to be passed to `Simulator`, `Surrogate.fit` or `predict`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or the server has no such model.
    ConnectionError
        If there is no server, or its answers are none of UM-Bridge.

    Notes
    -----
    The numbers of all inputs, one after the other, fill the model's input vectors; those of one
    input stay in one vector. The model's output vectors, one after the other, are the outputs; a
    model with a single number gives one. NaN is no response, inf a specimen that failed.

    The server computes, so threads serve as an executor: as many as it has workers. Connections
    are reused. A request whose connection is lost is sent again, twice at most, as soon as the
    server is back; the propagation's ``on_failure`` decides on a final failure. A late response is
    abandoned, although the server may continue to compute it. The response can be pickled, with
    the password in it.

    Examples
    --------
    A server with one model, which returns twice its first number and the sum of both:

    >>> import json
    >>> import threading
    >>> from http.server import BaseHTTPRequestHandler, HTTPServer
    >>> class Twice(BaseHTTPRequestHandler):
    ...     def answer(self):
    ...         text = self.rfile.read(int(self.headers.get("Content-Length", 0)))
    ...         ((x, y),) = json.loads(text).get("input", [[1, 1]]) if text else [[1, 1]]
    ...         known = {
    ...             "/Info": {"protocolVersion": 1.0, "models": ["forward"]},
    ...             "/ModelInfo": {"support": {"Evaluate": True}},
    ...             "/InputSizes": {"inputSizes": [2]},
    ...             "/OutputSizes": {"outputSizes": [2]},
    ...             "/Evaluate": {"output": [[2 * x, x + y]]},
    ...         }
    ...         body = json.dumps(known[self.path]).encode()
    ...         self.send_response(200)
    ...         self.send_header("Content-Length", str(len(body)))
    ...         self.end_headers()
    ...         self.wfile.write(body)
    ...
    ...     do_GET = do_POST = answer
    ...
    ...     def log_message(self, *_):
    ...         pass
    >>> with HTTPServer(("127.0.0.1", 0), Twice) as server:
    ...     thread = threading.Thread(target=server.serve_forever)
    ...     thread.start()
    ...     response = umbridge(f"http://127.0.0.1:{server.server_port}")
    ...     response([1.0, 2.0], 5.0)
    ...     server.shutdown()
    array([[2., 6.],
           [4., 7.]])
    """
    address = _address(url)
    limit = None if timeout is None else positive_number(timeout, "umbridge: timeout")
    patience = positive_number(patience, "umbridge: patience")
    request = {"name": plain_text(name, "umbridge: name"), "config": _plain_config(config)}
    version = _requested(address, "/Info", None, "protocolVersion")
    models = _requested(address, "/Info", None, "models")
    if version != 1.0:
        raise ValueError(
            f"umbridge: url: got a server that speaks version {version} of the protocol at "
            f"{address}, expected 1.0"
        )
    if name not in models:
        raise ValueError(
            f"umbridge: name: got {name!r}, expected one of those that the server at "
            f"{address} has: {', '.join(map(repr, models)) or 'none'}"
        )
    support = _requested(address, "/ModelInfo", {"name": name}, "support")
    if not support.get("Evaluate"):
        raise ValueError(
            f"umbridge: name: got {name!r}, which the server at {address} cannot evaluate, "
            "expected a model that supports Evaluate"
        )
    inputs = _requested(address, "/InputSizes", request, "inputSizes")
    outputs = _requested(address, "/OutputSizes", request, "outputSizes")
    config_text = json.dumps(request["config"])
    return scalar(
        RemoteModel(address, name, config_text, tuple(inputs), tuple(outputs), limit, patience)
    )


@dataclass(frozen=True)
class Address:
    """The address of a server; user, password and query are sent, but never shown."""

    shown: str  # address without secrets
    user: str = field(default="", repr=False)  # name and password, with a colon between
    query: str = field(default="", repr=False)

    def __str__(self) -> str:
        """Return the address without user, password and query."""
        return self.shown

    @property
    def headers(self) -> dict[str, str]:
        """The authorization of the user (RFC 7617)."""
        if not self.user:
            return {}
        return {"Authorization": f"Basic {base64.b64encode(self.user.encode()).decode()}"}

    def of(self, path: str) -> str:
        """Return the address of a path of the server."""
        return f"{self.shown}{path}?{self.query}" if self.query else self.shown + path


def _address(url: object) -> Address:
    """Return the address of a server, or raise if it is none."""
    text = plain_text(url, "umbridge: url")
    try:
        parts = urllib3.util.parse_url(text)
    except LocationParseError:
        parts = urllib3.util.Url()
    is_plain = text.isprintable() and " " not in text and not parts.fragment
    if parts.scheme not in ("http", "https") or not parts.host or parts.port == 0 or not is_plain:
        shown = re.sub(r"^(\w+://)?.*@", r"\1...@", text, flags=re.DOTALL).partition("?")[0]
        raise ValueError(
            f"umbridge: url: got {shown!r}, expected the address of a server, such as "
            "'http://localhost:4242', without blanks, line ends or a fragment"
        )
    name, _, password = (parts.auth or "").partition(":")
    user = f"{unquote(name)}:{unquote(password)}" if parts.auth else ""
    path = (parts.path or "").rstrip("/")
    shown = urllib3.util.Url(parts.scheme, None, parts.host, parts.port, path).url
    return Address(shown, user, parts.query or "")


def _plain_config(config: object) -> Any:
    """Return the settings of a model in the types of JSON."""
    reason = ""
    if config is None or isinstance(config, Mapping):
        try:
            return json.loads(json.dumps(dict(config or {})))
        except (TypeError, ValueError) as error:
            reason = f" ({error})"
    raise wrong_value(
        config,
        "umbridge: config",
        "a mapping of settings to values that "
        f'can be written as JSON, such as {{"level": 2}}: texts, numbers, lists{reason}',
    )


@dataclass(frozen=True)
class RemoteModel:
    """A model behind a server as a function of one specimen's inputs."""

    address: Address
    model: str
    config: str  # settings of the model, as JSON
    inputs: tuple[int, ...]  # sizes of the model's input vectors
    outputs: tuple[int, ...]  # sizes of its output vectors
    timeout: float | None
    patience: float

    @property
    def __name__(self) -> str:
        """The name of the model."""
        return self.model

    def __call__(self, *inputs: Any) -> float | Floats:
        """Return the outputs of one specimen: a number, or an array of them, shape (m,)."""
        parts = [np.ravel(x).astype(np.float64) for x in inputs]
        self._refuse_inputs(self.model, [part.size for part in parts])
        vectors = np.split(np.concatenate(parts), np.cumsum(self.inputs)[:-1])
        request = {
            "name": self.model,
            "input": [vector.tolist() for vector in vectors],
            "config": json.loads(self.config),
        }
        output = self._answer(request)
        try:
            answers = [np.array(vector, np.float64) for vector in output]  # null becomes NaN
        except (TypeError, ValueError):
            answers = []
        if [vector.shape for vector in answers] != [(size,) for size in self.outputs]:
            raise RuntimeError(
                f"{self.model}: got output = {output!r:.300}, expected vectors of numbers, of "
                f"sizes {list(self.outputs)}"
            )
        values = np.concatenate(answers)
        return values if values.size > 1 else float(values[0])

    def _answer(self, request: Any) -> Any:
        """Return the output for one specimen, from a server that may be away for a while."""
        n_lost, give_up_at, pause = 0, 0.0, 0.1
        while True:
            try:
                status, text = _exchange(self.address, "/Evaluate", request, self.timeout)
                if status not in (502, 503):  # a gateway answers so while its server is away
                    return _read_answer(self.model, status, text, "output")
                reason = f"it answered {status}"
            except TimeoutError:
                raise TimeoutError(
                    f"{self.model}: no response within timeout = {self.timeout:g} s from "
                    f"{self.address}"
                ) from None
            except ProtocolError as error:
                # The connection was lost after the request was sent, so that this specimen may
                # have ended the server.
                n_lost, give_up_at, pause, reason = n_lost + 1, 0.0, 0.1, str(error)
                if n_lost == 3:
                    raise ConnectionError(
                        f"{self.model}: the connection to the server at {self.address} was lost 3 "
                        f"times during this specimen ({reason})"
                    ) from None
            except (HTTPError, OSError) as error:
                reason = f"{type(error).__name__}: {error}"
            if not give_up_at:
                give_up_at = time.monotonic() + self.patience
                text = (
                    f"{self.model}: the server at {self.address} does not answer ({reason}); "
                    "waiting."
                )
                report(Finding("server-away", text))
            if time.monotonic() > give_up_at:
                raise ConnectionError(
                    f"{self.model}: the server at {self.address} has not answered for more than "
                    f"patience = {self.patience:g} s ({reason})"
                )
            time.sleep(pause)
            pause = min(2 * pause, 2.0)

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Outputs | None) -> None:
        """Raise if a simulator has other inputs or outputs than the model."""
        self._refuse_inputs(name, sizes)
        m = sum(self.outputs)
        event = () if m == 1 else (m,)
        if outputs is not None and outputs.event != event:
            got, expected = (str(("N", *e)).replace("'", "") for e in (outputs.event, event))
            raise ValueError(
                f"{name}: observed: got shape {got}, expected {expected}, a number for each "
                f"output: the model {self.model!r} at {self.address} has outputs of sizes "
                f"{list(self.outputs)}"
            )

    def _refuse_inputs(self, name: str, sizes: Sequence[int]) -> None:
        """Raise if inputs do not fill the model's vectors, or one would be split between two."""
        reason = f"{sum(self.inputs)} in all"
        if sum(sizes) == sum(self.inputs):
            ends = np.cumsum(self.inputs)
            last = np.cumsum(sizes)
            first = last - np.asarray(sizes)
            is_cut = ((first[:, None] < ends) & (ends < last[:, None])).any(axis=1)
            if not is_cut.any():
                return
            reason = f"input {int(is_cut.argmax()) + 1} would be cut in two"
        raise ValueError(
            f"{name}: got inputs of {', '.join(map(str, sizes))} numbers, expected inputs that "
            f"fill vectors of sizes {list(self.inputs)} one after the other ({reason}), as the "
            f"model {self.model!r} at {self.address} requires; pass other inputs, or another order"
        )


# -- requests --------------------------------------------------------------------------------------


def _new_pool() -> urllib3.PoolManager:
    """Return a pool of connections that detect a dead machine within two minutes."""
    options = [*HTTPConnection.default_socket_options, (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)]
    for option, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, option):
            options.append((socket.IPPROTO_TCP, getattr(socket, option), value))
    return urllib3.PoolManager(maxsize=64, retries=False, socket_options=options)


_pool = _new_pool()
_inherited: list[urllib3.PoolManager] = []


def _renew_pool() -> None:
    """Use new connections after a fork, because the old ones belong to the parent process."""
    global _pool
    _inherited.append(_pool)
    _pool = _new_pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_pool)


def _requested(address: Address, path: str, request: Any, key: str) -> Any:
    """Return a value of an answer about the model; raise if no such server answers."""
    try:
        return _read_answer(path, *_exchange(address, path, request, 60.0), key)
    except RuntimeError as error:
        raise ConnectionError(
            f"umbridge: url: got {address}, where something else answers ({error!s:.400}), "
            "expected a server of UM-Bridge"
        ) from None
    except (OSError, HTTPError) as error:
        raise ConnectionError(
            f"umbridge: url: got {address}, where no server answers {path} ({error}), expected one "
            "that runs; start it, and look at its port"
        ) from None


def _exchange(address: Address, path: str, request: Any, seconds: float | None) -> tuple[int, str]:
    """Return status and text of an answer; `ProtocolError` if it is lost after the request."""
    try:
        response = _pool.request(
            "GET" if request is None else "POST",
            address.of(path),
            json=request,
            headers=address.headers,
            timeout=urllib3.Timeout(connect=10.0, read=seconds),
        )
    except ReadTimeoutError as error:
        # If the system reports that the machine is gone, the error has a number.
        if getattr(error.__cause__, "errno", None) is not None:
            raise ProtocolError(str(error.__cause__)) from None
        raise TimeoutError(f"not within {seconds:g} s") from None
    return response.status, response.data.decode("utf-8", "replace")


def _read_answer(name: str, status: int, text: str, key: str) -> Any:
    """Return the value of a key of an answer in JSON, or raise `RuntimeError` with its error."""
    words = {"nan": "NaN", "inf": "Infinity"}  # servers in Python may write nan and inf
    answer = None
    for form in (text, re.sub(r"\b(?:nan|inf)\b", lambda word: words[word[0]], text)):
        try:
            answer = json.loads(form)
            break
        except ValueError:
            pass
    error = answer.get("error") if isinstance(answer, dict) else None
    if error:  # servers may send an empty text, or false, beside a result
        if isinstance(error, dict):
            error = f"{error.get('type')}: {error.get('message')}"
        raise RuntimeError(f"{name}: the server answered {error!s:.1000}")
    if status != 200 or not isinstance(answer, dict) or key not in answer:
        log = "; what its model raised is in its own log" if status == 500 else ""
        raise RuntimeError(
            f"{name}: the server answered {status}, {text.strip()!r:.300}, expected a result "
            f"with {key!r}{log}"
        )
    return answer[key]
