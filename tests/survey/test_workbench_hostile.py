"""A page of another site, requests of any sort, a project that was made to do harm, others who write at once."""

import json
import shutil
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from survey.cli import main
from survey.folder.locking import LOCK, FileLock
from survey.workbench.addresses import WAYS
from tests.survey.test_workbench import exclusions
from tests.survey.test_workbench_server import HERE, TOKEN, exclude, image_of, page, post

MANY = "9" * 5000  # more digits than Python makes a number of


@pytest.fixture
def mine(lab, tmp_path):
    return shutil.copytree(lab[0], tmp_path / "lab")


@pytest.fixture(scope="module")
def served(lab, tmp_path_factory):
    """A folder and a client of its page, for requests after which both are as before."""
    folder = shutil.copytree(lab[0], tmp_path_factory.mktemp("served") / "lab")
    with page(folder) as client:
        yield folder, client


def address_of(way, number="1"):
    path = way.path.replace("{number:int}", number).replace("{camera}/{epoch}", "left/e01")
    return path.replace("{camera}", "left").replace("{part}", "weak").replace("{name}", "none")


def files_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@contextmanager
def nothing_written(folder):
    before = files_of(folder)
    yield
    assert files_of(folder) == before


@pytest.mark.parametrize("headers", [
    {}, {"X-Token": "x"}, {"Cookie": f"labsurvey={TOKEN}"}, HERE | {"Host": "evil.example"},
    HERE | {"Host": "evil.example:8790"}, HERE | {"Host": "localhost.evil.example"}, HERE | {"Host": ""},
    HERE | {"Origin": "http://evil.example"}, HERE | {"Origin": "null"}, HERE | {"Origin": "http://127.0.0.1:8791"},
    HERE | {"Origin": "http://evil.example", "Host": "evil.example"},
])  # fmt: skip
def test_no_address_answers_another_site(served, headers):
    """Rebound names, foreign and no origins, requests that a form of another page can send; and no token."""
    mine, client = served
    with nothing_written(mine):
        for way in WAYS:
            client.cookies.clear()
            answer = client.request(way.method, address_of(way), headers=headers, json={} if way.changes else None)
            is_picture = way.path.startswith("/api/image/") and "Cookie" in headers
            assert answer.status_code == (404 if is_picture else 403), way.path
            assert "access-control-allow-origin" not in answer.headers
        form = {"Content-Type": "application/x-www-form-urlencoded"}
        for way in (w for w in WAYS if w.method == "POST"):
            assert client.post(address_of(way), content="base=1", headers=HERE | form).status_code == 415, way.path
            assert client.options(address_of(way), headers=headers).status_code in (403, 405)


KIND = {"Content-Type": "application/json"}
BODIES = (
    '{"base": NaN, "factor": NaN, "group": "image", "number": NaN}',
    '{"base": 1, "group": "image", "factor": Infinity}', '{"base": 1, "group": "image", "factor": -1}',
    '{"number": 1e400, "add": 1e400, "place": -1e400}',
    f'{{"base": {"9" * 5000}, "number": {"9" * 5000}}}', '{"a":' * 50_000, "[" * 50_000, '{"number": "1", "mode": 3}',
    '{"changes": [[]], "folders": [1], "folder": "\\u0000", "images": "\\u0000"}',
    '{"images": "x", "folder": "/proc/x/y"}', '{"base": true}',
    '{"base": 0, "parameter": "../../x", "treatment": "held"}', '{"base": 0, "datum": "given", "points": "x"}',
    '{"folder": "../../../../etc", "folders": ["../../../../etc"]}', '{"wanted": "' + "(" * 900 + '"}',
    '{"base": 0, "changes": [{"name": "image:' + "A" * 5000 + '", "excluded": true}], "reason": "x"}', "null", "1",
)  # fmt: skip


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_whatever_a_body_says_is_answered_in_a_line(mine, body):
    """Nothing but what asks for nothing may pass; no server error, and no file changes."""
    with page(mine) as client, nothing_written(mine.parent):
        for way in (w for w in WAYS if w.method == "POST" and "save" not in w.calls and "batch" not in w.calls):
            answer = client.post(address_of(way), content=body.encode(), headers=HERE | KIND)
            allowed = (400, 404, 409) if way.changes else (200, 400, 409)
            assert answer.status_code in allowed, f"{way.path} {answer.status_code} {answer.text[:300]}"
            assert "Traceback" not in answer.text


