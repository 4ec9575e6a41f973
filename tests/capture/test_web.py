"""The page: loopback only, read-only unless allowed, no way in for pages of other sites."""

import http.client
import json
import socket
import struct
import threading
from contextlib import contextmanager
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.cli import main
from capture.plan.plan import read_plan
from capture.session.run import run_plan
from capture.simulated import controller
from capture.web.serve import Pages
from capture.web.state import LiveView, SessionView, png_of
from survey.workbench.guard import loopback_address
from survey.workbench.live import Listening
from tests.capture.session_runs import write_plan
from tests.capture.table_server import table_server


@contextmanager
def served(view, token=None):
    with Listening(Pages(view, token), "127.0.0.1", 0) as listening:
        try:
            yield urlsplit(listening.address)
        finally:
            view.close()


def ask(server, method, path, headers=None, body=None):
    """Status and body of an answer."""
    port = server.port
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        sent = {"Host": f"127.0.0.1:{port}", **(headers or {})}
        connection.request(method, path, json.dumps(body) if body is not None else None, sent)
        answer = connection.getresponse()
        return answer.status, answer.read(), {name.title(): value for name, value in answer.getheaders()}
    finally:
        connection.close()


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """The server of a session that has not begun, which is only asked."""
    with served(SessionView(read_plan(write_plan(tmp_path_factory.mktemp("quiet"))))) as server:
        yield server


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "10.0.0.1", "laboratory", "8.8.8.8"])
def test_only_loopback_is_served(host):
    with pytest.raises(SurveyError, match=r"loopback only|127\.0\.0\.1 or ::1"):
        loopback_address(host)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.5", "::1"])
def test_loopback_is_accepted(host):
    assert loopback_address(host)


def test_command_refuses_other_addresses(tmp_path, capsys):
    assert main(["view", str(write_plan(tmp_path)), "--host", "0.0.0.0"]) == 1
    assert "loopback only" in capsys.readouterr().err


def test_moving_needs_live(tmp_path, capsys):
    assert main(["view", str(write_plan(tmp_path)), "--allow-move"]) == 1
    assert "--allow-move needs --live" in capsys.readouterr().err


def test_other_addresses_of_this_machine_do_not_answer(quiet):
    """127.0.0.2 is this machine too, but the socket is bound to 127.0.0.1 alone."""
    assert quiet.hostname == "127.0.0.1"
    other = ("127.0.0.2", quiet.port)
    with pytest.raises(ConnectionRefusedError), socket.create_connection(other, 1.0):
        pass


def test_page_before_during_and_after_a_session(tmp_path):
    plan = write_plan(tmp_path)
    view = SessionView(read_plan(plan))
    with served(view) as server:
        status, page, headers = ask(server, "GET", "/")
        assert status == 200
        assert b"/app.js" in page
        assert headers["Content-Security-Policy"].startswith("default-src 'self'")
        for path in ("/app.js", "/style.css", "/image.js", "/colours.css", "/de.json"):
            assert ask(server, "GET", path)[0] == 200
        first = json.loads(ask(server, "GET", "/status.json")[1])
        assert (first["state"], first["done"], first["total"], first["may_move"]) == ("not started", 0, 6, False)
        assert ask(server, "GET", "/image/X.png")[0] == 404
        run_plan(read_plan(plan), shown=False)
        last = json.loads(ask(server, "GET", "/status.json")[1])
        assert (last["state"], last["done"], last["epoch_id"]) == ("finished", 6, "t06")
        status, png, headers = ask(server, "GET", "/image/X.png")
        assert (status, headers["Content-Type"]) == (200, "image/png")
        assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).shape == (64, 96)
        assert last["shown"]["X"]["size"] == [96, 64]


def test_session_that_died_is_said(tmp_path):
    plan = write_plan(tmp_path)
    run_plan(read_plan(plan), shown=False)
    file = tmp_path / "lab" / "capture" / "status.json"
    file.write_text(file.read_text().replace('"finished"', '"running"'))
    assert SessionView(read_plan(plan)).status()["state"] == "broken off"


_OTHER = ["/../plan.toml", "/image/..%2f..%2fplan.png", "/image/%2e%2e/x.png", "/plan.toml", "//etc"]


@pytest.mark.parametrize("path", _OTHER)
def test_no_other_file_is_served(quiet, path):
    assert ask(quiet, "GET", path)[0] == 404


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Host": ""},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": "[::1"},
        {"Host": "127.0.0.1@evil.example"},
        {"Host": "192.168.1.7"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ],
)
def test_other_sites_are_kept_out(quiet, headers):
    """DNS rebinding shows in the Host header, a foreign page in Origin."""
    for path in ("/", "/status.json", "/image/X.png"):
        assert ask(quiet, "GET", path, headers)[0] == 403
    assert ask(quiet, "POST", "/stop", headers, {})[0] == 403


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1", "127.0.0.1:8780", "[::1]:22"])
def test_page_answers_through_a_forwarded_port(quiet, host):
    """The browser knows the port at its own end; an origin must still be the page itself."""
    assert ask(quiet, "GET", "/status.json", {"Host": host})[0] == 200
    assert ask(quiet, "GET", "/status.json", {"Host": host, "Origin": f"http://{host}"})[0] == 200
    assert ask(quiet, "GET", "/status.json", {"Host": host, "Origin": "http://localhost:1"})[0] == 403


