"""Batches from Python: ``survey.adjust_many(folders)``."""

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.batch.charts import control_chart
from survey.batch.page import write_overview
from survey.batch.record import CAUSES, FAILED, Record
from survey.batch.run import BatchOptions, counts, run_batch
from survey.batch.tables import STATES, count_line, findings, short_names, summary_table
from survey.batch.trends import Trends, trends_of
from survey.folder.text import suggestion
from survey.notebook.frames import frame, of_rows
from survey.notebook.names import heading, html_table
from survey.notebook.plots import Plot
from survey.report.drawing import ON_WHITE, standalone


@frozen(eq=False)
class Batch:
    """Records of all folders, in their order; data frames, control charts by name, an overview report."""

    records: tuple[Record, ...]

    @cached_property
    def trends(self) -> Trends:
        """Control charts of all numbers, most alarming first."""
        return trends_of(self.records)

    @property
    def failed(self) -> tuple[Record, ...]:
        """What could not be adjusted."""
        return tuple(r for r in self.records if r.state == FAILED)

    @property
    def folders(self) -> Any:
        """Data frame: state and key figures of each folder."""
        return frame(self.records, ["folder"], {
            **{k: k for k in ("folder", "state", "origin")},
            "sigma0": lambda r: r.summary.get("sigma0"), "redundancy": lambda r: r.summary.get("redundancy"),
            "verdict": lambda r: r.summary.get("verdict", ""), **{k: k for k in ("seconds", "tries", "cause")},
            "message": lambda r: r.error or r.summary.get("reason", ""),
        })  # fmt: skip

    @property
    def values(self) -> Any:
        """Data frame: every number of every folder with its sigma; (name, folder) is the index."""
        rows = ((c.series.name, self.records[int(e)].folder, v, s, c.series.unit, c.mean, bool(o))
                for c in self.trends.charts for e, v, s, o in zip(
                    c.series.epoch, c.series.value, c.series.sigma, c.outside, strict=True))  # fmt: skip
        return of_rows(rows, ["name", "folder"], "value", "sigma", "unit", "mean", "outside")

    @property
    def charts(self) -> Any:
        """Data frame: mean, scatter, slope and findings of every number, most alarming first."""
        names = short_names(self.records)
        return frame(self.trends.charts, ["name"], {
            "name": "series.name", "unit": "series.unit", "n": lambda c: len(c.series.value), "mean": "mean",
            "sigma_mean": "mean_sigma", "ratio": "ratio", "p": "p", "slope": "slope", "sigma_slope": "slope_sigma",
            "p_slope": "p_slope", "in_control": lambda c: not self.trends.is_alarming(c),
            "findings": lambda c: "; ".join(findings(self.trends, c, names)),
        })  # fmt: skip

    def plot(self, name: str) -> Plot:
        """The control chart of a number, such as ``lens/left/fx``. Raises SurveyError for one that there is not."""
        for c in self.trends.charts:
            if c.series.name == name:
                failed = [i for i, r in enumerate(self.records) if r.state == FAILED]
                drawn = control_chart(c, short_names(self.records), failed, name)
                return Plot(name, standalone(drawn, ON_WHITE))
        known = [c.series.name for c in self.trends.charts]
        raise SurveyError(f"there is no number {name!r} in two epochs or more; {suggestion(name, known)}")

    def report(self, folder: str | Path, *, language: str = "en") -> dict[str, Path]:
        """Write overview.html, overview.json, folders.csv and trends.csv into ``folder``; the paths by name."""
        return write_overview(Path(folder), self.records, self.trends, language)

    def __len__(self) -> int:
        """Number of folders."""
        return len(self.records)

    def __repr__(self) -> str:
        """The table that the command line prints."""
        return summary_table(self.records)

    def _repr_html_(self) -> str:
        rows = []
        for r, name in zip(self.records, short_names(self.records), strict=True):
            sigma0 = r.summary.get("sigma0")
            said = r.error.splitlines()[0] if r.error else ""
            rows.append((name, STATES[r.state] if r.state != FAILED else CAUSES[r.cause],
                         "" if sigma0 is None else f"{sigma0:.3f}", said))  # fmt: skip
        n = counts(self.records)
        return heading(f"Batch of {n['folders']}", count_line(self.records)) + html_table(
            ("folder", "state", "sigma0", ""), rows
        )


def adjust_many(
    folders: Iterable[str | Path],
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    report: str | Path | None = None,
    resume: bool = False,
    fresh: bool = False,
    redetect: bool = False,
    retries: int = 1,
    progress: bool = False,
    language: str = "en",
) -> Batch:
    """Adjust many folders side by side, past failures, and write their results; what is unchanged is kept.

    The same as ``labsurvey adjust FOLDER...``: see :class:`survey.batch.run.BatchOptions` and docs/batch.md. It needs
    no guard of the main module. Raises SurveyError where nothing could be begun.
    """
    place = Path(report) if report is not None else None
    options = BatchOptions(jobs, scheduler, place, resume, fresh, redetect, retries, progress)
    batch = Batch(run_batch([Path(f) for f in folders], options))
    if place is not None:
        batch.report(place, language=language)
    return batch
