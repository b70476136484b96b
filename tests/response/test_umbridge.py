"""A model behind a UM-Bridge server: a real one, and one that does to requests what it is told."""

from __future__ import annotations

import base64
import json
import logging
import pickle
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import pymc as pm
import pytest
from um_server import Real

import prbayes as prb
from prbayes.response import umbridge as um_bridge

# -- a server that is told what to do --------------------------------------------------------------

SIZES = {"/InputSizes": {"inputSizes": [2]}, "/OutputSizes": {"outputSizes": [2]}}
KNOWN: dict[str, Any] = {
    "/Info": {"protocolVersion": 1.0, "models": ["forward"]},
    "/ModelInfo": {"support": {"Evaluate": True}},
    **SIZES,
}


class Told(BaseHTTPRequestHandler):
    """Answers what it is told to, and counts."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: Any

    def setup(self) -> None:
        super().setup()
        self.server.connections += 1

    def answer(self) -> None:
        text = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == "/Evaluate":
            self.server.asked.append(json.loads(text))
            self.server.evaluate(self, *self.server.asked[-1]["input"][0])
        else:
            self.server.headers.append(self.headers)
            known = self.server.known[self.path]
            self.say(known if isinstance(known, str) else json.dumps(known))

    do_GET = do_POST = answer  # noqa: N815 (names of the standard library)

    def say(self, text: str, status: int = 200) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *_: object) -> None:
        pass


def give(handler: Told, x: float, y: float) -> None:
    """Answer as a model should."""
    handler.say(json.dumps({"output": [[x - 2 * y, x * x * y]]}))


class Telling(ThreadingHTTPServer):
    """A server of the model `forward`."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, evaluate: Callable[..., None] = give, port: int = 0, **known: Any) -> None:
        super().__init__(("127.0.0.1", port), Told)
        self.evaluate, self.asked, self.connections = evaluate, list[Any](), 0
        self.headers = list[Any]()
        self.known = KNOWN | {f"/{path}": answer for path, answer in known.items()}
        self.url = f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, *_: object) -> None:
        pass


@contextmanager
def telling(evaluate: Callable[..., None] = give, **settings: Any) -> Iterator[Telling]:
    with Telling(evaluate, **settings) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


# -- a real server ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Real]:
    server = Real(tmp_path_factory.mktemp("server"))
    yield server
    server.kill()


def test_outputs_and_inputs_are_in_their_order_with_all_digits(real: Real) -> None:
    x, y = np.random.default_rng(0).normal(size=(2, 3, 4)) * [1e-100, 1 / 3, 7.0, 1e100]
    expected = np.stack([x - 2 * y, x * x * y], axis=-1)
    np.testing.assert_array_equal(prb.umbridge(real.url, "beam")(x, y), expected)
    doubled = prb.umbridge(f"{real.url}/", "beam", config={"scale": 2.0})(x, y)
    np.testing.assert_array_equal(doubled, expected * [2.0, 1.0])


def test_inputs_of_several_numbers_fill_the_vectors(real: Real) -> None:
    model = prb.umbridge(real.url, "vectors").function
    expected = [4.0, -1.0, 30.0]
    np.testing.assert_array_equal(model(4.0, np.array([1.0, 2.0, 3.0])), expected)
    np.testing.assert_array_equal(model(4.0, np.array([1.0, 2.0]), 3.0), expected)
    with pytest.raises(
        ValueError, match=r"got inputs of 3, 1 numbers.*input 1 would be cut in two"
    ):
        model(np.array([1.0, 2.0, 3.0]), 4.0)
    with pytest.raises(ValueError, match=r"inputs of 1, 1 numbers.*sizes \[1, 3\].*\(4 in all\)"):
        model(1.0, 2.0)


