"""The local server of the workbench: what it refuses, what it answers, and the loop of a mistake found and mended."""

import inspect
import json
import re
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.sync.client import connect

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.report.language import message, speaking
from survey.workbench.addresses import WAYS
from survey.workbench.live import Listening
from survey.workbench.pages.beginning import Beginning
from survey.workbench.server import WEB, Server
from survey.workbench.session import Workbench
from survey.workbench.views.project import PARTS
from tests.browsing import SECONDS
from tests.survey.adjusted_benches import adjusted_bench
from tests.survey.test_workbench import exclusions, wrong_point

TOKEN = "secret-token-of-this-test"
HERE = {"X-Token": TOKEN}
BASE = "http://127.0.0.1:8790"
PYTHON = Path(__file__).parents[2] / "docs/python.md"
LIVE = "ws://127.0.0.1:8790/live"


@pytest.fixture
def mine(lab, tmp_path):
    return shutil.copytree(lab[0], tmp_path / "lab")


@contextmanager
def page(folder, read_only=False):
    bench = adjusted_bench(folder, read_only)
    with TestClient(Server(bench, TOKEN).app(), base_url=BASE) as client:
        yield client


def image_of(folder):
    survey = Workbench(folder).situation.survey
    return f"left/{next(b.epoch_id for b in survey.image_blocks if b.camera_id == 'left')}"


def post(client, path, body, **headers):
    return client.post(path, json=body, headers=HERE | headers)


def exclude(name, base, reason="blur"):
    what, _, text = name.partition(":")
    return {"base": base, "reason": reason, "changes": [{"what": what, "id": text, "excluded": True}]}


def test_refused_is_what_does_not_come_from_here(mine):
    with page(mine) as client:
        wanted = exclude("camera:right", 1)
        assert client.get("/api/state").status_code == 403
        assert client.get("/api/state", headers={"X-Token": "x" * len(TOKEN)}).status_code == 403
        assert client.get("/api/state", headers={"X-Token": "ä".encode()}).status_code == 403
        assert client.get("/api/state", headers=HERE | {"Host": "evil.example"}).status_code == 403
        assert client.get("/api/state", headers=HERE | {"Host": "127.0.0.1.evil.example"}).status_code == 403
        assert client.get("/api/state", headers=HERE | {"Origin": "http://evil.example"}).status_code == 403
        assert client.get("/api/state", headers=HERE | {"Origin": "null"}).status_code == 403
        assert client.get("/", headers={"Host": "evil.example"}).status_code == 403
        forwarded = {"Host": "localhost:9000", "Origin": "http://localhost:9000"}
        assert client.get("/api/state", headers=HERE | forwarded).status_code == 200
        cookie = client.cookies["labsurvey"]
        assert cookie == TOKEN
        plain = {"Content-Type": "text/plain"}
        assert client.post("/api/exclusions", json=wanted).status_code == 403  # the cookie alone
        assert client.post("/api/exclusions", content=json.dumps(wanted), headers=HERE | plain).status_code == 415
        assert client.get("/api/state").status_code == 403
        assert client.delete("/api/state", headers=HERE).status_code == 405
        assert client.post("/", headers=HERE).status_code == 405
        assert not exclusions(mine)


@pytest.mark.parametrize("path", [
    "/..%2f..%2fsurvey.toml", "/%2e%2e/%2e%2e/server.py", "/server.py", "/api/image/left/..%2f..%2fsurvey.toml",
    "/api/image/..%2fobservations/image_points", "/api/image/%2fetc/passwd", "/api/image/left/nope", "/api/nope",
])  # fmt: skip
def test_no_way_to_other_files(mine, path):
    with page(mine) as client:
        answer = client.get(path, headers=HERE)
        assert answer.status_code == 404
        assert "format" not in answer.text


def test_headers_of_every_answer(mine):
    with page(mine) as client:
        for answer in (client.get("/"), client.get("/api/state", headers=HERE), client.get("/api/state")):
            assert "default-src 'self'" in answer.headers["content-security-policy"]
            assert "unsafe" not in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.headers["cache-control"] == "no-store"
            assert TOKEN not in answer.text
        said = client.get("/api/state", headers=HERE).headers["set-cookie"].lower()
        assert "httponly" in said
        assert "samesite=strict" in said


