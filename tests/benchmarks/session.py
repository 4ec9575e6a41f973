"""What was asked for, and what has been measured and said so far."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks import plots, tables
from tests.benchmarks.children import Measured, compete
from tests.benchmarks.kinds import Case


class Session:
    """One run of the command."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.quick: bool = options.quick
        self.long: bool = options.long
        self.threads: int = options.threads
        self.doc: Path | None = options.doc
        self.rounds = 3 if self.quick else 5
        self.measured: list[Measured] = []
        self.text: list[str] = []
        self.failures: list[str] = []
        self.claims: list[tuple[str, ...]] = []
        self.top = 0

    def say(self, *lines: str) -> None:
        """To the terminal now and to the document later."""
        for line in lines:
            print(line, flush=True)
            self.text.append(line)

    def compete(
        self, label: str, case: Case, warm: Case | None, names: Sequence[str], budget: float = 60.0,
        rounds: int | None = None,
    ) -> dict[str, Measured]:  # fmt: skip
        """Run and remember."""
        print(f"running: {label}", file=sys.stderr, flush=True)
        found = compete(label, case, warm, names, rounds or self.rounds, self.threads, budget)
        self.measured += found
        return {m.name: m for m in found}

    def picture(
        self, name: str, lines: Sequence[plots.Line], title: str, x_label: str, y_label: str = "s (median)"
    ) -> None:
        """Write a plot beside the document and show it there; the exponents go to the terminal too."""
        lines = [line for line in lines if line.values.size and (line.values == line.values).any()]
        if not lines:
            return
        grown = [line.legend for line in lines if line.exponent == line.exponent]
        if grown:
            self.say("", f"{title}, exponents of growth: {'; '.join(grown)}.")
        if self.doc is not None:
            plots.write(self.doc.parent / "pictures", name, plots.loglog(lines, title, x_label, y_label))
            self.say("", f"![{title}](pictures/benchmark-{name}.svg)")

    def claim(
        self, what: str, measured: float, wanted: float, unit: str = "", least: bool = False, starts: str = ""
    ) -> None:
        """One line of the summary: the measured number is to be at most (or at least) the wanted one.

        starts: what starts from what, where somebody else is compared.
        """
        if measured != measured:
            met = "not measured"
        else:
            met = "yes" if (measured >= wanted if least else measured <= wanted) else "no"
        bound = f"{'at least' if least else 'at most'} {wanted:g} {unit}".strip()
        self.claims.append((what, f"{measured:.3g} {unit}".strip(), bound, met, starts))

    def compare(self, what: str, ratio: float, starts: str, said: str = "") -> None:
        """One line of the summary without a bound: how many times as long as ours the other takes, whoever wins."""
        who = said or ("the other is faster" if ratio < 1.0 else "ours is faster")
        self.claims.append((what, f"{ratio:.3g}", "", "not measured" if ratio != ratio else who, starts))

    def summary(self) -> list[str]:
        """The claims as a table."""
        if not self.claims:
            return []
        how = (
            "Times are those that passed, ratios those of processor time, which a busy machine disturbs least. Ratios "
            "are how many times as long as ours the other takes: below 1 the other is faster. Rows without a wanted "
            "number are there because of who wins, or to show what a faster row leaves out."
        )
        head = ("", "measured", "wanted", "met", "starts from")
        return ["", "## In short", "", how, "", tables.table(head, self.claims)]

    def write(self, path: Path | None) -> None:
        """All measurements as JSON, and the document."""
        if path:
            path.write_text(json.dumps([_plain(m) for m in self.measured], indent=1))
        if self.doc:
            self.doc.parent.mkdir(parents=True, exist_ok=True)
            text = [*self.text[: self.top], *self.summary(), *self.text[self.top :]]
            self.doc.write_text("\n".join(text) + "\n")


def _plain(m: Measured) -> dict[str, object]:
    return {name: value for name, value in vars(m).items() if name != "solution"}
