"""Models behind an UM-Bridge server as responses.

The protocol: https://um-bridge-benchmarks.readthedocs.io, version 1.0.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import urllib3
from urllib3.connection import HTTPConnection
from urllib3.exceptions import HTTPError, LocationParseError, ProtocolError, ReadTimeoutError

from prbayes._finding import Finding, report
from prbayes._validate import Floats, called, plain_text, positive_number
from prbayes.response.call import scalar
from prbayes.response.outputs import Outputs


def umbridge(
    url: str,
    model: str = "forward",
    *,
    config: Mapping[str, Any] | None = None,
    timeout: float | None = None,
    patience: float = 60.0,
) -> scalar:
    """Turn a model behind an UM-Bridge server into a response, of one output or several.

    The names and sizes of the server's models are requested at once. A `Simulator` compares them
    with its inputs and with ``observed`` before anything is computed.

    Parameters
    ----------
    url : str
        Address of the server, such as ``"http://localhost:4242"``.
    model : str
        Name of one of its models.
    config : mapping, optional
        Settings that are passed to the model with each request, as JSON.
    timeout : float, optional
        Seconds for one response, the wait in the server's queue included. By default there is no
        limit as long as the server's machine answers.
    patience : float
        Seconds to wait for a server that went away before the response fails.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or the server has no such model.
    ConnectionError
        If there is no server, or it is none of UM-Bridge.

    Notes
    -----
    The numbers of all inputs, one after the other, fill the model's input vectors; those of one
    input stay in one vector. The model's output vectors, one after the other, are the outputs; a
    model with a single number gives one. NaN is no response, inf a specimen that failed.

    The server computes, so threads serve as an executor: as many as it has workers. Connections
    are reused. A request whose connection is lost is sent again, twice at most, as soon as the
    server is back; the propagation's ``on_failure`` decides on a final failure. A late response is
    abandoned, although the server may continue to compute it. The response can be pickled.

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
    url = plain_text(url, "umbridge: url").rstrip("/")
    try:
        parts = urllib3.util.parse_url(url)
    except LocationParseError:
        parts = urllib3.util.Url()
    if parts.scheme not in ("http", "https") or not parts.host or parts.port == 0:
        raise ValueError(
            f"umbridge: url: got {url!r}, expected the address of a server, such as "
            "'http://localhost:4242'"
        )
    limit = None if timeout is None else positive_number(timeout, "umbridge: timeout")
    patience = positive_number(patience, "umbridge: patience")
    request = {"name": plain_text(model, "umbridge: model"), "config": _plain_config(config)}
    try:
        info = _known(url, "/Info", None)
        version, models = info["protocolVersion"], [str(name) for name in info["models"]]
    except (RuntimeError, KeyError, TypeError) as error:
        raise ConnectionError(
            f"umbridge: url: got {url}, where something else answers ({error!s:.200}), "
            "expected a server of UM-Bridge"
        ) from None
    if version != 1.0:
        raise ValueError(
            f"umbridge: url: got a server that speaks version {version} of the protocol at "
            f"{url}, expected 1.0"
        )
    if model not in models:
        raise ValueError(
            f"umbridge: model: got {model!r}, expected one of those that the server at "
            f"{url} has: {', '.join(map(repr, models)) or 'none'}"
        )
    if not _known(url, "/ModelInfo", {"name": model}).get("support", {}).get("Evaluate"):
        raise ValueError(
            f"umbridge: model: got {model!r}, which the server at {url} cannot evaluate, "
            "expected a model that supports Evaluate"
        )
    inputs = _sizes(_known(url, "/InputSizes", request), model, "inputSizes")
    outputs = _sizes(_known(url, "/OutputSizes", request), model, "outputSizes")
    remote = RemoteModel(
        url, model, json.dumps(request["config"]), inputs, outputs, limit, patience
    )
    return scalar(remote)


def _plain_config(config: object) -> Any:
    """Return the settings of a model in the types of JSON."""
    reason = ""
    if config is None or isinstance(config, Mapping):
        try:
            return json.loads(json.dumps(dict(config or {})))
        except (TypeError, ValueError) as error:
            reason = f" ({error})"
    raise TypeError(
        f"umbridge: config: got {called(config)}, expected a mapping of settings to values that "
        f'can be written as JSON, such as {{"level": 2}}: texts, numbers, lists{reason}'
    )


def _sizes(answer: Mapping[str, Any], model: str, key: str) -> tuple[int, ...]:
    """Return the sizes of a model's vectors."""
    sizes = answer.get(key)
    if isinstance(sizes, list) and all(isinstance(n, int) and n >= 0 for n in sizes) and any(sizes):
        return tuple(sizes)
    raise ValueError(
        f"umbridge: got {key} = {sizes!r:.100} of the model {model!r}, expected the sizes of its "
        "vectors, such as [2]; look at the server"
    )


