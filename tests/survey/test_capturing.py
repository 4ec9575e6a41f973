"""A capture session watched by its files: read once, never trusted, shown in the workbench."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from starlette.testclient import TestClient

from survey.project.captured import Qualities, quality_path, session_status, status_path
from survey.workbench.pages import capturing
from survey.workbench.pages.capturing import FolderView
from survey.workbench.server import Server
from survey.workbench.session import Workbench
from tests.survey.test_workbench_server import BASE, HERE, TOKEN


def said(folder: Path, epoch: str, **more: Any) -> None:
    status_path(folder).parent.mkdir(exist_ok=True)
    told = {"state": "finished", "done": 1, "total": 4, "epoch_id": epoch, "images": {"X": "x"}} | more
    status_path(folder).write_text(json.dumps(told))


def seen(folder: Path, epoch: str, uv: list[list[float]], camera: str = "X", end: str = "\n") -> None:
    row = {"camera_id": camera, "epoch_id": epoch, "width": 100, "height": 80, "points": {"board": uv}}
    with quality_path(folder).open("a") as stream:
        stream.write(json.dumps(row) + end)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images/X").mkdir(parents=True)
    for epoch in ("e1", "e2"):
        cv2.imwrite(str(tmp_path / f"images/X/{epoch}.png"), np.full((80, 100), 90, np.uint8))
    said(tmp_path, "e1")
    return tmp_path


def test_an_image_is_decoded_once_and_its_points_are_looked_for_again(folder, monkeypatch):
    from survey.detection import gray

    read, decoded = gray.read_image, []
    monkeypatch.setattr(gray, "read_image", lambda path: (decoded.append(path.stem), read(path))[1])
    view = FolderView(folder)
    for _ in range(3):
        assert view.status()["shown"]["X"] == {"size": [100, 80], "points": []}
    seen(folder, "e1", [[10.0, 20.0]])
    status = view.status()
    assert status["shown"]["X"]["points"] == [[10.0, 20.0]]
    assert status["coverage"]["X"]["hit"] == [[1, 2]]
    assert decoded == ["e1"]
    said(folder, "e2")
    assert view.status()["shown"]["X"]["points"] == []
    said(folder, "e2", state="running")
    assert view.status()["state"] == "broken off", "no process holds the folder"
    assert decoded == ["e1", "e2"]
    cv2.imwrite(str(folder / "images/X/e2.png"), np.full((40, 50), 90, np.uint8))  # taken again
    os.utime(folder / "images/X/e2.png", ns=(1, 1))
    assert view.status()["shown"]["X"]["size"] == [50, 40]


def test_of_the_lines_only_what_was_added_is_read(folder):
    found = Qualities(folder)
    found.read()
    assert found.rows == {}
    seen(folder, "e1", [[5.0, 5.0]])
    seen(folder, "e2", [[95.0, 75.0]], end="")  # not whole yet
    found.read()
    assert (list(found.rows), found.coverage["X"].hit) == ([("X", "e1")], {(0, 0)})
    with quality_path(folder).open("a") as stream:
        stream.write("\n")
    found.read()
    assert found.coverage["X"].hit == {(0, 0), (9, 7)}
    seen(folder, "e1", [[45.0, 5.0]])  # the image was taken again: what the first showed counts no more
    found.read()
    assert found.coverage["X"].hit == {(4, 0), (9, 7)}
    quality_path(folder).write_text("")
    seen(folder, "e9", [])
    found.read()
    assert (list(found.rows), found.coverage["X"].hit) == ([("X", "e9")], frozenset())
    before = found.rows
    quality_path(folder).unlink()
    found.read()
    assert found.rows is before


@pytest.mark.parametrize("line", [
    '{"camera_id": "../../etc", "epoch_id": "e1", "width": 9, "height": 9, "points": {}}', "[" * 90_000, "\\",
    '{"camera_id": "X", "epoch_id": "e1", "width": 1e9, "height": 9, "points": {}}', "null", '{"camera_id": "X"}',
    '{"camera_id": "X", "epoch_id": "e1", "width": 9, "height": 9, "points": {"b": [[NaN, 1]]}}',
])  # fmt: skip
def test_what_no_session_writes_is_not_taken(folder, line):
    quality_path(folder).write_text(f"{line}\n")
    found = Qualities(folder)
    found.read()
    assert found.rows == {}
    for text in (line, '{"state": "x", "epoch_id": "../../x"}', '{"state": "x", "images": {"../x": "y"}}'):
        status_path(folder).write_text(text)
        assert session_status(folder) == {}
    assert FolderView(folder).status()["cameras"] == []


def test_links_are_not_followed(folder, tmp_path):
    (folder / "images/X/e1.png").unlink()
    (folder / "images/X/e1.png").symlink_to(folder / "images/X/e2.png")
    assert FolderView(folder).status()["shown"] == {}
    with pytest.raises(capturing.SurveyError, match="is a link"):
        FolderView(folder).picture("X", None)


def test_the_workbench_says_it_under_its_guard(lab, folder):
    bench = Workbench(lab[0], read_only=True)
    bench._session = FolderView(folder)
    with TestClient(Server(bench, TOKEN).app(), base_url=BASE) as client:
        assert client.get("/api/capture").status_code == 403
        assert client.get("/api/capture", headers=HERE).json()["shown"]["X"]["size"] == [100, 80]
        assert client.get("/api/capture/X").status_code == 403
        answer = client.get("/api/capture/X?size=50", headers=HERE)
        assert answer.headers["content-type"] == "image/jpeg"
        for name in ("Y", "..%2f..%2fetc", "%00"):
            assert client.get(f"/api/capture/{name}", headers=HERE).status_code in (404, 409)