def test_what_is_no_number_and_what_the_model_raises(real: Real) -> None:
    moody = prb.umbridge(real.url, "moody")
    np.testing.assert_array_equal(moody([3.0, 6.0, 7.0]), [6.0, np.nan, np.inf])
    with pytest.raises(
        prb.response.ResponseError, match=r"it returned -inf, expected numbers, NaN"
    ):
        moody(8.0)
    with pytest.raises(RuntimeError, match=r"moody: the server answered 500, .* in its own log"):
        moody(5.0)
    assert moody(4.0) == 8


@pytest.mark.long
def test_a_request_that_never_returns_is_given_up_and_its_answer_is_nobody_s(real: Real) -> None:
    moody = prb.umbridge(real.url, "moody", timeout=1.0)
    with pytest.raises(TimeoutError, match=r"moody: no response within timeout = 1 s from http"):
        moody(-2.0)
    # The late answer arrives meanwhile.
    for x in np.linspace(1, 2, 120):
        assert moody(x) == 2 * x
        time.sleep(0.01)


def test_requests_are_at_work_at_the_same_time() -> None:
    barrier = threading.Barrier(4, timeout=60)

    def evaluate(handler: Told, x: float, y: float) -> None:
        barrier.wait()  # broken after the time limit unless four are at work
        give(handler, x, y)

    with telling(evaluate) as server, ThreadPoolExecutor(4) as pool:
        response = prb.umbridge(server.url)
        first_outputs = [float(pair[0]) for pair in pool.map(response, range(4), [1.0] * 4)]
    assert first_outputs == [-2, -1, 0, 1]


@pytest.mark.slow
def test_it_travels_to_processes_and_none_speaks_on_the_connection_of_another(real: Real) -> None:
    beam = prb.umbridge(real.url, "beam")
    assert beam(1.0, 2.0).tolist() == [-3.0, 2.0]
    code = """
import os, pickle, sys
beam = pickle.load(sys.stdin.buffer)
beam(1.0, 2.0)
child = os.fork() if hasattr(os, "fork") else 1
for x in range(200):
    x += 1000 * (child == 0)
    assert beam(x, 1.0).tolist() == [x - 2, x * x], (x, child)
if child > 1:
    assert os.waitpid(child, 0)[1] == 0
"""
    program = [sys.executable, "-W", "ignore", "-c", code]
    subprocess.run(program, input=pickle.dumps(beam), check=True, timeout=60)


def test_a_server_that_goes_away_is_waited_for() -> None:
    def evaluate(handler: Told, x: float, y: float) -> None:
        handler.close_connection = True
        give(handler, x, y)

    with telling(evaluate) as server:
        url = server.url
        patient, hasty = prb.umbridge(url), prb.umbridge(url, patience=0.2)
        assert hasty(7.0, 1.0)[1] == 49
    with pytest.raises(ConnectionError, match=r"has not answered for more than patience = 0.2 s"):
        hasty(7.0, 1.0)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(patient, 7.0, 1.0)
        time.sleep(0.1)
        with telling(evaluate, port=server.server_port):
            assert waiting.result()[1] == 49


# -- what goes wrong -------------------------------------------------------------------------------


def test_what_is_no_server_is_refused_at_once(real: Real) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        clock = time.monotonic()
        with pytest.raises(ConnectionError, match=r"where no server answers /Info \(.*start it"):
            prb.umbridge(f"http://127.0.0.1:{free.getsockname()[1]}")
        assert time.monotonic() - clock < 5
    for info in ("<html>", {"hello": 1}):
        with telling(Info=info) as server, pytest.raises(ConnectionError, match="something else"):
            prb.umbridge(server.url)
    with (
        telling(Info={"protocolVersion": 2.0, "models": []}) as server,
        pytest.raises(ValueError, match=r"speaks version 2.0 of the protocol .*, expected 1.0"),
    ):
        prb.umbridge(server.url)


def test_models_that_are_not_there_are_refused(real: Real) -> None:
    with pytest.raises(ValueError, match=r"got 'forward', expected one of .* 'beam', 'vectors"):
        prb.umbridge(real.url)
    with pytest.raises(ValueError, match=r"got 'mute', which the server at .* cannot evaluate"):
        prb.umbridge(real.url, "mute")