def test_bodies_that_are_too_long_or_no_sense(mine):
    with page(mine) as client:
        kind = {"Content-Type": "application/json"}

        def pieces():
            for _ in range(40):
                yield b" " * 50_000

        assert client.post("/api/exclusions", content=pieces(), headers=HERE | kind).status_code == 413
        for body in (b"{", b"[]", b'{"changes": 3}', b'{"changes": [{"what": "image", "id": "x"}]}', b"[" * 100_000,
                     b'{"base": "1", "changes": [{"name": "x", "excluded": true}]}', b"\xff"):  # fmt: skip
            assert client.post("/api/exclusions", content=body, headers=HERE | kind).status_code == 400, body[:60]
        answer = post(client, "/api/exclusions", exclude("image:../../etc/passwd", 1))
        assert answer.status_code == 409
        assert not exclusions(mine)


@pytest.mark.slow
def test_reading_only_allows_what_changes_no_file_and_nothing_else(mine, tmp_path):
    """Every address is asked; those that say that they change nothing with what makes them work."""
    other = shutil.copytree(mine, tmp_path / "other")
    bodies = {"/api/preview": {"changes": [{"name": f"image:{image_of(mine)}", "excluded": True}]},
              "/api/jobs/show": {"folder": "other"}, "/api/jobs/compare": {"folder": "lab"},  # which is left by then
              "/api/adjust": {"mode": "cold"}}  # fmt: skip
    files = {p: p.read_bytes() for at in (mine, other) for p in at.rglob("*") if p.is_file()}
    with page(mine, read_only=True) as client:
        for way in WAYS:
            path = way.path.replace("{number:int}", "1").replace("{camera}/{epoch}", image_of(mine))
            path = path.replace("{camera}", "left").replace("{part}", "weak").replace("{name}", "none")
            if way.method == "GET":
                assert client.get(path, headers=HERE).status_code in (200, 404, 409), path
                continue
            status = post(client, path, bodies.get(path, {})).status_code
            assert (status == 403) == way.changes, path
            assert way.changes or status == 200 or not way.calls, path
    now = {p: p.read_bytes() for at in (mine, other) for p in at.rglob("*") if p.is_file()}
    assert now == files


def test_every_address_is_a_function_of_the_python_interface(mine):
    """And what the scripts of the page ask for is an address."""
    for way in WAYS:
        for name in way.calls:
            assert name in vars(Workbench(mine)) or inspect.getdoc(getattr(Workbench, name)), name
    assert {"state", "exclude", "undo", "save", "plan", "detect"} <= {name for way in WAYS for name in way.calls}
    table = re.findall(r"(?m)^\| .+ \| `(\w+ /api/\S+)` \| (.+) \|$", PYTHON.read_text(encoding="utf-8"))
    assert {address: tuple(re.findall(r"`(\w+)`", names)) for address, names in table} == {
        f"{way.method} {way.path}": way.calls for way in WAYS if way.calls}  # fmt: skip
    known = {re.sub(r"\{.*", "", way.path.removeprefix("/api/")).split("/")[0] for way in WAYS}
    asked = {name for p in WEB.glob("*.js") for name in re.findall(r'\b(?:get|post)\([`"]([a-z_]+)', p.read_text())}
    assert len(asked) > 10
    assert asked <= known


def test_the_socket_needs_origin_and_token(mine):
    with page(mine) as client:
        for headers in ({}, {"Origin": "http://127.0.0.1:8790"}, HERE, HERE | {"Origin": "http://evil.example"},
                        {"Cookie": f"labsurvey={TOKEN}"},
                        {"Cookie": f"labsurvey={TOKEN}", "Origin": "http://evil.example"}):  # fmt: skip
            with pytest.raises(WebSocketDisconnect), client.websocket_connect(LIVE, headers=headers):
                pass
        known = {"Origin": "http://127.0.0.1:8790", "Cookie": f"labsurvey={TOKEN}"}
        with client.websocket_connect(LIVE, headers=known) as socket:
            assert post(client, "/api/adjust", {"mode": "cold"}).status_code == 200
            kinds = []
            while "state" not in kinds:
                kinds.append(socket.receive_json()["type"])
            assert "progress" in kinds


