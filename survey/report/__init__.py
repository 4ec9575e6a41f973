"""Reports of an adjustment: one self-contained HTML page, and a summary for the terminal. They print, nothing more."""

from survey.report.page import report_html
from survey.report.terminal import summary_text

__all__ = ["report_html", "summary_text"]
