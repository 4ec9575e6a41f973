"""The cameras' drivers: ``open_camera("pylon:23456789")``, ``discover("gige")``, ``DRIVERS``.

An address is ``driver:rest``. The software of a driver is imported when that driver is named, never before.
"""

from capture.devices.cameras.registry import DRIVERS, DriverDescription, describe_driver, discover, open_camera

__all__ = ["DRIVERS", "DriverDescription", "describe_driver", "discover", "open_camera"]