def test_a_page_that_joins_late_hears_what_others_wrote_before(mine, monkeypatch):
    """What was said while nobody listened is said again; what holds no more is not."""
    monkeypatch.setattr("survey.workbench.work._LOOK_S", 0.1)
    known = {"Origin": "http://127.0.0.1:8790", "Cookie": f"labsurvey={TOKEN}"}
    with page(mine) as client:
        post(client, "/api/adjust", {"mode": "cold"})
        toml, heard = mine / "survey.toml", []
        toml.write_text(f"{toml.read_text()}\n")
        with client.websocket_connect(LIVE, headers=known) as socket:
            while "folder" not in heard:
                heard.append(socket.receive_json()["type"])
        with client.websocket_connect(LIVE, headers=known) as socket:
            late = [socket.receive_json() for _ in range(2)]
    assert {m["type"]: m.get("changed") for m in late} == {"state": None, "folder": ["survey.toml"]}


@pytest.mark.slow
def test_a_mistake_is_found_seen_left_out_and_taken_back(mine):
    name = wrong_point(mine)
    with page(mine) as client:
        state = client.get("/api/state", headers=HERE).json()
        found = client.get("/api/findings", headers=HERE).json()["findings"][0]
        assert found["id"] == f"image_point:{name}"
        assert found["anchor"] == f"#obs=image_point:{name}"
        seen = client.get(f"/api/points?image={found['image']}", headers=HERE)
        header = json.loads(seen.content[4 : 4 + int.from_bytes(seen.content[:4], "little")])
        assert header["n"] > 3
        changes = found["remedies"][0]["changes"]
        told = post(client, "/api/preview", {"changes": changes}).json()
        assert told["n_image_points"] == 1
        body = {"base": state["version"], "reason": "reflection", "changes": changes}
        after = post(client, "/api/exclusions", body).json()
        assert after["version"] == state["version"] + 1
        assert after["exclusions"][0]["reason"] == "reflection"
        assert after["changes"]["components"][0]["sigmas"] >= 0.0
        old = post(client, "/api/exclusions", body)
        assert old.status_code == 409
        assert "changed since" in old.json()["error"]
        back = post(client, "/api/undo", {"base": after["version"]}).json()
        assert back["exclusions"] == []
        assert back["redo"] == [f"exclude image_point:{name}"]
        assert [line.split(",")[2] for line in exclusions(mine)] == ["excluded", "included"]
        saved = post(client, "/api/save", {}).json()
        assert "solution.json" in saved["written"]
        runs = client.get("/api/runs", headers=HERE).json()["runs"]
        same = client.get(f"/api/compare?b={runs[0]['number']}&most=5", headers=HERE).json()
        assert all(c["sigmas"] < 1e-6 for c in same["components"] if c["sigmas"] is not None)


@pytest.mark.slow
def test_the_command_line_and_two_pages_lose_nothing_of_each_other(mine):
    first, second = image_of(mine), "right/" + image_of(mine).split("/")[1]
    with page(mine) as a, page(mine) as b:
        assert post(a, "/api/exclusions", exclude(f"image:{first}", 1)).status_code == 200
        late = post(b, "/api/exclusions", exclude(f"image:{second}", 1))
        assert late.status_code == 409
        assert late.json()["retry"]
        assert b.get("/api/state", headers=HERE).json()["changed_files"] == ["observations/exclusions.csv"]
        assert main(["include", str(mine), first, "--quiet"]) == 0
        state = post(b, "/api/reload", {}).json()
        assert state["changed_files"] == []
        assert post(b, "/api/exclusions", exclude(f"image:{second}", state["version"])).status_code == 200
    assert [line.split(",")[1:3] for line in exclusions(mine)] == [
        [first, "excluded"], [first, "included"], [second, "excluded"],
    ]  # fmt: skip


