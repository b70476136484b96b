"""A model behind an UM-Bridge server: a response that is asked for over the network.

The protocol (https://um-bridge-benchmarks.readthedocs.io, version 1.0) is a few questions in JSON
over HTTP. They are asked here with the standard library: `umbridge.HTTPModel` opens a connection
for each request, has no time limits, and does not try again.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from prbayes._finding import Finding, report
from prbayes._validate import Floats, called, plain_text, positive_number
from prbayes.response.call import scalar
from prbayes.response.outputs import Outputs

# Seconds for a connection to be made: by judgement, longer than any network takes.
_CONNECTING = 10.0
# Seconds for what a server knows without its model: names and sizes. By judgement, as the model may
# be at work beside it.
_KNOWN_AT_ONCE = 60.0
# So often a specimen is sent again whose connection was lost meanwhile, as it may be the specimen
# that ends the server; other outages of a study are hardly more at one specimen. By judgement.
_SENT_AGAIN = 2
# Seconds before a server that is away is tried again, at first and at most: short against the start
# of a server, long against a try.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 2.0
# Characters of an answer that an error repeats: its first lines say what it is.
_QUOTED = 300
# What stands in front of a server that is away answers so: bad gateway, service unavailable.
_AWAY = frozenset({502, 503})


def umbridge(
    url: str,
    model: str = "forward",
    *,
    config: Mapping[str, Any] | None = None,
    timeout: float | None = None,
    patience: float = 60.0,
) -> scalar:
    """Turn a model behind an UM-Bridge server into a response, of one output or several.

    The server is asked for its models and their sizes at once; a `Simulator` compares these with
    its inputs and with what was observed before anything is computed.

    Parameters
    ----------
    url : str
        Address of the server, such as ``"http://localhost:4242"``.
    model : str
        Name of one of its models.
    config : mapping, optional
        Passed to the model with each request: what can be written as JSON.
    timeout : float, optional
        Seconds that one response may take, its wait for a turn at the server included. Without it
        one waits as long as the server's machine is there.
    patience : float
        Seconds that one waits for a server that went away before the response fails.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or the server has no such model.
    ConnectionError
        If there is no server, or what answers is none of UM-Bridge.

    Notes
    -----
    The numbers of all inputs, one after the other, fill the model's input vectors; those of one
    input stay in one vector. The model's output vectors, one after the other, are the outputs; a
    model with a single number gives one. NaN is no response, inf a specimen that failed.

    The server computes, so that threads serve as an executor: as many as it has workers. Each
    keeps its connection. A request whose connection is lost is sent again, twice at most, as soon
    as the server is back; what fails in the end is left to the propagation's ``on_failure``. A
    response that takes too long is given up; whether the server goes on with it is its own affair.
    The response can be pickled, and opens connections of its own wherever it is.

    Examples
    --------
    A server that has one model, and gives twice its first number and the sum of both:

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
    server = _Server(
        plain_text(url, "umbridge: url").rstrip("/"),
        None if timeout is None else positive_number(timeout, "umbridge: timeout"),
        positive_number(patience, "umbridge: patience"),
    )
    server.refuse_malformed()
    asked = {"name": plain_text(model, "umbridge: model"), "config": _config(config)}
    server.refuse_strange(model)
    sizes = []
    for path, key in (("/InputSizes", "inputSizes"), ("/OutputSizes", "outputSizes")):
        sizes.append(_sizes(server.asked(path, asked).get(key), model, key))
    return scalar(RemoteModel(server, model, json.dumps(asked["config"]), *sizes))


def _config(config: object) -> Any:
    """Return what is passed to the model, of plain types."""
    if config is not None and not isinstance(config, Mapping):
        raise TypeError(
            f"umbridge: config: got {called(config)}, expected a mapping of settings to values, "
            'such as {"level": 2}'
        )
    try:
        return json.loads(json.dumps({} if config is None else dict(config)))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"umbridge: config: got {called(config)}, expected what can be written as JSON: "
            f"texts, numbers, lists and mappings of these ({error})"
        ) from None


