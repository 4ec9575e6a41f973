"""Projects that several modules look at."""

import pytest

from survey.cli import main
from survey.interop.cameras.formats import write_cameras
from survey.jobs.converting import adjusted_values
from survey.project import read
from tests.survey.camera_lab import adjusted_lab


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """Folder of an adjusted head of two cameras, and its values."""
    return adjusted_lab(tmp_path_factory.mktemp("lab") / "lab")


@pytest.fixture
def there_and_back(lab, tmp_path):
    """Writes the project in a format and reads that to a project again, by the command; the new values."""

    def convert(format, name):
        write_cameras(lab[1], tmp_path / name, format, None)
        assert main(["convert", str(tmp_path / name), str(tmp_path / "back"), "--format", format, "--quiet"]) == 0
        return adjusted_values(read(tmp_path / "back"))

    return convert
