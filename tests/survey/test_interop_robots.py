"""URDF and SDF: chains of fixed joints by the formats' own formula, and back."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.interop.cameras.robots import fixed_links, read_sdf, read_urdf, sdf_files, urdf_files
from survey.jobs.converting import adjusted_values
from survey.project import read, write_project
from tests.survey.test_interop_trajectories import same_pose


def _matrix(xyz, rpy):
    """Fixed axes roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll), as URDF's and SDF's pages have it."""
    (cr, cp, cy), (sr, sp, sy) = ([f(a) for a in rpy] for f in (math.cos, math.sin))
    R = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    out = np.eye(4)
    out[:3, :3] = R @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    out[:3, 3] = xyz
    return out


def test_urdf_means_the_poses_of_the_cameras_on_the_head(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("urdf", "head.urdf")
    root = ElementTree.parse(tmp_path / "head.urdf").getroot()
    joints = {j.find("child").get("link"): j for j in root.findall("joint")}
    assert {e.get("name") for e in root.findall("link")} == {"head", *joints}
    for camera in values.survey.cameras:
        joint = joints[f"{camera.camera_id}_optical_frame"]
        assert joint.find("parent").get("link") == "head"
        assert joint.get("type") == "fixed"
        numbers = [[float(w) for w in joint.find("origin").get(k).split()] for k in ("xyz", "rpy")]
        np.testing.assert_allclose(_matrix(*numbers), values.station_from_camera(camera).matrix(), atol=1e-12)
        station = next(s for s in back.survey.stations if s.station_id == f"{camera.camera_id}_optical_frame")
        same_pose(station.world_from_station.value, values.station_from_camera(camera))


def test_sdf_comes_back(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("sdf", "head.sdf")
    for camera in values.survey.cameras:
        station = next(s for s in back.survey.stations if s.station_id == f"{camera.camera_id}_optical_frame")
        same_pose(station.world_from_station.value, values.station_from_camera(camera))
    pose = ElementTree.parse(tmp_path / "head.sdf").getroot().find("model/link[@name='right_optical_frame']/pose")
    assert pose.get("relative_to") == "head"
    numbers = [float(w) for w in pose.text.split()]
    right = values.survey.cameras[1]
    expected = values.station_from_camera(right).matrix()
    np.testing.assert_allclose(_matrix(numbers[:3], numbers[3:]), expected, atol=1e-12)


_URDF = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/>
<joint name="1" type="fixed"><parent link="base"/><child link="a"/><origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/>
</joint>
<joint name="2" type="fixed"><parent link="a"/><child link="b"/><origin xyz="1 0 0"/></joint>
<joint name="3" type="revolute"><parent link="b"/><child link="c"/></joint></robot>"""


def test_chains_are_multiplied_out_and_moving_joints_are_said_to_be_lost(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(_URDF, encoding="utf-8")
    network = read_urdf(path)
    assert network.notes == ("left out, joints that move: 1",)
    b = next(s for s in network.survey.stations if s.station_id == "b")
    np.testing.assert_allclose(b.world_from_station.value.translation(), [1, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<parent link="base"/>', '<parent link="b"/>', "hangs on itself"),
        ('xyz="1 0 0" rpy', 'xyz="1 0" rpy', "found 2 numbers"),
        ('<child link="b"/>', '<child link="a"/>', "two parents"),
        ('<child link="b"/>', '<child link="../b"/>', "cannot be an id"),
        ('<robot name="r">', '<!DOCTYPE x [<!ENTITY y "z">]><robot name="r">', "remove it"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_line(tmp_path, old, new, says):
    path = tmp_path / "r.urdf"
    path.write_text(_URDF.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_urdf(path)
    assert "r.urdf, line" in str(found.value)


def test_names_are_escaped(lab, tmp_path):
    path = tmp_path / "x.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="m"><link name="a&amp;b"><pose>1 2 3 0.1 0.2 0.3</pose></link></model></sdf>',
        encoding="utf-8",
    )
    write_project(tmp_path / "p", read_sdf(path).survey)
    values = adjusted_values(read(tmp_path / "p"))
    links, _ = fixed_links(values, None)
    assert [link.name for link in links] == ["a&b"]
    for files, tag in ((urdf_files, "link"), (sdf_files, "model/link")):
        root = ElementTree.fromstring(files(values, None)[0][""])
        assert "a&b" in {e.get("name") for e in root.findall(tag)}
