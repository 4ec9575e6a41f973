"""What detection did, for people and programs."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.model.frozen import frozen

if TYPE_CHECKING:  # brings in OpenCV, which a folder that is detected already does without
    from survey.detection import ImageReport


@frozen
class DetectOutcome:
    """What detection did: one report per image that was looked at, the files written, and what people should know.

    n_same: images that are as they were, whose rows stay. notes: on rows of people, on images that are gone.
    defects: images that are wrong as such.
    """

    folder: Path
    reports: "tuple[ImageReport, ...]"
    paths: tuple[Path, ...]
    n_same: int = 0
    notes: tuple[str, ...] = ()
    wrong_sizes: Mapping[str, str] = field(default_factory=dict)
    defects: tuple[str, ...] = ()

    @property
    def messages(self) -> tuple[str, ...]:
        """One line per image that was looked at."""
        return tuple(f"{r.path}: {r.status}{': ' + r.message if r.message else ''}" for r in self.reports)

    @property
    def problems(self) -> tuple[str, ...]:
        """Boards of a wrong size; images that are wrong as such; those without targets, or not readable."""
        lines = (m for m, r in zip(self.messages, self.reports, strict=True) if r.status != "found" and self._news(r))
        return (*self.wrong_sizes.values(), *self.defects, *lines)

    def _news(self, report: "ImageReport") -> bool:
        lacking = missed(report)
        return report.status == "failed" or not lacking or not lacking <= self.wrong_sizes.keys()

    def summary(self) -> dict[str, object]:
        """Counts as plain values."""
        return {
            "folder": str(self.folder),
            "images": len(self.reports),
            "images_unchanged": self.n_same,
            "found": sum(r.status == "found" for r in self.reports),
            "nothing": sum(r.status == "nothing" for r in self.reports),
            "failed": sum(r.status == "failed" for r in self.reports),
            "image_points": sum(len(d) for r in self.reports for d in r.detections.values()),
            "spots": sum(len(r.spots) for r in self.reports if r.spots is not None),
            "notes": list(self.notes),
            "warnings": [*self.wrong_sizes.values(), *self.defects],
            "written": [str(p) for p in self.paths],
        }

    def text(self) -> str:
        """The counts, and every image that gave nothing, for people."""
        s = self.summary()
        head = f"{self.folder}: {s['found']} of {s['images']} images show {s['image_points']} target points"
        head += f" and {s['spots']} spots" if s["spots"] else ""
        if self.n_same:
            same = f"{self.n_same} images are as they were, their points stay (--all finds them anew)"
            head = f"{head}\n  {same}" if self.reports else f"{self.folder}: {same}"
        return "\n".join([head, *(f"  {line}" for line in (*self.problems, *self.notes))])


def missed(report: "ImageReport") -> set[str]:
    """Targets that were looked for in an image and not found."""
    return {target_id for target_id, found in report.detections.items() if not len(found)}