@pytest.mark.slow
@pytest.mark.parametrize("query", [
    f"worst={MANY}&layout={MANY}&size={MANY}&a={MANY}&b={MANY}&run={MANY}&most={MANY}",
    "worst=-1&layout=nan&size=0&a=x&b=-1&most=-5&distance_m=nan", "distance_m=-inf&size=%00&image=%00/%00&other=%00",
    "image=../../etc/passwd&other=../x&distance_m=1e999&size=1e9&worst=%D9%A3", "distance_m=" + MANY,
])  # fmt: skip
def test_whatever_an_address_asks_is_answered_in_a_line(served, query):
    mine, client = served
    client.cookies.clear()
    with nothing_written(mine):
        for way in (w for w in WAYS if w.method == "GET"):
            answer = client.get(f"{address_of(way)}?{query}", headers=HERE)
            assert answer.status_code in (200, 404, 409), way.path
        for path in (f"/api/runs/{MANY}/restore", f"/api/runs/{MANY}/pin"):
            assert post(client, path, {}).status_code in (404, 405, 409)
        for name in ("%00", "..", "%2e%2e%2f%2e%2e%2fetc%2fpasswd", "left%00", "\u202e", "a" * 4000):
            for path in (f"/api/image/{name}/e01", f"/api/image/left/{name}", f"/api/camera/{name}", f"/{name}"):
                assert client.get(path, headers=HERE).status_code in (200, 404, 409), path


def test_the_policy_allows_nothing_inline_and_the_token_is_in_no_address(served):
    _, client = served
    client.cookies.clear()
    for path, headers in (("/", {}), ("/app.js", {}), ("/nope", {}), ("/api/state", HERE), ("/api/nope", HERE)):
        answer = client.get(path, headers=headers)
        policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
        assert policy["default-src"] == "'self'"
        assert policy["frame-ancestors"] == policy["base-uri"] == policy["form-action"] == "'none'"
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert TOKEN not in answer.text + str(answer.url)
    assert client.get(f"/api/state?token={TOKEN}&X-Token={TOKEN}").status_code == 403


def test_links_lead_nowhere_outside(mine, tmp_path):
    """An image or a folder of images that is a link: what it leads to is not shown."""
    left = image_of(mine).split("/")[1]
    secret = tmp_path / "secret"
    (secret / "left").mkdir(parents=True)
    cv2.imwrite(str(secret / "left" / f"{left}.png"), np.full((60, 80), 90, np.uint8))
    (mine / "images").mkdir(exist_ok=True)
    shutil.rmtree(mine / "images/left", ignore_errors=True)
    path = f"/api/image/left/{left}"
    for link, to in ((mine / "images/left", secret / "left"), (None, None)):
        if link is not None:
            link.symlink_to(to)
        else:
            (mine / "images/left").unlink()
            (mine / "images/left").mkdir()
            (mine / "images/left" / f"{left}.png").symlink_to(secret / "left" / f"{left}.png")
        with page(mine, read_only=True) as client:
            answer = client.get(path, headers=HERE)
            assert answer.status_code in (404, 409)
            assert answer.headers["content-type"] == "application/json"


@pytest.mark.slow
def test_a_command_that_writes_at_the_same_time_loses_nothing(mine):
    """While another keeps the folder a decision is refused, told who has it, and can be made again."""
    first = image_of(mine)
    with page(mine) as client:
        with FileLock(mine / LOCK, mine, "command"), nothing_written(mine):
            refused = post(client, "/api/exclusions", exclude(f"image:{first}", 1))
            assert refused.status_code == 409
            assert refused.json()["retry"]
            assert post(client, "/api/save", {}).status_code == 409
        assert post(client, "/api/exclusions", exclude(f"image:{first}", 1)).status_code == 200
        assert main(["adjust", str(mine), "--quiet"]) in (0, 3), "with what the page has just left out"
        runs = client.get("/api/runs", headers=HERE).json()["runs"]
        inputs = json.loads((mine / "results/solution.json").read_text())["inputs"]
        assert "observations/exclusions.csv" in inputs["hashes"]
        assert post(client, "/api/save", {}).status_code == 200
        assert [r["number"] for r in client.get("/api/runs", headers=HERE).json()["runs"]][-len(runs) :] == [
            r["number"] for r in runs
        ]
        table = mine / "observations/image_points.csv"
        lines = table.read_text().splitlines()
        table.write_text("\n".join(lines[:-1]) + "\n")  # as another detection would
        state = client.get("/api/state", headers=HERE).json()
        assert state["changed_files"] == ["observations/image_points.csv"]
        assert post(client, "/api/undo", {"base": state["version"]}).json()["retry"]
        after = post(client, "/api/reload", {}).json()
        assert (after["changed_files"], len(after["exclusions"])) == ([], 1)
    assert table.read_text().splitlines() == lines[:-1]
    assert len(exclusions(mine)) == 1
