"""Turntables: limits before anything is sent, the chosen path, settling, stalls, stops; closed forms of motion."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from capture.devices.turntable import (
    Axis,
    ControllerError,
    LimitError,
    NotSettledError,
    Settle,
    StalledError,
    StoppedError,
    TableDisconnectedError,
    TurntableError,
)
from capture.devices.turntables.moving import MovingTable
from capture.devices.turntables.simulated import SimulatedController
from capture.devices.turntables.simulated_axis import AxisPhysics, SimulatedAxis

DEG = math.pi / 180
FAST = AxisPhysics(speed=200 * DEG, acceleration=4000 * DEG)
QUICK = Settle(tolerance=0.05 * DEG, still=0.01 * DEG, window_s=0.05, stall_s=0.15, timeout_s=5.0, poll_s=0.002)
AXES = (Axis("axis1", -60 * DEG, 60 * DEG), Axis("axis2", -170 * DEG, 170 * DEG))


def make(physics=FAST, axes=AXES, settle=QUICK, near=None):
    controller = SimulatedController([physics] * len(axes))
    table = MovingTable("table", axes, controller, settle, near)
    table.open()
    return table, controller


def test_moves_and_settles_at_the_setpoint():
    table, controller = make()
    status = table.set([20 * DEG, -30 * DEG])
    assert not status.done()
    status.result(5.0)
    assert status.done()
    location = table.locate()
    assert np.allclose(location.setpoint, [20 * DEG, -30 * DEG], atol=1e-12)
    assert np.allclose(np.degrees(location.readback), [20, -30], atol=1e-9)
    assert [word.split()[0] for _, word in controller.received] == ["move", "move"]


def test_setpoint_is_unknown_before_the_first_move():
    table, _ = make()
    assert np.isnan(table.locate().setpoint).all()


@pytest.mark.parametrize("angles", [(60.01, 0.0), (0.0, -170.5), (math.nan, 0.0)])
def test_nothing_is_sent_beyond_a_limit(angles):
    table, controller = make()
    with pytest.raises(LimitError) as caught:
        table.set(np.radians(angles))
    assert controller.received == []
    assert "nothing was sent" in str(caught.value)


def test_limit_message_has_name_value_unit_and_limits():
    table, _ = make()
    with pytest.raises(LimitError, match=r"'axis2': 175\.2500 deg is outside its limits -170\.0000 to 170\.0000 deg"):
        table.set(np.radians([0.0, 175.25]))


def test_number_of_angles_is_checked():
    table, controller = make()
    with pytest.raises(TurntableError, match="1 angles for 2 axes"):
        table.set([0.0])
    assert controller.received == []


@pytest.mark.parametrize(
    ("angle", "current", "expected"),
    [(10, 0, 10), (10, 350, 370), (350, 0, -10), (170, 0, 170), (200, -100, -160), (190, 400, 190), (-190, -400, -190)],
)
def test_nearest_turn_within_the_cable(angle, current, expected):
    """Worked by hand: the nearest angle + k 360 to ``current`` that -400 to 400 allows."""
    axis = Axis("a", -400 * DEG, 400 * DEG, wraps=True)
    nearest = min(
        (angle + 360 * k for k in range(-3, 4) if -400 <= angle + 360 * k <= 400), key=lambda x: abs(x - current)
    )
    assert nearest == expected
    assert math.degrees(axis.target(angle * DEG, current * DEG)) == pytest.approx(expected, abs=1e-9)


def test_cable_sends_the_long_way_round():
    axis = Axis("a", -180 * DEG, 180 * DEG, wraps=True)
    assert math.degrees(axis.target(-170 * DEG, 170 * DEG)) == pytest.approx(-170.0)  # 20 deg away through the cable


def test_no_turn_helps():
    axis = Axis("a", -30 * DEG, 30 * DEG, wraps=True)
    with pytest.raises(LimitError, match="any number of whole turns"):
        axis.target(90 * DEG, 0.0)


@pytest.mark.slow
def test_readback_that_loses_turns_is_counted():
    # half a turn in a third of a second: on a busy machine too it is read more than once within one
    physics = AxisPhysics(speed=540 * DEG, acceleration=40000 * DEG, turns_lost=True)
    axes = (Axis("axis1", -400 * DEG, 400 * DEG), Axis("axis2", -400 * DEG, 400 * DEG))
    table, _ = make(physics, axes)
    for angles in ((170, -170), (350, -350), (390, -390), (0, 0)):
        table.set(np.radians(angles)).result(5.0)
        assert np.allclose(np.degrees(table.position), angles, atol=1e-6)


def test_turns_go_on_where_the_last_session_ended():
    physics = AxisPhysics(turns_lost=True)
    table, controller = make(physics, near=np.radians([350.0, -10.0]))
    controller.simulated[0].angle = controller.simulated[1].angle = math.radians(-8.0)  # the encoder says 352
    assert np.allclose(np.degrees(table.position), [352, -8])


def test_stall_is_found_and_the_table_stopped():
    """Soon; the least of several delays, because other work on the machine may hold up one of them."""
    delays = []
    for _ in range(3):
        table, controller = make(AxisPhysics(speed=30 * DEG, acceleration=4000 * DEG))
        status = table.set(np.radians([50.0, 0.0]))
        time.sleep(0.1)
        jammed = time.monotonic()
        controller.simulated[0].jam(jammed)
        with pytest.raises(StalledError, match=r"'axis1' stands still.*setpoint 50\.0000 deg"):
            status.result(3.0)
        when, what = controller.received[-1]
        assert what == "stop"
        delays.append(when - jammed)
    assert min(delays) < QUICK.stall_s + 0.2


def test_ending_short_of_the_setpoint_is_a_stall():
    table, controller = make(AxisPhysics(speed=200 * DEG, acceleration=4000 * DEG, backlash=1.0 * DEG))
    with pytest.raises(StalledError, match=r"has ended at 19\.5000 deg, 0\.5000 deg from its setpoint"):
        table.set(np.radians([20.0, 0.0])).result(3.0)
    assert controller.received[-1][1] == "stop"


def test_backlash_is_in_the_readback():
    """Half the backlash short of the setpoint, on the side that the table came from (a play operator)."""
    table, _ = make(AxisPhysics(speed=200 * DEG, acceleration=4000 * DEG, backlash=0.02 * DEG))
    for target, expected in ((10.0, 9.99), (-10.0, -9.99), (0.0, -0.01)):
        table.set(np.radians([target, 0.0])).result(3.0)
        assert math.degrees(table.position[0]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("poll_s", [0.002, 0.06])  # also where a window has one reading or none
def test_restless_readback_does_not_settle(poll_s):
    settle = Settle(0.5 * DEG, 0.001 * DEG, window_s=0.05, stall_s=0.15, timeout_s=0.4, poll_s=poll_s)
    table, controller = make(AxisPhysics(200 * DEG, 4000 * DEG, encoder_noise=0.1 * DEG), settle=settle)
    with pytest.raises(NotSettledError, match=r"not at rest after 0\.4 s"):
        table.set(np.radians([1.0, 0.0])).result(3.0)
    assert controller.received[-1][1] == "stop"


def test_stop_ends_the_move_and_brakes():
    table, _controller = make(AxisPhysics(speed=10 * DEG, acceleration=100 * DEG))  # 5 and 10 s away
    status = table.set(np.radians([50.0, 100.0]))
    time.sleep(0.15)
    table.stop()
    with pytest.raises(StoppedError):
        status.result(2.0)
    time.sleep(0.12)  # v/a
    first = table.position
    time.sleep(0.05)
    assert np.array_equal(first, table.position)
    assert abs(math.degrees(first[1])) < 30.0


def test_emergency_stop_locks_until_release():
    table, controller = make()
    table.emergency_stop()
    with pytest.raises(StoppedError, match="after release"):
        table.set([0.1, 0.1])
    assert [word for _, word in controller.received] == ["stop"]
    table.release()
    table.set([0.1, 0.1]).result(3.0)


def test_fault_of_the_controller_stops_all_axes_within_50_ms():
    table, controller = make(AxisPhysics(speed=10 * DEG, acceleration=4000 * DEG))
    delays = []  # the median of several, because other work on the machine may hold up one of them
    for target in (20.0, -20.0) * 3:
        status = table.set(np.radians([target, 0.0]))
        time.sleep(0.05)
        begin = time.monotonic()
        controller.simulated[1].fault = "over-current"
        with pytest.raises(ControllerError, match="'over-current' of axis 'axis2'"):
            status.result(2.0)
        assert controller.received[-1][1] == "stop"
        delays.append(controller.received[-1][0] - begin)
        controller.simulated[1].fault = None
    assert np.median(delays) < 0.05


def test_pulled_cable_stops_over_a_new_connection():
    table, controller = make(AxisPhysics(speed=10 * DEG, acceleration=4000 * DEG))
    status = table.set(np.radians([20.0, 0.0]))
    time.sleep(0.02)
    controller._connected = False  # cut once; connecting anew works
    with pytest.raises(TableDisconnectedError):
        status.result(2.0)
    assert controller.received[-1][1] == "stop"
    table.reopen()
    table.set([0.0, 0.0]).result(5.0)


def test_cable_that_stays_out_is_said():
    table, controller = make(AxisPhysics(speed=10 * DEG, acceleration=4000 * DEG))
    status = table.set(np.radians([20.0, 0.0]))
    controller.cut = True
    with pytest.raises(TableDisconnectedError) as caught:
        status.result(2.0)
    assert any("the stop after it failed too" in note for note in caught.value.__notes__)


def test_a_move_that_ends_after_the_table_was_let_go_takes_no_new_connection(monkeypatch):
    table, controller = make(AxisPhysics(5 * DEG, 50 * DEG), settle=replace(QUICK, poll_s=0.05))
    status = table.set([50 * DEG, 0.0])
    time.sleep(0.02)  # the one who watches the move sleeps until the next reading
    opened = []
    monkeypatch.setattr(controller, "open", lambda: opened.append(1))
    table.close()
    with pytest.raises(TurntableError):
        status.result(5.0)
    assert opened == []


def test_second_move_waits_for_the_first():
    table, _ = make(AxisPhysics(speed=20 * DEG, acceleration=4000 * DEG))
    table.set(np.radians([20.0, 0.0]))
    with pytest.raises(TurntableError, match="still moving"):
        table.set([0.0, 0.0])
    table.close()


def test_home_goes_to_the_reference():
    table, _ = make(AxisPhysics(200 * DEG, 4000 * DEG, home_at=3 * DEG))
    table.home().result(3.0)
    assert np.allclose(np.degrees(table.locate().setpoint), [3, 3], atol=1e-6)


def test_a_reference_search_that_is_refused_stops_all_axes_and_may_be_tried_again(monkeypatch):
    table, controller = make(AxisPhysics(200 * DEG, 4000 * DEG, home_at=3 * DEG))
    search = controller.home

    def refused(axis):
        if axis == 1:
            raise ControllerError("axis 2 has no switch")
        search(axis)

    with monkeypatch.context() as patch:
        patch.setattr(controller, "home", refused)
        with pytest.raises(ControllerError, match="no switch"):
            table.home()
    assert [word for _, word in controller.received] == ["home 0", "stop"]
    table.home().result(3.0)
    assert np.allclose(np.degrees(table.locate().setpoint), [3, 3], atol=1e-6)


def test_trapezoid_has_its_closed_form():
    """x = v t - v^2 / 2a after the ramp; total time way / v + v / a."""
    axis = SimulatedAxis(AxisPhysics(speed=2.0, acceleration=4.0), np.random.default_rng(1))
    axis.move(0.0, 10.0)
    assert axis.advance(0.25) == pytest.approx(0.5 * 4.0 * 0.25**2)
    assert axis.advance(3.0) == pytest.approx(2.0 * 3.0 - 2.0**2 / (2 * 4.0))
    assert axis.moving(5.49)
    assert not axis.moving(5.51)
    assert axis.advance(5.5) == pytest.approx(10.0)
    assert Axis("a", -99, 99, speed=2.0, acceleration=4.0).duration(10.0) == pytest.approx(5.5)
    assert Axis("a", -99, 99, speed=2.0, acceleration=4.0).duration(0.25) == pytest.approx(2 * math.sqrt(0.25 / 4.0))


def test_a_move_ends_at_its_target_however_long_the_clock_runs():
    axis = SimulatedAxis(AxisPhysics(speed=35.0, acceleration=1745.0), np.random.default_rng(1))
    axis.move(1e7 + 1 / 3, -0.2)
    assert axis.advance(1e7 + 9.0) == -0.2
    assert not axis.moving(1e7 + 9.0)


def test_reversal_on_the_way_brakes_first():
    axis = SimulatedAxis(AxisPhysics(speed=2.0, acceleration=4.0), np.random.default_rng(1))
    axis.move(0.0, 10.0)
    axis.move(1.0, 0.0)  # at 1.5 with speed 2; braking takes 0.5 s and 0.5 rad
    assert axis.advance(1.5) == pytest.approx(2.0)
    assert axis.advance(9.0) == pytest.approx(0.0)