@dataclass(frozen=True)
class RemoteModel:
    """A model behind a server as a function of one specimen's inputs."""

    url: str
    model: str
    config: str  # as JSON
    inputs: tuple[int, ...]  # sizes of the model's input vectors
    outputs: tuple[int, ...]
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
        output = self._answer(request).get("output")
        try:
            rows = [np.asarray(vector, dtype=np.float64) for vector in output or ()]
        except (TypeError, ValueError):
            rows = []
        if [row.shape for row in rows] != [(size,) for size in self.outputs]:
            raise RuntimeError(
                f"{self.model}: got {output!r:.300}, expected vectors of numbers, of sizes "
                f"{list(self.outputs)}"
            )
        values = np.concatenate(rows)
        return values if values.size > 1 else float(values[0])

    def _answer(self, request: Any) -> dict[str, Any]:
        """Return the answer for one specimen, from a server that may be away for a while."""
        n_lost, give_up_at, pause = 0, 0.0, 0.1
        while True:
            try:
                status, text = _exchange(self.url, "/Evaluate", request, self.timeout)
                if status not in (502, 503):  # of a gateway whose server is away
                    return _read_answer(self.model, status, text)
                reason = f"it answered {status}"
            except TimeoutError:
                raise TimeoutError(
                    f"{self.model}: no response within timeout = {self.timeout:g} s from {self.url}"
                ) from None
            except ProtocolError as error:
                # Lost after the request was sent: the specimen may be what ends the server.
                n_lost, give_up_at, pause, reason = n_lost + 1, 0.0, 0.1, str(error)
                if n_lost == 3:
                    raise ConnectionError(
                        f"{self.model}: the server at {self.url} was lost 3 times while it was at "
                        f"work on this specimen ({reason})"
                    ) from None
            except (HTTPError, OSError) as error:
                reason = f"{type(error).__name__}: {error}"
            if not give_up_at:
                give_up_at = time.monotonic() + self.patience
                text = f"{self.model}: the server at {self.url} is away ({reason}); waiting."
                report(Finding("server-away", text))
            if time.monotonic() > give_up_at:
                raise ConnectionError(
                    f"{self.model}: the server at {self.url} is away for more than patience = "
                    f"{self.patience:g} s ({reason})"
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
                f"output: the model {self.model!r} at {self.url} has outputs of sizes "
                f"{list(self.outputs)}"
            )

    def _refuse_inputs(self, name: str, sizes: Sequence[int]) -> None:
        """Raise if inputs do not fill the model's vectors, or one would be cut in two."""
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
            f"{name}: got inputs of {', '.join(map(str, sizes))} numbers, expected such as fill "
            f"vectors of sizes {list(self.inputs)} one after the other ({reason}), which the model "
            f"{self.model!r} at {self.url} has; pass other inputs, or in another order"
        )


# -- requests --------------------------------------------------------------------------------------


def _new_pool() -> urllib3.PoolManager:
    """Return connections that notice within two minutes that a machine is gone."""
    options = [*HTTPConnection.default_socket_options, (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)]
    for option, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, option):
            options.append((socket.IPPROTO_TCP, getattr(socket, option), value))
    return urllib3.PoolManager(maxsize=64, retries=False, socket_options=options)


_pool = _new_pool()
_inherited: list[urllib3.PoolManager] = []


def _renew_pool() -> None:
    """Leave the connections to the parent process after a fork."""
    global _pool
    _inherited.append(_pool)
    _pool = _new_pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_pool)


def _known(url: str, path: str, request: Any) -> dict[str, Any]:
    """Return an answer for which the server need not compute; it has to be there."""
    try:
        return _read_answer(path, *_exchange(url, path, request, 60.0))
    except (OSError, HTTPError) as error:
        raise ConnectionError(
            f"umbridge: url: got {url}, where no server answers {path} ({error}), expected one "
            "that runs; start it, and look at its port"
        ) from None


def _exchange(url: str, path: str, request: Any, seconds: float | None) -> tuple[int, str]:
    """Return status and text of an answer; `ProtocolError` if it is lost after the request."""
    end = None if seconds is None else time.monotonic() + seconds
    try:
        response = _pool.request(
            "GET" if request is None else "POST",
            url + path,
            json=request,
            preload_content=False,
            timeout=urllib3.Timeout(connect=10.0, read=seconds),
        )
        # In pieces, as the time limit of a socket applies to each.
        pieces = []
        while piece := response.read1(1 << 20):
            pieces.append(piece)
            if end is not None and time.monotonic() > end:
                response.close()
                raise TimeoutError
        response.release_conn()
    except ReadTimeoutError as error:
        # The system's own, of a machine that is gone, has a number.
        if getattr(error.__cause__, "errno", None) is not None:
            raise ProtocolError(str(error.__cause__)) from None
        raise TimeoutError from None
    return response.status, b"".join(pieces).decode("utf-8", "replace")


def _read_answer(name: str, status: int, text: str) -> dict[str, Any]:
    """Return an answer in JSON, or raise `RuntimeError` with its error."""
    words = {"nan": "NaN", "inf": "Infinity"}  # of servers in Python
    answer = None
    for form in (text, re.sub(r"\b(?:nan|inf)\b", lambda word: words[word[0]], text)):
        try:
            answer = json.loads(form)
            break
        except ValueError:
            pass
    if isinstance(answer, dict) and "error" in answer:
        error = answer["error"]
        if isinstance(error, dict):
            error = f"{error.get('type')}: {error.get('message')}"
        raise RuntimeError(f"{name}: the server answered {error!s:.1000}")
    if status != 200 or not isinstance(answer, dict):
        log = "; what its model raised is in its own log" if status == 500 else ""
        raise RuntimeError(
            f"{name}: the server answered {status}, {text.strip()!r:.300}, expected a result{log}"
        )
    return answer