def test_a_simulator_that_does_not_fit_is_refused_before_anything_is_computed() -> None:
    with telling() as server, pm.Model():
        response = prb.umbridge(server.url)
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1)
        rng = np.random.default_rng(0)
        for inputs, event, said in (
            ((x,), (2,), r"y: got inputs of 1 numbers, expected inputs that fill vectors"),
            ((x, 1.0, 2.0), (2,), r"y: got inputs of 1, 1, 1 numbers, .*\(2 in all\)"),
            ((x, 1.0), (), r"y: observed: got shape \(N,\), expected \(N, 2\)"),
            ((x, 1.0), (3,), r"y: observed: got shape \(N, 3\), expected \(N, 2\)"),
        ):
            with pytest.raises(ValueError, match=said):
                prb.Simulator(
                    "y",
                    response,
                    *inputs,
                    metric=prb.Joint(prb.AreaMetric()) if event else prb.AreaMetric(),
                    observed=rng.normal(size=(9, *event)),
                    propagation=prb.Reweighted(16, on_failure=prb.response.Replace()),
                )
        with pytest.raises(
            ValueError, match=r"y: got inputs of 1 numbers, expected inputs that fill"
        ):
            prb.Surrogate.fit(response, {"x": (0, 1)}, 16, name="y")
        assert not server.asked


def test_a_thread_keeps_its_connection_and_opens_another_where_it_was_closed() -> None:
    closing = threading.Event()

    def evaluate(handler: Told, x: float, y: float) -> None:
        handler.close_connection = closing.is_set()
        give(handler, x, y)

    with telling(evaluate) as server:
        response = prb.umbridge(server.url)
        for x in range(10):
            assert response(x, 1.0)[0] == x - 2
        assert server.connections == 1
        # It closes after each answer without a word.
        closing.set()
        for x in range(10):
            assert response(x, 1.0)[0] == x - 2
        assert server.connections == 10


def test_a_specimen_that_ends_its_server_is_sent_three_times() -> None:
    def evaluate(handler: Told, x: float, y: float) -> None:
        if x == 6:
            handler.close_connection = True
            handler.connection.shutdown(socket.SHUT_RDWR)
        else:
            give(handler, x, y)

    with telling(evaluate) as server:
        response = prb.umbridge(server.url)
        # In a thread that has no connection yet, of which it could not know whether it is stale.
        with ThreadPoolExecutor(1) as pool:
            error = pool.submit(response, 6.0, 1.0).exception()
        assert isinstance(error, ConnectionError)
        assert "was lost 3 times during this specimen" in str(error)
        assert len(server.asked) == 3
        assert response(5.0, 1.0)[1] == 25


def test_an_answer_that_is_cut_off_is_asked_for_again() -> None:
    def evaluate(handler: Told, x: float, y: float) -> None:
        if handler.server.asked[1:]:
            give(handler, x, y)
        else:
            handler.send_response(200)
            handler.send_header("Content-Length", "100")
            handler.end_headers()
            handler.wfile.write(b'{"output": [[1')
            handler.close_connection = True

    with telling(evaluate) as server:
        assert prb.umbridge(server.url)(7.0, 1.0)[1] == 49
    assert len(server.asked) == 2


def test_a_gateway_whose_server_is_away_is_asked_again(caplog: pytest.LogCaptureFixture) -> None:
    def evaluate(handler: Told, x: float, y: float) -> None:
        if handler.server.asked[3:]:
            give(handler, x, y)
        else:
            handler.say("<html>503 Service Unavailable", 503)

    with telling(evaluate) as server, caplog.at_level(logging.WARNING, "prbayes"):
        assert prb.umbridge(server.url)(7.0, 1.0)[1] == 49
    assert len(server.asked) == 4
    (record,) = caplog.records
    assert "does not answer (it answered 503); waiting" in record.getMessage()


