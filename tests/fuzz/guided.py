"""Fuzzing guided by coverage: ``python -m tests.fuzz.guided READER [options of libFuzzer]``; needs atheris.

New inputs that reach new code are kept in the folder of a last argument, as libFuzzer does.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import atheris

from adjust.errors import SurveyError

with atheris.instrument_imports(include=["survey.files", "survey.interop", "survey.previous", "capture.plan", "csv"]):
    from tests.fuzz.readers import READERS


def main() -> None:
    """Run until libFuzzer's options say stop; a finding ends the run and is written as ``crash-...``."""
    name, *options = sys.argv[1:]
    reader = READERS[name]
    with tempfile.TemporaryDirectory() as folder:
        place, seeds = Path(folder) / "place", Path(folder) / "seeds"
        place.mkdir()
        seeds.mkdir()
        read = reader.prepare(place)
        for i, data in enumerate(reader.seeds()):
            (seeds / str(i)).write_bytes(data)
            read(data)

        def one(data: bytes) -> None:
            with contextlib.suppress(SurveyError):
                read(data)

        kept = [o for o in options if not o.startswith("-")]
        flags = [o for o in options if o.startswith("-")]
        atheris.Setup([sys.argv[0], *flags, *kept, str(seeds)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
