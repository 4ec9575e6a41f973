"""The section [table] of a capture plan, and the table that it describes."""

import math
from dataclasses import field
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from capture.devices.turntable import Axis, Controller, Settle
from capture.devices.turntables.moving import MovingTable
from capture.plan.given import with_given
from survey.project.declared.node import Node

DRIVERS = {
    "ascii": "lines of text over serial port or TCP, by dialect; address: /dev/ttyUSB0, socket://HOST:PORT",
    "standa": "Standa 8SMC through libximc; address of each axis: xi-com:///dev/ttyACM0, xi-emu:///FILE",
    "epics": "EPICS motor records; address of each axis: its prefix, lab:m1",
    "simulated": "a table in this process, for drills",
}
_TABLE = ("id", "driver", "address", "dialect", "units", "sigma_arcsec", "axes", "settle", "home")
_AXIS = (
    "limits_deg",
    "wraps",
    "speed_deg_s",
    "acceleration_deg_s2",
    "sign",
    "zero_deg",
    "channel",
    "address",
    "steps_per_deg",
    "backlash_arcsec",
    "noise_arcsec",
)


@frozen
class AxisPlan:
    """An axis and how its controller counts: angle = sign * (controller's angle) + zero, rad.

    where: channel of the controller, or an address of its own. backlash, noise: of the simulated table, rad.
    """

    axis: Axis
    where: str
    sign: int = 1
    zero: float = 0.0
    steps_per_deg: float = 0.0
    backlash: float = 0.0
    noise: float = 0.0


@frozen(eq=False)
class TablePlan:
    """A table of the project: its axes outermost first, how it is reached, when it counts as settled.

    sigma: (n,) rad, of one reading; None: as the survey says. base: folder that a dialect's path starts from.
    """

    table_id: str
    driver: str
    axes: tuple[AxisPlan, ...]
    address: str = ""
    dialect: str = "two-axis"
    units: str | None = None
    sigma: FloatArray | None = None
    settle: Settle = field(default_factory=Settle)
    home: bool = False
    base: Path = Path()


def read_table(node: Node, base: Path) -> TablePlan:
    """The section [table]. Raises SurveyError."""
    node.allow(*_TABLE)
    driver = node.choice("driver", DRIVERS)
    axes = tuple(_axis(name, axis, driver) for name, axis in node.tables("axes"))
    if not 1 <= len(axes) <= 2:
        raise node.error(f"{len(axes)} axes; give one or two [table.axes.NAME], outermost first", "axes")
    if driver == "ascii":
        node.text("address")
    return TablePlan(
        table_id=node.text("id"),
        driver=driver,
        axes=axes,
        address=node.text("address", ""),
        dialect=node.text("dialect", "two-axis"),
        units=node.text("units") if node.has("units") else None,
        sigma=node.sigmas("sigma", ("arcsec",), len(axes)),
        settle=with_given(Settle(), node.table("settle")),
        home=node.flag("home", False),
        base=base,
    )


def _axis(name: str, node: Node, driver: str) -> AxisPlan:
    node.allow(*_AXIS)
    lower, upper = np.radians(node.numbers("limits_deg", (2,))).tolist()
    if lower >= upper:
        raise node.error("the lower limit comes first and must be the smaller", "limits_deg")
    speed = math.radians(node.number("speed_deg_s", 20.0, positive=True))
    acceleration = math.radians(node.number("acceleration_deg_s2", 40.0, positive=True))
    sign = node.value("sign", 1)
    if sign not in (1, -1):
        raise node.error(f"found {sign!r}; it is 1 or -1", "sign")
    if driver in ("standa", "epics"):
        node.text("address")
    return AxisPlan(
        Axis(name, lower, upper, node.flag("wraps", False), speed, acceleration),
        where=node.text("address") if driver in ("standa", "epics") else node.text("channel", ""),
        sign=sign,
        zero=math.radians(node.number("zero_deg", 0.0)),
        steps_per_deg=node.number("steps_per_deg", positive=True) if driver == "standa" else 0.0,
        backlash=math.radians(node.number("backlash_arcsec", 0.0) / 3600),
        noise=math.radians(node.number("noise_arcsec", 0.0) / 3600),
    )


def make_table(plan: TablePlan, near: FloatArray | None = None) -> MovingTable:
    """The table of a plan, not yet connected; near: (n,) rad, where it was last, for readbacks that lose turns."""
    axes = [axis.axis for axis in plan.axes]
    return MovingTable(f"table {plan.table_id!r}", axes, _MAKERS[plan.driver](plan), plan.settle, near)


def _ascii(plan: TablePlan) -> Controller:
    from capture.devices.turntables.ascii import AsciiController
    from capture.devices.turntables.dialect import read_dialect

    dialect = read_dialect(plan.dialect, plan.base)
    if len(dialect.channels) < len(plan.axes) and not all(axis.where for axis in plan.axes):
        n = len(dialect.channels)
        raise SurveyError(f"dialect {dialect.name!r} names {n} channels; give each axis its channel")
    channels = [axis.where or dialect.channels[i] for i, axis in enumerate(plan.axes)]
    return AsciiController(plan.address, dialect, channels, _signs(plan), _zeros(plan))


def _standa(plan: TablePlan) -> Controller:
    from capture.devices.turntables.standa import StandaController

    steps = [math.radians(1.0) / axis.steps_per_deg for axis in plan.axes]
    return StandaController([axis.where for axis in plan.axes], steps, _signs(plan), _zeros(plan))


def _epics(plan: TablePlan) -> Controller:
    from capture.devices.turntables.epics import EpicsController

    return EpicsController([axis.where for axis in plan.axes], _signs(plan), _zeros(plan), plan.units)


def _simulated(plan: TablePlan) -> Controller:
    from capture.devices.turntables.simulated import SimulatedController
    from capture.devices.turntables.simulated_axis import AxisPhysics

    return SimulatedController(
        [AxisPhysics(a.axis.speed, a.axis.acceleration, a.backlash, a.noise) for a in plan.axes]
    )


def _signs(plan: TablePlan) -> list[int]:
    return [axis.sign for axis in plan.axes]


def _zeros(plan: TablePlan) -> list[float]:
    return [axis.zero for axis in plan.axes]


_MAKERS = {"ascii": _ascii, "standa": _standa, "epics": _epics, "simulated": _simulated}