def test_every_view_answers(mine):
    views = ("readings", "parameters", "scene", "findings", "runs", "changes", "camera/left?distance_m=3", "loops",
             "table_residuals", "network", "halves", *(f"statistics/{part}" for part in PARTS))  # fmt: skip
    with page(mine) as client:
        for path in views:
            answer = client.get(f"/api/{path}", headers=HERE)
            assert answer.status_code == 200, (path, answer.text)
            assert answer.json()["version"] == 1


def test_others_are_answered_while_the_halves_are_adjusted(mine, monkeypatch):
    begun, told = threading.Event(), threading.Event()

    def halves(bench, distance):
        begun.set()
        assert told.wait(30.0), "nobody else was answered meanwhile"
        raise SurveyError("there are no two halves")

    monkeypatch.setattr(Workbench, "cross_validate", halves)
    with page(mine) as client:
        asked = threading.Thread(target=client.get, args=("/api/halves",), kwargs={"headers": HERE})
        asked.start()
        assert begun.wait(30.0)
        assert post(client, "/api/exclusions", exclude(f"image:{image_of(mine)}", 1)).json()["version"] == 2
        told.set()
        asked.join(30.0)
    assert not asked.is_alive()


def test_an_unknown_part_offers_the_nearest(mine):
    with page(mine) as client:
        answer = client.get("/api/statistics/correlation", headers=HERE)
        assert answer.status_code == 409
        assert "did you mean 'correlations'" in answer.json()["error"]


def test_images_by_name_with_a_tag(mine):
    camera, epoch = image_of(mine).split("/")
    place = mine / "images" / camera
    place.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(place / f"{epoch}.png"), np.full((60, 80), 90, np.uint8))
    with page(mine) as client:
        answer = client.get(f"/api/image/{camera}/{epoch}?size=40", headers=HERE)
        assert answer.headers["content-type"] == "image/jpeg"
        tag = answer.headers["etag"]
        again = client.get(f"/api/image/{camera}/{epoch}?size=40", headers=HERE | {"If-None-Match": tag})
        assert again.status_code == 304
        assert client.get(f"/api/image/{camera}/{epoch}?size=full", headers=HERE).headers["etag"] != tag
        client.get("/api/state", headers=HERE)
        assert client.get(f"/api/image/{camera}/{epoch}").status_code == 200  # by the cookie, as <img> asks


def test_it_ends_with_pages_still_open(mine):
    bench = adjusted_bench(mine)
    with Listening(Server(bench, TOKEN, "c"), "127.0.0.1", 0) as listening:
        with urlopen(Request(f"{listening.address}api/state", headers=HERE), timeout=20) as answer:
            assert json.load(answer)["version"] == 1
        origin = listening.address.rstrip("/")
        known = {"Cookie": f"c={TOKEN}"}
        socket = connect(f"{origin.replace('http', 'ws')}/live", origin=origin, additional_headers=known)
    assert not any(t.is_alive() and "uvicorn" in t.name for t in threading.enumerate())
    with socket:
        assert list(socket) == []  # closed by the server


@pytest.mark.parametrize("kept", [True, False])
def test_what_there_is_is_shown_while_the_first_solution_is_waited_for(mine, kept):
    """The first adjustment is held at its first step; results of the same inputs stand for it until then."""
    if not kept:
        with (mine / "survey.toml").open("a") as stream:
            stream.write("\n")  # other inputs than those of the results
    bench, seen = Workbench(mine), threading.Event()
    server = Server(bench, TOKEN)
    server.work.patience_s = 0.0  # no page joins here
    bench.watch = lambda _step, _omega: seen.wait(SECONDS)
    with TestClient(server.app(), base_url=BASE) as client:
        state = client.get("/api/state", headers=HERE).json()
        assert state["solution"] is None
        assert (state["kept"] is not None) == kept
        assert client.get("/api/points", headers=HERE).status_code == 200
        early = client.get("/api/findings", headers=HERE).json()
        assert bool(early["findings"]) == kept
        assert client.get("/api/state", headers=HERE).json()["solution"] is None
        seen.set()
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            state = client.get("/api/state", headers=HERE).json()
            if state["solution"] is not None:
                break
            time.sleep(0.05)
        assert state["solution"]["verdict"]
        assert state["kept"] is None
        assert client.get("/api/parameters", headers=HERE).status_code == 200
        if kept:
            late = client.get("/api/findings", headers=HERE).json()
            of_points = [f["id"] for f in late["findings"] if f["kind"] == "image_point"]
            assert [f["id"] for f in early["findings"]][:10] == of_points[:10]
            assert early["verdict"] == late["verdict"]