def test_head_is_answered_without_a_body(quiet):
    status, body, headers = ask(quiet, "HEAD", "/")
    assert (status, body) == (200, b"")
    assert int(headers["Content-Length"]) == len(ask(quiet, "GET", "/")[1])
    assert ask(quiet, "HEAD", "/image/X.png")[0] == 404
    assert ask(quiet, "HEAD", "/", {"Host": "evil.example"})[0] == 403


@pytest.mark.slow
def test_client_that_leaves_is_no_traceback(tmp_path, capsys):
    view = SessionView(read_plan(write_plan(tmp_path)))
    with served(view) as server:
        for sent in (b"GET / HTTP/1.1\r\nHost: localhost\r\n", b"GET /app.js HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            for _ in range(20):
                with socket.create_connection(("127.0.0.1", server.port)) as client:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # leaves by a reset
                    client.sendall(sent)
        assert ask(server, "GET", "/")[0] == 200
        view.shown = lambda camera_id: {}["a bug"]
        assert ask(server, "GET", "/image/X.png")[0] == 500
    said = capsys.readouterr().err
    assert "a bug" in said  # what is not about the client is still shown
    assert "Connection" not in said
    assert "Broken pipe" not in said


def test_port_in_use_and_wrong_ports_are_one_line(tmp_path, capsys):
    plan = str(write_plan(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["view", plan, "--port", port]) == 1
        assert controller.main(["--port", port]) == 1
    for line in capsys.readouterr().err.splitlines():
        assert f"port {port} cannot be used" in line
    for wrong in ("70000", "-1", "x"):
        with pytest.raises(SystemExit) as stop:
            controller.main([f"--port={wrong}"])
        assert stop.value.code == 2


def test_nothing_moves_without_flag_and_token(tmp_path):
    with table_server(tmp_path) as table:
        plan = read_plan(write_plan(tmp_path, table.url))
        turn = {"jog": ["axis1=5"]}
        with served(LiveView(plan, with_table=False)) as server:
            assert ask(server, "POST", "/jog", {"X-Token": ""}, turn)[0] == 403
            assert ask(server, "POST", "/jog", {"X-Token": "None"}, turn)[0] == 403
        assert table.received() == []
        with served(LiveView(plan, with_table=True), token="right") as server:
            for headers in ({}, {"X-Token": "wrong"}, {"X-Token": ""}, {"X-Token": "right", "Host": "evil.example"}):
                assert ask(server, "POST", "/jog", headers, turn)[0] == 403
            assert ask(server, "GET", "/jog", {"X-Token": "right"})[0] == 404
            assert table.commands() == []
            status, answer, _ = ask(server, "POST", "/jog", {"X-Token": "right"}, {"jog": ["axis1=61"]})
            assert status == 409
            assert b"outside its limits" in answer
            assert table.commands() == []
            assert ask(server, "POST", "/jog", {"X-Token": "right"}, {"jog": "axis1"})[0] in (400, 409)
            assert ask(server, "POST", "/jog", {"X-Token": "right"}, turn)[0] == 200
            assert [line for _, line in table.commands()] == ["MA 1 5.000000", "MA 2 0.000000"]
            assert ask(server, "POST", "/stop", {"X-Token": "right"}, {})[0] == 200
            assert table.stopped()


@pytest.mark.slow
def test_live_images_and_lock(tmp_path):
    plan = read_plan(write_plan(tmp_path, cameras=("X",)))
    view = LiveView(plan, with_table=True)
    with served(view) as server:
        with pytest.raises(SurveyError, match="another session works on this folder"):
            run_plan(plan, shown=False)
        for _ in range(100):
            if ask(server, "GET", "/image/X.png")[0] == 200:
                break
            threading.Event().wait(0.05)
        status = json.loads(ask(server, "GET", "/status.json")[1])
        assert status["state"] == "live"
        assert status["table"]["axes"][0]["limits_deg"] == [-60, 60]
        assert status["quality"]["X"]["saturated"] >= 0.0
    assert run_plan(plan, shown=False).taken == 6  # camera, table and folder have been let go


def test_16_bit_images_are_shown_in_8():
    image = np.linspace(0, 4095, 64 * 64).reshape(64, 64).astype(np.uint16)
    shown = cv2.imdecode(np.frombuffer(png_of(image, None), np.uint8), 0)
    assert shown.max() == 255
    assert shown.min() == 0
