"""Fuzzing guided by coverage: ``python -m tests.fuzz.guided READER [options of libFuzzer] [FOLDER]``; needs atheris.

Inputs that reach new code are kept in the folder of a last argument, as libFuzzer does. What counts as a finding is
the same as without guidance; it ends the run and its input is written as ``crash-...``.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import atheris

_PACKAGES = ["survey", "capture", "csv", "tomllib", "json", "zipfile", "ast"]


def main() -> None:
    """Run until libFuzzer's options say stop."""
    name, *options = sys.argv[1:]
    with atheris.instrument_imports(include=_PACKAGES):
        from adjust.model.errors import SurveyError
        from tests.fuzz.readers import READERS
        from tests.fuzz.watch import Watch

        reader = READERS[name]
        with tempfile.TemporaryDirectory() as folder:
            place, seeds = Path(folder).resolve() / "place", Path(folder) / "seeds"
            place.mkdir()
            seeds.mkdir()
            good = reader.seeds()
            read = reader.prepare(place)
            for i, data in enumerate(good):  # imports what is imported late, instrumented too
                (seeds / str(i)).write_bytes(data)
                read(data)
            words = Path(folder) / "words"
            words.write_text("".join(f'"{_quoted(word)}"\n' for word in reader.dictionary), encoding="ascii")
            watch = Watch(place, 5.0)

            def one(data: bytes) -> None:
                with contextlib.suppress(SurveyError), watch.reading():
                    read(data)

            flags = [o for o in options if o.startswith("-")] + [f"-dict={words}"] * bool(reader.dictionary)
            kept = [o for o in options if not o.startswith("-")]
            atheris.Setup([sys.argv[0], *flags, *kept, str(seeds)], one)
            atheris.Fuzz()


def _quoted(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word)


if __name__ == "__main__":
    main()