def _sizes(found: object, model: str, key: str) -> tuple[int, ...]:
    """Return the sizes of a model's vectors, as the server tells them."""
    whole = isinstance(found, list) and all(isinstance(n, int) and n >= 0 for n in found)
    if not isinstance(found, list) or not whole or sum(found) == 0:
        raise ValueError(
            f"umbridge: got {key} = {found!r:.100} of the model {model!r}, expected the sizes of "
            "its vectors, such as [2]; look at the server"
        )
    return tuple(found)


@dataclass(frozen=True)
class RemoteModel:
    """A model behind a server as a function of one specimen's inputs."""

    server: _Server
    model: str
    config: str  # as JSON
    inputs: tuple[int, ...]  # sizes of the model's input vectors
    outputs: tuple[int, ...]

    @property
    def __name__(self) -> str:
        """The name of the model."""
        return self.model

    def __call__(self, *inputs: Any) -> float | Floats:
        """Return the outputs of one specimen: a number, or an array of them, shape (m,).

        Raises
        ------
        ConnectionError
            If the server is away for longer than one waits, or goes away with this specimen.
        TimeoutError
            If it takes too long.
        RuntimeError
            If the server or the model says that something went wrong, or returns no numbers.
        ValueError
            If the inputs do not fit the model's vectors.
        """
        parts = [np.ravel(x).astype(np.float64) for x in inputs]
        self._refuse_inputs(self.model, [part.size for part in parts])
        ends = np.cumsum(self.inputs)[:-1]
        numbers = np.concatenate(parts)
        vectors = [vector.tolist() for vector in np.split(numbers, ends)]
        config = json.loads(self.config)
        asked = {"name": self.model, "input": vectors, "config": config}
        answer = self.server.evaluated(asked)
        values = self._read(answer.get("output"))
        return values if sum(self.outputs) > 1 else float(values[0])

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Outputs | None) -> None:
        """Raise if a simulator has other inputs or outputs than the model."""
        self._refuse_inputs(name, sizes)
        m = sum(self.outputs)
        event = () if m == 1 else (m,)
        if outputs is not None and outputs.event != event:
            raise ValueError(
                f"{name}: observed: got shape {_shape(outputs.event)}, expected {_shape(event)}, a "
                f"number for each output: the model {self.model!r} at {self.server.url} has "
                f"outputs of sizes {list(self.outputs)}"
            )

    def _refuse_inputs(self, name: str, sizes: Sequence[int]) -> None:
        """Raise if inputs do not fill the model's vectors, or one would be cut in two."""
        why = f"{sum(self.inputs)} in all"
        if sum(sizes) == sum(self.inputs):
            cut = _cut(self.inputs, sizes)
            if cut is None:
                return
            why = f"input {cut + 1} would be cut in two"
        raise ValueError(
            f"{name}: got inputs of {', '.join(map(str, sizes))} numbers, expected such as fill "
            f"vectors of sizes {list(self.inputs)} one after the other ({why}), which the model "
            f"{self.model!r} at {self.server.url} has; pass other inputs, or in another order"
        )

    def _read(self, found: object) -> Floats:
        """Return the numbers of the output vectors, one after the other."""
        try:
            vectors = [np.asarray(vector, dtype=np.float64) for vector in found]  # type: ignore[attr-defined]
            sizes = tuple(vector.size for vector in vectors)
            if sizes == self.outputs and all(vector.ndim == 1 for vector in vectors):
                return np.concatenate(vectors)
        except (TypeError, ValueError):
            pass
        raise RuntimeError(
            f"{self.model}: got {found!r:.{_QUOTED}}, expected vectors of numbers, of sizes "
            f"{list(self.outputs)}"
        )


def _shape(event: tuple[int, ...]) -> str:
    """Return the shape of what is observed, for messages."""
    return f"({', '.join(['N', *map(str, event)])}{'' if event else ','})"


def _cut(vectors: Sequence[int], inputs: Sequence[int]) -> int | None:
    """Return the first input that lies on both sides of a vector's end, None if there is none."""
    ends = np.cumsum(vectors)
    first = 0
    for i, size in enumerate(inputs):
        last = first + size
        if ((first < ends) & (ends < last)).any():
            return i
        first = last
    return None


