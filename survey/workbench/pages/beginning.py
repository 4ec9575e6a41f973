"""A folder as a page begins with it: projects beside it, and one of images that is to become a project."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path

from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.plain import plain
from survey.project.project import DEFINITION_FILE, IMAGES_FOLDER
from survey.report.language import message, text_said
from survey.workbench.pages.capturing import FolderView


@frozen(eq=False)
class Drawn:
    """What a job adds to the scene, in the world (m).

    cameras: ``world_from_camera`` by image. points: with covariances (3, 3) m^2. lines: ends by name. path: positions
    in order, each with its covariance and status. scene: everything, where there is no solution that shows it.
    """

    cameras: Mapping[str, Pose3] = field(default_factory=dict)
    points: Sequence[tuple[str, FloatArray, FloatArray]] = ()
    lines: Sequence[tuple[str, Sequence[FloatArray]]] = ()
    path: Sequence[tuple[str, FloatArray, FloatArray, str]] = ()
    scene: Mapping[str, object] | None = None

    def as_dict(self) -> dict[str, object]:
        """As plain values."""
        return dict(plain({
            "cameras": {name: pose.matrix()[:3].ravel() for name, pose in self.cameras.items()},
            "points": [{"id": name, "x": x, "cov": cov.ravel()} for name, x, cov in self.points],
            "scene": self.scene,
            "lines": [{"id": name, "x": x} for name, x in self.lines],
            "path": [{"id": name, "x": x, "cov": cov.ravel(), "status": s} for name, x, cov, s in self.path],
        }))  # fmt: skip


@frozen(eq=False)
class Told:
    """What a job said: for people, as plain values, and in the scene."""

    text: str
    summary: Mapping[str, object]
    drawn: Drawn = Drawn()

    def as_dict(self) -> dict[str, object]:
        """As plain values; the text and warnings in the language that is spoken."""
        warnings = self.summary.get("warnings")
        said = {"warnings": [message(str(w)) for w in warnings]} if isinstance(warnings, list) else {}
        return {"text": text_said(self.text), "summary": {**self.summary, **said}, "drawn": self.drawn.as_dict()}


class Folder:
    """A folder that a page is about. read_only: nothing is ever written."""

    def __init__(self, folder: str | Path, read_only: bool = False) -> None:
        self.folder, self.read_only = Path(folder), read_only
        self._session = FolderView(self.folder)

    def capture_status(self) -> dict[str, object]:
        """How far a capture session in the folder is, its last images and what they cover, as plain values."""
        return self._session.status()

    def capture_picture(self, camera_id: str, size: int | None = None) -> tuple[bytes, str]:
        """The last image of a camera as bytes and their media type. Raises SurveyError."""
        return self._session.picture(camera_id, size)

    def start(self, images: str | Path, folder: str | Path) -> Told:
        """Begin another project with images that lie beside this one, or anywhere, as ``labsurvey init`` does.

        folder: the new one, beside this one; ``summary["folder"]`` names it. This project stays as it is.
        """
        from survey.jobs.starting import start_project

        self.require_writable()
        if not str(folder).strip():
            raise SurveyError("name the folder of the new project; it is made beside this one")
        outcome = start_project(self.other_folder(images), self.folder.resolve().parent / Path(folder).expanduser())
        return Told(outcome.text(), outcome.summary())

    def show(self, folder: str | Path) -> Told:
        """Another project folder, for a page that is to show it instead of this one: ``summary["folder"]``."""
        path = self.other_folder(folder)
        if not (path / DEFINITION_FILE).is_file():
            raise SurveyError(f"{path}: holds no {DEFINITION_FILE}; begin a project with its images")
        return Told(str(path), {"folder": str(path)})

    def require_writable(self) -> None:
        """Raise SurveyError where nothing may be written."""
        if self.read_only:
            raise SurveyError(f"{self.folder}: is open for reading only; open it without --read-only to change it")

    def other_folder(self, folder: str | Path) -> Path:
        """Another project folder; a relative one lies beside this one. Raises SurveyError."""
        path = self.folder.resolve().parent / Path(folder).expanduser()
        if not str(folder).strip() or not path.is_dir():
            raise SurveyError(f"{folder or 'FOLDER'}: there is no such folder; name it as it lies beside {self.folder}")
        return path


class Beginning(Folder):
    """A folder of images without a survey.toml. Raises SurveyError where there are no images, or no folder."""

    version = 0

    def __init__(self, folder: str | Path, *, read_only: bool = False) -> None:
        super().__init__(folder, read_only)
        from survey.jobs.starting import cameras_in

        here = self.folder.resolve()
        inside = here / IMAGES_FOLDER
        in_place = inside.is_dir() and any(p.is_dir() for p in inside.iterdir())
        self._images = inside if inside.is_dir() else here
        self._new = here if in_place else here.with_name(f"{here.name}-project")
        self._cameras = cameras_in(self._images)

    def state(self) -> dict[str, object]:
        """What there is: number of images by camera, and where the project would be."""
        return {
            "version": 0, "folder": str(self.folder), "read_only": self.read_only,
            "beginning": {"images": str(self._images), "folder": str(self._new),
                          "cameras": {name: len(paths) for name, paths in self._cameras.items()}},
        }  # fmt: skip
