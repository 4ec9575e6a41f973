"""What fuzzing found once is read again, and some new inputs of every reader; ``python -m tests.fuzz`` does more."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.called import reading_functions
from tests.fuzz.mutate import Mutator
from tests.sizes import size

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
CORPUS = ROOT / "tests" / "fuzz" / "corpus"
NO_READERS = {
    "survey/commands/opening.py:open_project": "a browser",
    "survey/report/markup.py:_Compiled.load_bytecode": "beside the package, as its compiled modules",
    "survey/report/modules.py:bundled": "a part of the package",
    "survey/report/modules.py:looks": "a part of the package",
    "survey/report/page.py:_words": "a part of the package",
    "survey/solution/earlier/runs.py:record_run": "copies what was written or read before",
    "survey/folder/arrays.py:packed_arrays": "writes, into memory",
    "survey/batch/cache.py:fingerprint": "hashes whatever is there",
    "survey/batch/journal.py:Journal.__init__": "opens to write",
    "survey/batch/worker.py:Worker._answer": "a pipe from a process of its own",
    "survey/batch/worker.py:main": "a pipe",
    "survey/batch/worker.py:_listen": "a pipe",
    "survey/commands/common.py:run_command": "the null device",
    "survey/examples/simulated.py:_files": "tables that it has just written",
    "survey/project/declared/toml_text.py:_unquoted": "a key of a document that tomllib has read before",
    "survey/project/merging.py:read_merged": "the copy of a project that was read before",
    "survey/jobs/starting.py:start_project": "copies images that read_image has read before",
    "survey/interop/cameras/colmap_writer.py:reconstruction": "an empty model of pycolmap, to be filled and written",
    "survey/report/page.py:_by_browser": "a PDF that was just printed",
    "survey/report/language.py:catalogue": "the program's own words",
    "survey/workbench/bodies.py:json_of": "a request; tests/survey/test_workbench_hostile.py",
    "survey/workbench/pages/files.py:Files.serve": "the workbench's own files",
    "survey/workbench/pages/files.py:Files._page": "a part of the package",
    "survey/project/declared/editing.py:with_product": "the text of survey.toml, read before",
    "survey/project/declared/editing.py:_with_change": "the text of survey.toml, read before",
    "survey/project/declared/editing.py:_with_keys": "the text of survey.toml, read before",
    "survey/project/declared/editing.py:with_treatment": "the text of survey.toml, read before",
    "capture/devices/cameras/opencv.py:discover": "the system's list of devices",
    "capture/devices/cameras/opencv.py:_serial": "the system's list of devices",
    "capture/devices/cameras/registry.py:open_camera": "a device",
    "capture/devices/turntables/moving.py:MovingTable.open": "a device",
    "capture/devices/turntables/moving.py:MovingTable.reopen": "a device",
    "capture/devices/turntables/moving.py:MovingTable.stop": "a device",
    "capture/session/folder.py:prepare": "copies a template, read by definition_of before",
    "capture/session/quality_thread.py:QualityWatch._judge_one": "opens to write",
    "capture/simulated/controller.py:SimulatedTable.__init__": "opens to write",
    "capture/simulated/pylon_camera.py:LabPylonCamera.open": "a device",
    "capture/session/table_jobs.py:opened_table": "a device",
    "capture/web/serve.py:_file": "the program's own page",
    "capture/web/serve.py:Pages._command": "a request; tests/capture/test_web.py",
}
"""Functions that open or parse something, and why nothing that a stranger has written comes through them."""


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, int], set[str]]:
    """How many inputs every reader stood, and which functions read them; nothing may be found."""
    place = tmp_path_factory.mktemp("fuzz")
    command = [sys.executable, "-m", "tests.fuzz", "--count", str(size(4)), "--seed", "11", "--limit-s", "30",
               "--findings", str(place / "found"), "--called", str(place / "called.json")]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 findings" in done.stdout
    inputs = {name: int(n) for name, n in re.findall(r"^(\S+) +(\d+) inputs ", done.stdout, re.MULTILINE)}
    return inputs, set(json.loads((place / "called.json").read_text()))


def test_what_was_found_is_found_no_more(fuzzed: tuple[dict[str, int], set[str]]) -> None:
    for folder in CORPUS.iterdir():
        assert fuzzed[0][folder.name] == len(list(folder.iterdir())) + size(4), folder.name


def test_every_reader_is_listed_and_stands_new_inputs(fuzzed: tuple[dict[str, int], set[str]]) -> None:
    """Whether a function reads files is seen in its source; whether it is in the list, by running the list."""
    assert set(fuzzed[0].values()) >= {size(4)}
    missing = set(reading_functions()) - fuzzed[1]
    unlisted = sorted(missing - set(NO_READERS))
    assert unlisted == [], unlisted
    assert sorted(set(NO_READERS) - missing) == []


@pytest.mark.parametrize("is_text", [True, False])
def test_inputs_follow_from_their_seed(is_text):
    good = [b"kind,from_id\ndistance,A\n", b"\x00\x01\x02\x03"]
    one, same, other = (Mutator(good, seed, is_text) for seed in (1, 1, 2))
    first = [one.next() for _ in range(50)]
    assert first == [same.next() for _ in range(50)]
    assert first != [other.next() for _ in range(50)]
    assert len(set(first)) > 25
