"""The examples without images, by name."""

from collections.abc import Callable

from survey.examples.alignment import alignment_files
from survey.examples.beacons import beacon_files
from survey.examples.relay import relay_files
from survey.examples.simulated import head_files, station_files

WITHOUT_IMAGES: dict[str, Callable[[int], dict[str, str]]] = {
    "total-station": beacon_files,
    "alignment": alignment_files,
    "relay": relay_files,
    "relay-station": station_files,
    "head": head_files,
}
