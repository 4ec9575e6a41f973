"""Ready project folders to try the software on: rendered images, tables of readings, and the truth beside them.

``truth.json`` is for people and tests; no command reads it.
"""

from pathlib import Path

from adjust.model.errors import SurveyError

EXAMPLES = {
    "full-lab": "three-camera head on a two-axis table, board, wall plates, beacons, relay station of four cameras",
    "stereo": "two cameras and a checkerboard held by hand",
    "one-camera": "one camera and a checkerboard held by hand",
    "total-station": "beacons of a laboratory by total station, caliper and levelling; no images",
    "alignment": "board to be made parallel to a turntable by levels and a laser's trace; no images",
    "relay": "thirty stations through four rooms and a corridor, joined by measured pairs; no images",
    "relay-station": "four cameras on one station, each before a plate of its own; image points, no images",
    "head": "three-camera head on a two-axis table before one board; image points, no images",
}


def write_example(name: str, folder: Path, *, seed: int = 1, jobs: int | None = None, progress: bool = False) -> int:
    """Write the example ``name`` into the new or empty ``folder``; the number of its images.

    Equal seeds give equal folders. jobs: images rendered at a time, by default one per processor. progress: a bar on
    stderr. The folder appears when everything in it is complete. Raises SurveyError for an unknown name or a folder
    that holds something.
    """
    if name not in EXAMPLES:
        raise SurveyError(f"example {name!r}: unknown; choose one of {', '.join(EXAMPLES)}")
    from survey.examples.alignment import alignment_files
    from survey.examples.beacons import beacon_files
    from survey.examples.folders import MAKERS
    from survey.examples.pictures import write_images
    from survey.examples.relay import relay_files
    from survey.examples.simulated import head_files, station_files

    without_images = {"total-station": beacon_files, "alignment": alignment_files, "relay": relay_files,
                      "relay-station": station_files, "head": head_files}  # fmt: skip
    draft, files = MAKERS[name](seed) if name in MAKERS else (None, without_images[name](seed))
    from survey.folder.whole import whole_folder  # here: the command line asks this module for its names alone

    with whole_folder(Path(folder)) as place:
        for path, text in files.items():
            (place / path).parent.mkdir(parents=True, exist_ok=True)
            (place / path).write_text(text, encoding="utf-8")
        if draft is not None:
            write_images(draft, place / "images", seed, jobs, progress)
    return len(draft.shots) if draft is not None else 0
