"""Writing the overview of a batch."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from survey.batch.page import overview_html
from survey.batch.record import Record
from survey.batch.tables import folders_csv, overview_json, trends_csv
from survey.batch.trends import Trends
from survey.folder.replacing import write_set


def write_overview(place: Path, records: Sequence[Record], trends: Trends, language: str = "en") -> dict[str, Path]:
    """Write overview.html, overview.json, folders.csv and trends.csv into ``place``; the paths by name."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    place = Path(place).absolute()
    texts = {
        "folders.csv": folders_csv(records),
        "trends.csv": trends_csv(records, trends),
        "overview.html": overview_html(records, trends, place, date, language),
        "overview.json": overview_json(records, trends),
    }
    return write_set(place, texts)
