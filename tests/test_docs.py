"""README and docs: every block is run or at least understood, outputs are what commands print, links lead somewhere.

``tests/docs_pages.py`` says how a page is marked. Pages on the example full-lab run where ``LABSURVEY_DOCS_LAB`` names
its adjusted folder, as ``.ci/run`` does: rendering and detecting its images takes too long for every run of the tests.
"""

import ast
import contextlib
import fnmatch
import io
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from capture.cli import build_parser as capture_parser
from capture.cli import main as labcapture
from survey.cli import build_parser as survey_parser
from survey.cli import main as labsurvey
from tests.data import data_folder
from tests.docs_pages import ROOT, Block, Page, pages, slug

PAGES = pages()
RUN = [p for p in PAGES if p.run == "scratch"]
ON_LAB = [p for p in PAGES if p.run == "lab"]
LAB = os.environ.get("LABSURVEY_DOCS_LAB")
COMMANDS = {"labsurvey": (labsurvey, survey_parser), "labcapture": (labcapture, capture_parser)}
SHELLS = ("sh", "")
# pages whose blocks are carried out by tests of their own
RUN_ELSEWHERE = {
    "docs/planning.md": "tests/acceptance/test_plan.py",
    "docs/check.md": "tests/survey/test_checking.py",
    "docs/observations.md": "tests/survey/test_docs_observations.py",
    "docs/capture.md": "tests/capture/test_plan.py",
    "docs/relay.md": "tests/acceptance/test_relay_cli.py",
}
FORBIDDEN = ("../shared", "/work/", "issue #", "pypi.org")


def named(page: Page) -> str:
    return page.name


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=named)
def test_a_page_runs_from_top_to_bottom(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _run(page)


@pytest.mark.skipif(not LAB, reason="LABSURVEY_DOCS_LAB names no adjusted example full-lab")
@pytest.mark.parametrize("page", ON_LAB, ids=named)
def test_a_page_on_the_example_runs(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(Path(str(LAB)).resolve(), tmp_path / "lab")
    monkeypatch.chdir(tmp_path)
    _run(page)


@pytest.mark.skipif(not LAB, reason="LABSURVEY_DOCS_LAB names no adjusted example full-lab")
def test_the_first_verdict_on_the_example_is_that_all_fits() -> None:
    summary = json.loads((Path(str(LAB)) / "results" / "solution.json").read_text(encoding="utf-8"))["summary"]
    assert (summary["verdict"], summary["fit"]) == ("passed", "fits"), summary["reason"]


def _run(page: Page) -> None:
    with Runner(_free_ports(page)) as runner:
        for block in page.blocks:
            runner.take(block, page)
    assert runner.n_commands > 0


def _free_ports(page: Page) -> dict[str, str]:
    """A free port in place of every fixed one on loopback, so that pages can run side by side."""
    fixed = set(re.findall(r"127\.0\.0\.1:(\d+)", "".join(b.text for b in page.blocks)))
    out = {}
    for port in fixed:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            out[port] = str(free.getsockname()[1])
    return out


class Runner:
    """Carries out the blocks of a page one after the other in the working folder."""

    def __init__(self, ports: dict[str, str]) -> None:
        self.ports, self.printed, self.n_commands = ports, "", 0
        self.names: dict[str, object] = {"__name__": "page"}
        self.background: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> "Runner":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.background:
            process.terminate()
            process.wait(10)

    def take(self, block: Block, page: Page) -> None:
        where = f"{page.name}:{block.line}"
        text = block.text
        for fixed, free in self.ports.items():
            text = text.replace(fixed, free)
        if block.said_of("shown") is not None:
            return
        if (images := block.said_of("images")) is not None:
            _put_images(images)
        if block.said_of("output") is not None:
            compare(text, self.printed, where)
        elif (file := block.said_of("file")) is not None:
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            Path(file).write_text(text, encoding="utf-8")
        elif (file := block.said_of("append")) is not None:
            with Path(file).open("a", encoding="utf-8") as stream:
                stream.write("\n" + text)
        elif block.language == "python":
            self._python(text, where)
        elif block.language in SHELLS:
            lines = commands(text)
            if block.language or lines[0].split()[0] in (*COMMANDS, "python"):  # other plain blocks are no commands
                self.printed = "".join(self._line(line, where) for line in lines)

    def _python(self, text: str, where: str) -> None:
        self.n_commands += 1
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(text, where, "exec"), self.names)
        self.printed = out.getvalue()

    def _line(self, line: str, where: str) -> str:
        self.n_commands += 1
        words, expected = shlex.split(line, comments=True), 0
        told = re.search(r"#.*exit code (\d)", line)
        if told:
            expected = int(told.group(1))
        if words[0] in COMMANDS:
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
                code = COMMANDS[words[0]][0](words[1:])
            printed = out.getvalue() if code != 1 else err.getvalue()
        elif words[-1] == "&":
            self._start(words[:-1])
            return ""
        else:
            words[0] = sys.executable if words[0].startswith("python") else words[0]
            done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=_environment())
            code, printed = done.returncode, done.stdout + done.stderr * (done.returncode == 1)
        assert code == expected, f"{where}: {line}\n{printed}"
        return printed

    def _start(self, words: list[str]) -> None:
        """A program that goes on beside the page; waits until it listens where it was told to."""
        words[0] = sys.executable if words[0].startswith("python") else words[0]
        self.background.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, env=_environment()))
        port = int(words[words.index("--port") + 1])
        for _ in range(300):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
                return
            time.sleep(0.1)
        raise TimeoutError(f"{' '.join(words)} does not listen")