def test_a_page_that_knows_the_rows_gets_what_the_solution_says_of_them(mine):
    def points(client, query=""):
        data = client.get(f"/api/points{query}", headers=HERE).content
        n = int.from_bytes(data[:4], "little")
        header, found, at = json.loads(data[4 : 4 + n]), {}, 4 + n
        for one in header["columns"]:
            found[one["name"]] = np.frombuffer(data, "<" + one["type"], header["n"], at)
            at += found[one["name"]].nbytes
        return header, found

    with page(mine) as client:
        first, seen = points(client)
        assert first["whole"]
        assert post(client, "/api/exclusions", exclude(f"image:{image_of(mine)}", 1)).status_code == 200
        later, changed = points(client, f"?layout={first['layout']}")
        whole, again = points(client)
        assert (later["whole"], "u" in changed, later["layout"]) == (False, False, whole["layout"])
        assert np.array_equal(seen["u"], again["u"])
        for name in ("du", "w", "used", "why"):
            assert np.array_equal(changed[name], again[name], equal_nan=name != "used" and name != "why")
        assert changed["used"].sum() < seen["used"].sum()
        assert post(client, "/api/reload", {}).status_code == 200
        assert points(client, f"?layout={first['layout']}")[0]["whole"], "they may be others now"


def images_alone(place, *names):
    for name in names:
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(place / name), np.full((60, 80), 90, np.uint8))
    return place


def test_a_folder_of_images_is_offered_to_begin_a_project_with(tmp_path):
    folder = images_alone(tmp_path / "lab", "X/e1.png", "X/e2.png", "Y/e1.png")
    for read_only in (True, False):
        with TestClient(Server(Beginning(folder, read_only=read_only), TOKEN).app(), base_url=BASE) as client:
            found = client.get("/api/state", headers=HERE).json()["beginning"]
            assert found["cameras"] == {"X": 2, "Y": 1}
            assert found["folder"].endswith("lab-project")
            refused = client.get("/api/findings", headers=HERE)
            assert (refused.status_code, "begin a project" in refused.json()["error"]) == (409, True)
            assert client.get("/api/image/X/e1", headers=HERE).status_code == 409
            answer = post(client, "/api/jobs/init", {k: found[k] for k in ("images", "folder")})
            assert answer.status_code == (403 if read_only else 200)
    assert answer.json()["state"]["tree"]["cameras"][0]["images"] == ["e1", "e2"]
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == ["e1.png", "e1.png", "e2.png"]


@pytest.mark.parametrize(("make", "says"), [
    (lambda at: None, "no such folder"), (lambda at: at.mkdir(), "there is no survey.toml in it"),
    (lambda at: at.write_text(""), "is a file"), (lambda at: images_alone(at, 'a"b/e1.png'), "that of the camera"),
    (lambda at: images_alone(at, "X/e1.png", "X/e1.jpg"), "two images are named e1"),
    (lambda at: (at.mkdir(), (at / "survey.toml").write_bytes(b"\xff\x00")), "survey.toml"),
    (lambda at: (at.mkdir(), (at / "survey.toml").write_text("format = ")), "survey.toml:1: not valid TOML"),
])  # fmt: skip
def test_what_cannot_be_opened_is_said(tmp_path, capsys, make, says):
    make(tmp_path / "lab")
    assert main(["open", str(tmp_path / "lab"), "--no-browser", "--port", "0"]) == 1
    said = capsys.readouterr().err
    assert says in said
    assert "lab" in said
    assert "Traceback" not in said


def test_the_page_comes_before_the_project_is_read(mine):
    go_on = threading.Event()
    server = Server(lambda: (go_on.wait(20.0), Workbench(mine))[1], TOKEN)
    with TestClient(server.app(), base_url=BASE) as client, ThreadPoolExecutor(1) as other:
        state = other.submit(client.get, "/api/state", headers=HERE)
        assert all(client.get(f"/{name}").status_code == 200 for name in ("", "app.js", "en.json"))
        assert not any((server.work.opened.done(), state.done()))
        go_on.set()
        assert state.result(20.0).json()["tree"]["cameras"]
    assert server.work.bench.folder == mine


