"""What a reader that does not see the page needs of it, checked in the browser: names, roles, order."""

from pathlib import Path

FAULTS = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
"""Gives faults as texts, none where all is well; a shorter list than those of tools that check everything."""