def _environment() -> dict[str, str]:
    """Programs find the examples and the packages as from the project's folder."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def _put_images(told: str) -> None:
    pattern, folder = (part.strip() for part in told.split("->"))
    source, place = data_folder("calibration", "opencv_samples"), Path(folder)
    place.mkdir(parents=True)
    for path in sorted(source.glob(pattern)):
        shutil.copy(path, place / f"{path.stem[-2:]}{path.suffix}")
    assert any(place.iterdir()), f"no images {pattern}"


def commands(text: str) -> list[str]:
    """Command lines of a block: comments and blank lines are none, a backslash goes on."""
    joined = text.replace("\\\n", " ")
    return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]


def compare(shown: str, printed: str, where: str) -> None:
    """Every line shown was printed, in this order, word by word, numbers nearly; without gaps but at ``...``."""
    rest, gap = printed.splitlines(), True
    for line in shown.splitlines():
        if line.strip() == "...":
            gap = True
            continue
        at = next((i for i, found in enumerate(rest) if same(line, found)), None)
        assert at is not None, f"{where}: not printed: {line!r}\nprinted:\n{printed}"
        assert gap or not [x for x in rest[:at] if x.strip()], f"{where}: lines are missing before {line!r}"
        rest, gap = rest[at + 1 :], not line.strip() and gap


def same(a: str, b: str) -> bool:
    """Words alike; numbers within 3 % or a few units of the last digit: other processors round otherwise."""
    of_the_machine = re.compile(r"\d[\d.]* s\b(; retried: [\w ,]+)?")  # how long it took, what it held up
    left, right = (of_the_machine.sub("TIME", x).split() for x in (a, b))
    return len(left) == len(right) and all(x == y or _close(x, y) for x, y in zip(left, right, strict=True))


def _close(x: str, y: str) -> bool:
    number = re.compile(r"^([(\[+]?)(-?[\d.,]+(?:e-?\d+)?)([^\d]*)$")
    a, b = number.match(x), number.match(y)
    if not a or not b or a.group(3) != b.group(3):
        return False
    try:
        p, q = (float(m.group(2).replace(",", "")) for m in (a, b))
    except ValueError:
        return False
    last = 10.0 ** -len(a.group(2).partition(".")[2])
    return abs(p - q) <= max(0.03 * abs(p), 3 * last * (last < 1))


def test_pages_that_are_not_run_here_are_run_by_their_own_tests() -> None:
    for name, test in RUN_ELSEWHERE.items():
        assert (ROOT / name).is_file(), name
        assert (ROOT / test).is_file(), test
        stem = Path(name).stem
        assert stem in (ROOT / test).read_text(encoding="utf-8"), f"{test} does not speak of {name}"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_block_is_understood(page: Page) -> None:
    for block in page.blocks:
        where = f"{page.name}:{block.line}"
        if block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "json":
            json.loads(block.text)
        elif block.language == "python":
            ast.parse(block.text, where)
        elif block.language in SHELLS:
            for line in commands(block.text):
                _understood(line, where)


def _understood(line: str, where: str) -> None:
    """Commands of the project with the flags there are; what else stands in a block may be anything."""
    words = shlex.split(line.replace(" && ", " ; "), comments=True) if line.startswith(tuple(COMMANDS)) else []
    if not words:
        return
    stop = next((i for i, w in enumerate(words) if w in (";", "|", ">", "&") or "..." in w), len(words))
    with contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            COMMANDS[words[0]][1]().parse_args(_without_remark(words[1:stop], line))
            code: object = 0
        except SystemExit as stopped:
            code = stopped.code
    assert code == 0, f"{where}: {line}\n{err.getvalue()}"


def _without_remark(words: list[str], line: str) -> list[str]:
    """Words before a remark that is set apart by blanks, as in a list of commands."""
    command = re.split(r"\s{2,}", line.strip())[0]
    return shlex.split(command, comments=True)[1:] if command != line.strip() else words


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Page) -> None:
    known = {p.path: p.anchors() for p in PAGES}
    for line, link in page.links():
        where, parts = f"{page.name}:{line}: {link}", urlsplit(link)
        if parts.scheme:
            assert parts.scheme in ("https", "http", "mailto"), where
            assert parts.scheme == "mailto" or "." in parts.netloc, where
            continue
        target = (page.path.parent / parts.path).resolve() if parts.path else page.path
        assert target.exists(), where
        assert target.is_relative_to(ROOT), where
        if parts.fragment:
            assert parts.fragment in known.get(target, set()), where


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_pages_speak_of_the_project_alone(page: Page) -> None:
    text = page.path.read_text(encoding="utf-8").lower()
    for word in FORBIDDEN:
        assert word not in text, f"{page.name}: {word}"


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = "\n".join(re.findall(r"```\{toctree\}(.*?)```", index, re.DOTALL)).split()
    docs = [p.path.relative_to(ROOT / "docs").with_suffix("").as_posix() for p in PAGES if p.name.startswith("docs/")]
    missing = [p for p in docs if p != "index" and not any(fnmatch.fnmatch(p, entry) for entry in listed)]
    assert missing == []


def test_numbers_of_readme_stand_in_the_pages_it_links() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    checked = 0
    for line in (x for x in lines if x.startswith("- ") and "](docs/" in x):
        named = re.findall(r"\]\((docs/[\w/-]+\.md)\)", line)
        text = "".join((ROOT / link).read_text(encoding="utf-8") for link in named)
        for number in re.findall(r"\*\*([\d.,]*\d)[^*]*\*\*", line):
            assert number in text, f"README.md says {number}, the pages it names do not"
            checked += 1
    assert checked >= 5


@pytest.mark.parametrize("name", COMMANDS)
def test_readme_names_every_command(name: str) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    rows = set(re.findall(rf"^\| `{name} ([\w-]+)", readme, re.M))
    assert rows == set(COMMANDS[name][1]().commands)


def test_anchors_are_made_as_github_makes_them() -> None:
    assert slug("`survey.toml`: keys & more") == "surveytoml-keys--more"
    assert slug("From your own images") == "from-your-own-images"


def test_outputs_are_compared_and_not_only_read() -> None:
    printed = "sigma0 1.0144   n 354\nnext 3\nlast 5\n"
    compare("sigma0 1.0150   n 354\nnext 3\n", printed, "here")
    compare("sigma0 1.0150   n 354\n...\nlast 5\n", printed, "here")
    compare("taken in 16.1 s\n", "taken in 13.8 s; retried: 1 x TableDisconnected, 2 x FetchTimeout\n", "here")
    for wrong in ("sigma0 1.2144   n 354", "sigma0 1.0144   m 354", "sigma0 1.0144   n 354\nlast 5"):
        with pytest.raises(AssertionError):
            compare(wrong, printed, "here")