# -- what is said ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Server:
    """An UM-Bridge server, and how long one waits for it."""

    url: str
    timeout: float | None
    patience: float

    def refuse_malformed(self) -> None:
        """Raise if the address is none."""
        try:
            parts = urlsplit(self.url)
            well = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
        except ValueError:
            well = None
        if not well:
            raise ValueError(
                f"umbridge: url: got {self.url!r}, expected the address of a server, such as "
                "'http://localhost:4242'"
            )

    def refuse_strange(self, model: str) -> None:
        """Raise if there is no server, or none of UM-Bridge, or it has no such model."""
        try:
            found = self.asked("/Info", None)
            version = found["protocolVersion"]
            models = [str(name) for name in found["models"]]
        except (RuntimeError, KeyError, TypeError) as error:
            raise ConnectionError(
                f"umbridge: url: got {self.url}, where something else answers ({error!s:.200}), "
                "expected a server of UM-Bridge"
            ) from None
        if version != 1.0:
            raise ValueError(
                f"umbridge: url: got a server that speaks version {version} of the protocol at "
                f"{self.url}, expected 1.0"
            )
        if model not in models:
            raise ValueError(
                f"umbridge: model: got {model!r}, expected one of those that the server at "
                f"{self.url} has: {', '.join(map(repr, models)) or 'none'}"
            )
        if not self.asked("/ModelInfo", {"name": model}).get("support", {}).get("Evaluate"):
            raise ValueError(
                f"umbridge: model: got {model!r}, which the server at {self.url} cannot evaluate, "
                "expected a model that supports Evaluate"
            )

    def asked(self, path: str, body: Any) -> dict[str, Any]:
        """Return what the server knows at once; it has to be there."""
        try:
            return _read(path, *_sent(self.url, path, body, _KNOWN_AT_ONCE))
        except (OSError, _LostError) as error:
            raise ConnectionError(
                f"umbridge: url: got {self.url}, where no server answers {path} "
                f"({error}), expected one that runs; start it, and look at "
                "its port"
            ) from None

    def evaluated(self, body: Any) -> dict[str, Any]:
        """Return the answer for one specimen, from a server that may be away for a while.

        A specimen may be sent again: a server keeps nothing of it.
        """
        name = body["name"]
        lost = 0
        until = 0.0
        pause = _FIRST_PAUSE
        while True:
            try:
                status, text = _sent(self.url, "/Evaluate", body, self.timeout)
                if status not in _AWAY:
                    return _read(name, status, text)
                why = f"it answered {status}"
            except TimeoutError:
                raise TimeoutError(
                    f"{name}: no response within timeout = {self.timeout:g} s from {self.url}"
                ) from None
            except _LostError as error:
                lost = lost + 1
                until = 0.0
                pause = _FIRST_PAUSE
                why = str(error)
                if lost > _SENT_AGAIN:
                    raise ConnectionError(
                        f"{name}: the server at {self.url} was lost {lost} times while it was at "
                        f"work on this specimen ({why})"
                    ) from None
            except OSError as error:
                why = f"{type(error).__name__}: {error}"
            if not until:
                until = time.monotonic() + self.patience
                text = f"{name}: the server at {self.url} is away ({why}); waiting."
                report(Finding("server-away", text))
            if time.monotonic() > until:
                raise ConnectionError(
                    f"{name}: the server at {self.url} is away for more than patience = "
                    f"{self.patience:g} s ({why})"
                )
            time.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE)


def _read(name: str, status: int, text: str) -> dict[str, Any]:
    """Return an answer, read from JSON.

    Raises
    ------
    RuntimeError
        If it is none, or tells an error.
    """
    try:
        found = json.loads(text)
    except ValueError:
        try:
            # Servers in Python write NaN and inf as Python does.
            found = json.loads(_WORDS.sub(lambda word: _JSON_WORDS[word[0]], text))
        except ValueError:
            found = None
    if isinstance(found, dict) and "error" in found:
        error = found["error"]
        if isinstance(error, dict):
            error = f"{error.get('type')}: {error.get('message')}"
        raise RuntimeError(f"{name}: the server answered {error!s:.1000}")
    if status != http.client.OK or not isinstance(found, dict):
        raise RuntimeError(
            f"{name}: the server answered {status}, {text.strip()!r:.{_QUOTED}}, expected a result"
            f"{'; what its model raised is in its own log' if status == 500 else ''}"
        )
    return found


