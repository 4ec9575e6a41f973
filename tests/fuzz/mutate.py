"""Damaged versions of good files: words replaced, lines lost or doubled, bytes turned, two files spliced."""

import random
import re
from collections.abc import Iterator, Sequence

_WORD = re.compile(rb"[^\s<>=\"',:;{}\[\]()/]+")
WORDS = [
    b"", b"0", b"-1", b"1", b"2", b"nan", b"inf", b"-inf", b"1e400", b"1e-400", b"1e300", b"-1e300", b"1e-300", b"1_0",
    b"9" * 30, b"9" * 400, b"9" * 5000, b"4294967296", b"2147483648", b"100000000", b"-9223372036854775808",
    b"0x7fffffff", b"true", b"false", b"null", b"[]", b"{}", b'""', b"[[]]", b"'''", b'"""', b"A", b"B", b"B1", b"xyz",
    b"XYZ", b"360-00-00", b"-0-0-0", "°".encode(), b"\x00", "é".encode(), b"<", b"&amp;", b"&x;", b"[Datum]", b"*END",
    b"/", b"\\", b"%", b"..", b"../../../../etc/passwd", b"/etc/passwd", b"/dev/zero", b"C:\\x", b"CON", b"~",
    b"1e15", b"0.0000001", "٣".encode(), "²".encode(), "\u202e".encode(), "\ud7ff".encode(), b"\xff\xfe",
    b"{0.__class__}", b"%s%n", b"__class__", b"a.b.c.d", b"x" * 300, b"[" * 300, b"(a+)+$", b"{value:>999999999}",
    b"1979-05-27", b"07:32:00", b"+0.0", b"-0", b"1.", b".5", b"1e", b"\r", b"\n", b"\r\n", b"\t", b" ", b",", b"=",
    b"#", b"\xef\xbb\xbf",
]  # fmt: skip


class Mutator:
    """Endless damaged versions of ``seeds``; the same ``seed`` gives the same ones."""

    def __init__(self, seeds: Sequence[bytes], seed: int, is_text: bool, dictionary: Sequence[bytes] = ()) -> None:
        self._random = random.Random(seed)
        self._seeds = list(seeds)
        self._words = [*WORDS, *dictionary]
        own = {w for text in seeds for w in _WORD.findall(text)} if is_text else set()
        self._own = sorted(own)
        self._moves = (
            (self._word, self._word, self._word, self._line, self._double, self._cut, self._insert, self._byte,
             self._splice)
            if is_text
            else (self._byte, self._byte, self._byte, self._integer, self._integer, self._cut, self._splice,
                  self._insert, self._repeat)
        )  # fmt: skip

    def next(self) -> bytes:
        """A good file with one to five faults."""
        data = self._random.choice(self._seeds)
        for _ in range(self._random.choice((1, 1, 1, 2, 2, 3, 5))):
            data = self._random.choice(self._moves)(data)
        return data

    def _any_word(self) -> bytes:
        return self._random.choice(self._own if self._own and self._random.random() < 0.35 else self._words)

    def _word(self, data: bytes) -> bytes:
        words = list(_WORD.finditer(data))
        if not words:
            return self._any_word()
        word = self._random.choice(words)
        return data[: word.start()] + self._any_word() + data[word.end() :]

    def _line(self, data: bytes) -> bytes:
        lines = data.split(b"\n")
        del lines[self._random.randrange(len(lines))]
        return b"\n".join(lines)

    def _double(self, data: bytes) -> bytes:
        lines = data.split(b"\n")
        lines.insert(self._random.randint(0, len(lines)), self._random.choice(lines))
        return b"\n".join(lines)

    def _cut(self, data: bytes) -> bytes:
        at = self._random.randint(0, len(data))
        return data[:at] if self._random.random() < 0.5 else data[at:]

    def _insert(self, data: bytes) -> bytes:
        at = self._random.randint(0, len(data))
        return data[:at] + self._any_word() + data[at:]

    def _byte(self, data: bytes) -> bytes:
        if not data:
            return bytes([self._random.randrange(256)])
        out = bytearray(data)
        out[self._random.randrange(len(out))] = self._random.choice((0, 1, 127, 128, 255, self._random.randrange(256)))
        return bytes(out)

    def _integer(self, data: bytes) -> bytes:
        size = self._random.choice((2, 4, 8))
        if len(data) < size:
            return self._byte(data)
        value = self._random.choice((0, 1, -1, 2 ** (8 * size - 1) - 1, 100_000, 65_535, self._random.getrandbits(16)))
        raw = (value % 2 ** (8 * size)).to_bytes(size, self._random.choice(("little", "big")))
        at = self._random.randint(0, len(data) - size)
        return data[:at] + raw + data[at + size :]

    def _splice(self, data: bytes) -> bytes:
        other = self._random.choice(self._seeds)
        return data[: self._random.randint(0, len(data))] + other[self._random.randint(0, len(other)) :]

    def _repeat(self, data: bytes) -> bytes:
        a, b = sorted(self._random.randint(0, len(data)) for _ in range(2))
        return data[:b] + data[a:b] + data[b:]


def nonsense(seed: int, marks: str = "<>[]{}(),;:=*#\"' \n01.-eE") -> Iterator[bytes]:
    """Endless short files of no format: any bytes, characters of any script, characters of the ``marks``."""
    of = random.Random(seed)
    scripts = [chr(code) for code in (*range(0x3000), *range(0x1F600, 0x1F650))]
    while True:
        for kind in (range(256), scripts, marks):
            drawn = of.choices(kind, k=of.randrange(201))
            yield bytes(drawn) if isinstance(kind, range) else "".join(drawn).encode()