def test_a_page_that_is_there_already_says_why_a_project_cannot_be_opened(tmp_path):
    (tmp_path / "survey.toml").write_text("format = ")
    server = Server(lambda: Workbench(tmp_path), TOKEN)
    with TestClient(server.app(), base_url=BASE) as client:
        answer = client.get("/api/state", headers=HERE)
        assert (answer.status_code, "survey.toml:1: not valid TOML" in answer.json()["error"]) == (409, True)
        assert server.work.told.wait(5.0)
    with pytest.raises(SurveyError, match="not valid TOML"):
        server.work.opened.result()


def test_messages_are_in_the_language_that_is_asked_for(mine):
    with page(mine) as client:
        english = post(client, "/api/undo", {"base": 1}).json()["error"]
        german = post(client, "/api/undo", {"base": 1}, **{"X-Language": "de"}).json()["error"]
        other = post(client, "/api/undo", {"base": 1}, **{"X-Language": "tlh"}).json()["error"]
        reason, said = (client.get("/api/state", headers=HERE | {"X-Language": x}).json()["solution"]["reason"]
                        for x in ("de", "en"))  # fmt: skip
    assert english == other == f"{mine}: there is nothing to undo"
    assert german == f"{mine}: nichts kann rückgängig gemacht werden"
    with speaking("de"):
        assert reason == message(said) != said


ENGLISH = re.compile(r"\b(the|is|are|of|and|or|from|with|there|please|no|not|known|found|expected)\b")
DATA = {"title", "label", "solution.solution", "capture.state"}
"""What is of the project or of its files, or a code, whatever the language: keys, some below an address only."""
ASKED = [
    *(("jobs/compare", {"folder": name}) for name in ("other", "nowhere", "new")), ("jobs/plan", {}),
    ("jobs/navigate", {}), ("jobs/detect", {}), ("jobs/detct", {}), ("jobs/add", {"folder": "other"}),
    ("jobs/add", {"folder": "lab"}), ("jobs/init", {"images": "", "folder": ""}),
    ("jobs/init", {"images": "lab", "folder": "other"}),
    ("jobs/show", {"folder": "nowhere"}), ("jobs/batch", {"folders": ["lab", "nowhere"]}),
    *((way, {"changes": [{"name": name, "excluded": True}], "reason": "blur"})
      for way in ("preview", "exclusions") for name in ("nothing", "camera:right")),
    ("exclusions", {"changes": [{"name": "camera:right", "excluded": True}], "reason": "blur"}),
    ("exclusions", {"changes": [{"name": "camera:right", "excluded": True}]}), ("undo", {"base": 1}), ("undo", {}),
    ("redo", {}), ("remedy", {"number": 1}), ("save", {}), ("runs/9/restore", {}), ("runs/9/pin", {}),
    ("runs/x/pin", {}),
    *(("definition", asked) for asked in (
        {"parameter": "lens/left/fx", "treatment": "held"}, {"parameter": "lens/nobody/fx", "treatment": "held"},
        {"parameter": "lens/left/fx", "treatment": "loose"}, {"group": "image", "factor": -1},
        {"group": "image", "factor": 1.2}, {"group": "imag", "factor": 2}, {"datum": "other"},
        {"datum": "inner", "points": ["nobody"]})),
]  # fmt: skip


def texts_in(value, place=""):
    """Texts of an answer that are not data, line by line."""
    if isinstance(value, str):
        yield from ((place, line) for line in value.splitlines())
    elif isinstance(value, dict):
        yield from (found for key, x in value.items() if not {key, f"{place}.{key}"} & DATA
                    for found in texts_in(x, place))  # fmt: skip
    elif isinstance(value, list):
        yield from (found for x in value for found in texts_in(x, place))


