"""Cameras of the simulated laboratory.

``lab:FOLDER/X`` renders in this process; ``lab:FOLDER/X?via=pylon:0815-0000`` sends what is seen through pylon's
emulator (``PYLON_CAMEMU=3``), which loads it from image files when it is triggered. ``&angles=FILE`` reads the table's
angles from another file than ``FOLDER/angles.json``; ``&faults=timeout@5`` as for ``simulated``.
"""

from functools import partial
from pathlib import Path
from urllib.parse import parse_qs

from adjust.model.errors import SurveyError
from capture.devices.camera import Camera
from capture.devices.cameras.simulated import SimulatedCamera, parsed_faults
from capture.simulated.angles import Angles, AnglesFile
from capture.simulated.folder import ANGLES, read_lab
from capture.simulated.laboratory import SimulatedLab
from survey.simulate.rendering import GrayImage


def camera(place: str, angles: Angles | None = None) -> Camera:
    """The camera, not opened. angles: how the table stands, in place of the file."""
    path, _, query = place.partition("?")
    options = {key: values[-1] for key, values in parse_qs(query).items()}
    if unknown := set(options) - {"via", "angles", "faults"}:
        raise SurveyError(f"camera lab:{place}: option {unknown.pop()!r} is not known; there are via, angles, faults")
    folder, name = Path(path).parent, Path(path).name
    lab = read_lab(folder)
    stands = angles or AnglesFile(Path(options.get("angles", folder / ANGLES)))
    seen = partial(_seen, lab, name, stands)
    if "via" not in options:
        return SimulatedCamera(path, seen, parsed_faults(options.get("faults", "")), "lab")
    driver, _, serial = options["via"].partition(":")
    if driver != "pylon":
        raise SurveyError(f"camera lab:{place}: via {driver!r} is not known; give via=pylon:SERIAL, or gige:127.0.0.1")
    from capture.devices.cameras.registry import load_driver  # pylon is there only where its extra is installed

    load_driver("pylon")
    from capture.simulated.pylon_camera import LabPylonCamera

    return LabPylonCamera(serial, seen)


def _seen(lab: SimulatedLab, name: str, angles: Angles, exposure_us: float, gain_db: float) -> GrayImage:
    return lab.image(name, angles(), exposure_us, gain_db)