@pytest.mark.parametrize(
    ("text", "status", "said"),
    [
        (
            '{"error": {"type": "InvalidInput", "message": "no"}}',
            400,
            r"answered InvalidInput: no$",
        ),
        ('{"error": "out of memory"}', 200, r"forward: the server answered out of memory$"),
        ('{"output": [[1, 2]]}', 404, r"the server answered 404, '{"),
        (
            "Gateway Time-out",
            504,
            r"the server answered 504, 'Gateway Time-out', expected a result with 'output'$",
        ),
        ('{"output": [[1, 2], [3]]}', 200, r"got .*, expected vectors of numbers, of sizes \[2\]$"),
        ('{"output": [[1, "x"]]}', 200, r"got output = \[\[1, 'x'\]\], expected vectors of num"),
        ('{"output": {"0": [1, 2]}}', 200, r"got output = {.*}, expected vectors of numbers"),
        ('{"error": null}', 200, r"the server answered 200, .*expected a result with 'output'"),
    ],
)
def test_an_answer_that_is_no_result_is_told(text: str, status: int, said: str) -> None:
    with telling(lambda handler, *_: handler.say(text, status)) as server:
        response = prb.umbridge(server.url)
        with pytest.raises(RuntimeError, match=said):
            response(1.0, 2.0)


@pytest.mark.parametrize("error", ["null", "false", '""'])
def test_an_error_that_is_empty_is_none(error: str) -> None:
    text = f'{{"output": [[1, 2]], "error": {error}}}'
    with telling(lambda handler, *_: handler.say(text)) as server:
        np.testing.assert_array_equal(prb.umbridge(server.url)(1.0, 2.0), [1.0, 2.0])


def test_password_and_query_are_sent_and_never_shown() -> None:
    paths = {f"app%C3%BC{path}?token=secret": answer for path, answer in KNOWN.items()}
    with telling(**paths) as server:
        url = server.url.replace("//", "//m%40e:s%C3%A9cret@") + "/app\u00fc/?token=secret"
        response = prb.umbridge(url)
        sent = {headers["Authorization"] for headers in server.headers}
        assert sent == {"Basic " + base64.b64encode("m@e:s\u00e9cret".encode()).decode()}
        assert "cret" not in repr(response.function)
        assert pickle.loads(pickle.dumps(response.function)) == response.function
        server.known.clear()
        with pytest.raises(ConnectionError) as gone:
            prb.umbridge(url)
    wrong = (
        url.replace("http", "ftp"),
        url.removeprefix("http://"),
        url + "#part",
        url.replace("app", "a b"),
        url.replace("app", "a\r\nX: b"),
        url + "\n",
    )
    texts = [str(gone.value)]
    for wrong_url in wrong:
        with pytest.raises(ValueError, match=r"got .*, expected the address of a server") as error:
            prb.umbridge(wrong_url)
        texts.append(str(error.value))
    assert not [text for text in texts if "cret" in text or "token" in text]


def test_numbers_that_json_does_not_know_are_read_and_texts_are_left() -> None:
    with telling(lambda handler, *_: handler.say('{"output": [[null, -inf]]}')) as server:
        np.testing.assert_array_equal(prb.umbridge(server.url)(1.0, 2.0), [np.nan, np.nan])
    text = '{"error": {"type": "nan", "message": "inf"}}'
    with (
        telling(lambda handler, *_: handler.say(text)) as server,
        pytest.raises(RuntimeError, match="answered nan: inf"),
    ):
        prb.umbridge(server.url)(1.0, 2.0)


def test_a_machine_that_is_gone_is_noticed_without_a_time_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with telling() as server:
        response = prb.umbridge(server.url)
        kept = um_bridge._pool.connection_from_url(server.url).pool
        assert kept is not None
        sock = kept.queue[-1].sock
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)

        # What the system says of a machine that does not answer is a loss, and not a time limit.
        def gone(*_: object) -> Any:
            monkeypatch.undo()
            raise TimeoutError(110, "Connection timed out")

        monkeypatch.setattr("urllib3.connection.HTTPConnection.getresponse", gone)
        assert response(3.0, 2.0)[1] == 18
