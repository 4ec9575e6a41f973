"""``observations/detected.json``: which image the points of the tables come from, by its hash, written by detection.

A hash is trusted as long as size and time of the file are those it was made of; so asking whether images are still the
same costs one look at their directory entries, and reading them only where that tells nothing.
"""

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Literal

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from survey.folder.text import NOT_OURS, read_bytes

DETECTED_FILE = "detected.json"
ImageKey = tuple[str, str]
Status = Literal["found", "nothing", "failed", "given"]
_SETTLED_NS = 2_000_000_000  # file systems keep times to two seconds: what is younger than its hash by less is read
_LARGEST = 2**30


@frozen
class DetectedImage:
    """An image and what became of it. file: its path in the project. sha256, size (bytes), mtime_ns: of the image.

    seen_ns: when the hash was made. looked_for: hash of the targets and spots that it was searched for. status:
    ``given`` where its points were there before any detection. rows: hash of its rows as detection wrote them, so that
    an edit shows; "" for given ones. wrong_size: that a board in it is of another size than declared, and what to
    change. defect: what is wrong with it as an image.
    """

    file: str
    sha256: str
    size: int
    mtime_ns: int
    seen_ns: int
    looked_for: str = ""
    status: Status = "found"
    message: str = ""
    rows: str = ""
    n_image_points: int = 0
    n_spots: int = 0
    wrong_size: str = ""
    defect: str = ""


def read_detected(folder: Path) -> dict[ImageKey, DetectedImage]:
    """What detection wrote into ``folder``; empty where there is nothing. Raises SurveyError for another's file."""
    path = folder / DETECTED_FILE
    if not path.is_file():
        return {}
    try:
        found = json.loads(read_bytes(path, _LARGEST)[0])
        kinds = {f.name: int if f.type is int else str for f in fields(DetectedImage)}
        out = {}
        for name, entry in found["images"].items():
            camera, epoch = name.split("/")
            entry = {"wrong_size": "", "defect": ""} | entry
            if set(entry) != set(kinds) or not all(type(entry[k]) is kind for k, kind in kinds.items()):
                raise ValueError(f"{name} has other entries")
            out[camera, epoch] = DetectedImage(**entry)
    except NOT_OURS as error:
        raise SurveyError(
            f"{path}: is not what detection writes ({error}); remove it: the points in the tables stay and count as "
            "given, 'labsurvey detect --all' finds them anew"
        ) from error
    return out


def detected_text(images: Mapping[ImageKey, DetectedImage]) -> str:
    """The content of the file, one line per image."""
    lines = [f"  {json.dumps('/'.join(key))}: {json.dumps(asdict(images[key]))}" for key in sorted(images)]
    return '{"format": 1, "images": {\n' + ",\n".join(lines) + "\n}}\n"


def same_file(path: Path, known: DetectedImage | None) -> DetectedImage | None:
    """What is known of an image where it still is the file it was, with its time as it is now; None where it is not.

    Its content is read only where size or time differ from those of the hash. Raises SurveyError, OSError.
    """
    if known is None:
        return None
    status = path.stat()
    if status.st_size != known.size:
        return None
    if status.st_mtime_ns == known.mtime_ns and known.mtime_ns + _SETTLED_NS < known.seen_ns:
        return known
    now = file_of(path, known.file)
    return replace(known, mtime_ns=now.mtime_ns, seen_ns=now.seen_ns) if now.sha256 == known.sha256 else None


def file_of(path: Path, name: str) -> DetectedImage:
    """The file of an image, with its hash. Raises SurveyError, OSError."""
    seen, status = time.time_ns(), path.stat()
    return DetectedImage(name, read_bytes(path)[1], status.st_size, status.st_mtime_ns, seen)


@frozen
class ImageNews:
    """Images whose points are not those of the file that is there now, in natural order.

    new: never looked at and without points. changed: another file. sought: it is to be searched for other targets.
    by_hand: changed too, but nothing is looked for in it. gone: no file any more, but points. unseen: points of other
    images were given, but none of these. same: the others, as they are known.
    """

    new: tuple[ImageKey, ...] = ()
    changed: tuple[ImageKey, ...] = ()
    sought: tuple[ImageKey, ...] = ()
    by_hand: tuple[ImageKey, ...] = ()
    gone: tuple[ImageKey, ...] = ()
    unseen: tuple[ImageKey, ...] = ()
    same: Mapping[ImageKey, DetectedImage] | None = None

    @property
    def to_detect(self) -> tuple[ImageKey, ...]:
        """Images whose points are to be found."""
        return (*self.new, *self.changed, *self.sought)

    def notes(self, folder: Path) -> tuple[str, ...]:
        """What is the matter with images, for people."""
        again = f"run 'labsurvey detect {folder}'"
        said = (
            (self.new, f"were never looked at: their targets take no part; {again}"),
            (self.changed, f"have changed since their points were found, which are those of the old images; {again}"),
            (self.sought, f"were searched for other targets than survey.toml names now; {again}"),
            (self.by_hand, f"have changed since their points were given; check those, then {again}"),
            (self.unseen, f"have no points, while those of other images were given; {again} if they should"),
            (self.gone, "are gone, their points are used: exclude them if they should not be"),
        )
        return tuple(f"images: {named(keys)} {what}" for keys, what in said if keys)


def named(keys: Iterable[ImageKey], most: int = 6) -> str:
    """Images by name."""
    return listed(["/".join(key) for key in keys], most)


def image_news(
    images: Mapping[ImageKey, Path], known: Mapping[ImageKey, DetectedImage], with_points: Iterable[ImageKey],
    looked_for: Mapping[ImageKey, str],
) -> ImageNews:  # fmt: skip
    """Compare the images that are there with those that the points come from.

    with_points: images that have points or spots in the tables. looked_for: what each image is to be searched for; the
    others are not. Raises SurveyError, OSError where an image cannot be read.
    """
    pointed = set(with_points)
    given_before = not known and bool(pointed)
    found: dict[str, list[ImageKey]] = {"new": [], "changed": [], "sought": [], "by_hand": [], "unseen": []}
    same: dict[ImageKey, DetectedImage] = {}
    for key, path in images.items():
        entry = known.get(key)
        if entry is None:
            if key in pointed:
                continue
            if key in looked_for:
                found["unseen" if given_before else "new"].append(key)
            continue
        now = same_file(path, entry)
        if now is None:
            found["changed" if key in looked_for else "by_hand"].append(key)
            continue
        same[key] = now
        if now.status == "given":
            if not now.n_image_points + now.n_spots and key not in pointed and key in looked_for:
                found["unseen"].append(key)
        elif now.looked_for != looked_for.get(key, ""):
            found["sought"].append(key)
    gone = tuple(key for key in known if key not in images and key in pointed)
    return ImageNews(**{name: tuple(keys) for name, keys in found.items()}, gone=gone, same=same)