_JSON_WORDS = {"nan": "NaN", "inf": "Infinity"}
_WORDS = re.compile(r"\b(?:nan|inf)\b")


# -- how it gets there -----------------------------------------------------------------------------


class _LostError(Exception):
    """A connection was lost after a request was sent, and before it was answered."""


class _Connection:
    """A connection that is kept open between requests, and closed with its thread."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        kinds = {"http": http.client.HTTPConnection, "https": http.client.HTTPSConnection}
        self.prefix = parts.path
        self.http = kinds[parts.scheme](str(parts.hostname), parts.port, timeout=_CONNECTING)
        self.http.connect()
        # A server whose machine is gone is noticed, however long one waits for it.
        self.http.sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            if hasattr(socket, option):
                self.http.sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)

    def __del__(self) -> None:
        opened = getattr(self, "http", None)
        if opened is not None:
            opened.close()

    def exchanged(self, path: str, body: Any, seconds: float | None) -> tuple[int, str]:
        """Send a request and return the status and text of the answer."""
        until = None if seconds is None else time.monotonic() + seconds
        sock = self.http.sock
        sock.settimeout(seconds)
        if body is None:
            self.http.request("GET", self.prefix + path)
        else:
            content = json.dumps(body).encode()
            kind = {"Content-Type": "application/json"}
            self.http.request("POST", self.prefix + path, content, kind)
        answer = self.http.getresponse()
        pieces = []
        # In pieces, as the time limit of a socket is one for each.
        while piece := answer.read1(1 << 20):
            pieces.append(piece)
            if until is not None and not answer.isclosed():
                sock.settimeout(max(until - time.monotonic(), 1e-3))
        if answer.length:
            raise http.client.IncompleteRead(b"".join(pieces), answer.length)
        # Python 3.12 leaves it open, and the connection of no use.
        answer.close()
        return answer.status, b"".join(pieces).decode("utf-8", "replace")


# Seconds of silence after which a machine is asked whether it is there, seconds until it is asked
# again, and how often: two minutes in all, where the system's own are two hours. By judgement.
_KEEPALIVE = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4}


class _Own(threading.local):
    """What a thread has of its own."""

    def __init__(self) -> None:
        self.connections: dict[tuple[int, str], _Connection] = {}  # by process and address


_own = _Own()


def _sent(url: str, path: str, body: Any, seconds: float | None) -> tuple[int, str]:
    """Send a request on this thread's connection, and return the status and text of the answer.

    Raises
    ------
    OSError
        If there is no connection.
    TimeoutError
        If there is no answer in time.
    _LostError
        If the connection is lost meanwhile.
    """
    # A process that was forked has its parent's connections, on which that one waits for answers.
    key = os.getpid(), url
    kept = _own.connections.pop(key, None)
    if kept is not None:
        try:
            return _kept(key, kept, path, body, seconds)
        except _LostError:
            # The server may have closed it since, or have been away.
            pass
    return _kept(key, _connected(url), path, body, seconds)


def _connected(url: str) -> _Connection:
    try:
        return _Connection(url)
    except TimeoutError:
        raise ConnectionError(f"no connection within {_CONNECTING:g} s") from None


def _kept(
    key: tuple[int, str], connection: _Connection, path: str, body: Any, seconds: float | None
) -> tuple[int, str]:
    """Send a request on a connection, and keep this if all went well."""
    try:
        found = connection.exchanged(path, body, seconds)
    except TimeoutError as error:
        # That of the system says so by a number: a machine that is gone.
        if error.errno is None:
            raise
        raise _LostError(str(error)) from None
    except (OSError, http.client.HTTPException) as error:
        raise _LostError(f"{type(error).__name__}: {error}") from None
    if connection.http.sock is not None:  # as it is where the server closes it
        _own.connections[key] = connection
    return found
