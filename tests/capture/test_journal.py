"""The journal: what is in it has happened; a crash damages the last line only."""

import errno
import json

import pytest

from adjust.model.errors import SurveyError
from capture.session.journal import Journal, read_journal


def written(path, n=3):
    journal = Journal(path)
    for i in range(n):
        journal.append("set", epoch_id=f"e{i}", images={})
    journal.close()
    return path.read_bytes()


def test_records_come_back(tmp_path):
    path = tmp_path / "capture" / "journal.jsonl"
    data = written(path)
    records, size, torn = read_journal(path)
    assert [record["epoch_id"] for record in records] == ["e0", "e1", "e2"]
    assert (size, torn) == (len(data), False)
    assert [json.loads(line)["n"] for line in data.splitlines()] == [0, 1, 2]


@pytest.mark.slow
def test_every_cut_leaves_the_whole_lines(tmp_path):
    """The file cut after every single byte: the lines before the cut are there, and appending goes on behind them."""
    path = tmp_path / "journal.jsonl"
    data = written(path)
    for length in range(len(data) + 1):
        path.write_bytes(data[:length])
        journal = Journal(path)
        whole = data[:length].count(b"\n")
        assert len(journal.records) == whole
        assert journal.torn == (length > 0 and not data[:length].endswith(b"\n"))
        journal.append("event", what="go on")
        journal.close()
        records, _, torn = read_journal(path)
        assert (len(records), torn) == (whole + 1, False)


def test_last_line_of_zeros_is_cut(tmp_path):
    """After a power cut the length may be on disk and the content not."""
    path = tmp_path / "journal.jsonl"
    data = written(path)
    path.write_bytes(data + b"\0" * 30 + b"\n")
    journal = Journal(path)
    assert journal.torn
    journal.close()
    assert path.read_bytes() == data


@pytest.mark.parametrize("line", [0, 1])
def test_damage_elsewhere_is_an_error_with_its_line(tmp_path, line):
    path = tmp_path / "journal.jsonl"
    lines = written(path).splitlines(keepends=True)
    lines[line] = b"x" + lines[line][1:]
    path.write_bytes(b"".join(lines))
    with pytest.raises(SurveyError, match=rf"journal\.jsonl:{line + 1}: not a line"):
        Journal(path)


def test_missing_line_is_an_error(tmp_path):
    path = tmp_path / "journal.jsonl"
    lines = written(path, 4).splitlines(keepends=True)
    path.write_bytes(lines[0] + lines[2] + lines[3])
    with pytest.raises(SurveyError, match=r"journal\.jsonl:2"):
        Journal(path)


def test_lost_epochs_are_struck_off_and_may_come_again(tmp_path):
    journal = Journal(tmp_path / "journal.jsonl")
    journal.append("set", epoch_id="a", images={}, attempt=0)
    journal.append("set", epoch_id="b", images={})
    journal.append("lost", epoch_id="a")
    assert list(journal.taken()) == ["b"]
    journal.append("set", epoch_id="a", images={}, attempt=1)
    assert {k: v.get("attempt") for k, v in journal.taken().items()} == {"b": None, "a": 1}
    journal.close()


def test_full_disk_leaves_no_half_line(tmp_path, monkeypatch):
    path = tmp_path / "journal.jsonl"
    data = written(path)
    journal = Journal(path)
    stream = journal._stream

    class Full:
        """Takes ten bytes, then none."""

        def write(self, line):
            if len(line) > 30:
                return stream.write(line[:10])
            raise OSError(errno.ENOSPC, "No space left on device")

        def __getattr__(self, name):
            return getattr(stream, name)

    journal._stream = Full()
    with pytest.raises(OSError, match="No space"):
        journal.append("event", what="x" * 40)
    journal._stream = stream
    assert path.read_bytes() == data
    journal.append("event", what="there is room again")
    journal.close()
    assert len(read_journal(path)[0]) == 4