@pytest.mark.slow
def test_whatever_is_asked_in_german_nothing_is_said_in_english(mine):
    shutil.copytree(mine, mine.parent / "other")
    (mine.parent / "new").mkdir()
    shutil.copy(mine / "survey.toml", mine.parent / "new")
    german, answers = HERE | {"X-Language": "de"}, []
    with page(mine) as client:
        for way in WAYS:
            if way.method == "GET":
                path = way.path.replace("{camera}/{epoch}", image_of(mine)).replace("{camera}", "left")
                for part in PARTS if "{part}" in path else ("",):
                    for question in ("", "?distance_m=x", "?run=9&a=9", "?other=nobody"):
                        one = path.replace("{part}", part) + question
                        answers.append((one, client.get(one, headers=german)))
        answers += [(path, client.post(f"/api/{path}", json=asked, headers=german)) for path, asked in ASKED]
    with page(mine, read_only=True) as client:
        answers.append(("undo", client.post("/api/undo", json={}, headers=german)))
    assert {answer.status_code for _, answer in answers} == {200, 403, 404, 409}
    said = [(path, *found) for path, answer in answers if answer.headers["content-type"] == "application/json"
            for found in texts_in(answer.json(), path.split("?")[0].split("/")[-1])]  # fmt: skip
    assert len(said) > 1000
    english = [one for one in said if ENGLISH.search(re.sub(r"'[^']*'|--?\w+|\S*[/_]\S*", "", one[-1]))]
    assert "\n".join(map(str, english)) == ""


def test_remedies_jobs_and_the_network_are_asked_for_as_the_page_does(mine):
    with page(mine) as client:
        refused = post(client, "/api/remedy", {"base": 1, "number": 1})
        assert (refused.status_code, "no cause that it could change" in refused.json()["error"]) == (409, True)
        assert post(client, "/api/remedy", {"base": 1}).status_code == 400
        unknown = post(client, "/api/jobs/detct", {})
        assert (unknown.status_code, "detect" in unknown.json()["error"]) == (409, True)
        assert post(client, "/api/jobs/compare", {"folder": "nowhere"}).status_code == 409
        assert client.get("/api/network", headers=HERE).json()["lines"] == []
    with page(mine, read_only=True) as client:
        assert post(client, "/api/jobs/batch", {}).status_code == 403


@pytest.mark.slow
def test_the_page_goes_to_another_project(mine):
    other = shutil.copytree(mine, mine.parent / "other")
    text = (other / "survey.toml").read_text()
    (other / "survey.toml").write_text(re.sub(r"(?m)^title = .*", 'title = "the other"', text))
    (mine.parent / "empty").mkdir()
    with page(mine) as client:
        assert post(client, "/api/jobs/show", {"folder": "empty"}).status_code == 409
        told = post(client, "/api/jobs/show", {"folder": "other"}).json()
        assert told["state"]["title"] == "the other"
        state = client.get("/api/state", headers=HERE).json()
        assert (state["folder"], state["solution"]["verdict"]) == (str(other), told["state"]["solution"]["verdict"])
        rows = post(client, "/api/jobs/batch", {"folders": ["lab", "other"]}).json()["summary"]["rows"]
    assert [Path(row["folder"]).name for row in rows] == ["lab", "other"]
    assert {row["state"] for row in rows} <= {"done", "test_failed"}
    assert all(row["sigma0"] > 0 and row["redundancy"] > 0 and not row["error"] for row in rows)


def test_a_project_in_which_nothing_is_observed_yet_has_no_failure(mine):
    shutil.rmtree(mine / "observations")
    bench = Workbench(mine)
    with TestClient(Server(bench, TOKEN).app(), base_url=BASE) as client:
        state = client.get("/api/state", headers=HERE).json()
        assert (state["empty"], state["failure"], state["solution"], state["n_looked_at"]) == (True, None, None, 0)
        (mine / "survey.toml").write_text((mine / "survey.toml").read_text() + "\n# read again\n")
        assert post(client, "/api/reload", {}).json()["empty"]
        refused = post(client, "/api/adjust", {"mode": "warm"})
        assert (refused.status_code, "there is nothing to adjust" in refused.json()["error"]) == (409, True)
        assert client.get("/api/state", headers=HERE).json()["failure"] is None
    assert bench.situation.definition_text.endswith("# read again\n")
