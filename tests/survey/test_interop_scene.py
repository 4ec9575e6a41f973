"""PLY and GLB, opened by trimesh, and glTF's own rules by plain lines."""

import io
import json
import struct

import numpy as np
import pytest

from survey.interop.scene import CHI2_95, glb_bytes, ply_bytes, scene, sphere


@pytest.fixture(scope="module")
def trimesh():
    """Not imported by the processes that only collect these tests."""
    import trimesh

    return trimesh


@pytest.fixture(scope="module")
def drawn(lab):
    return lab[1], scene(lab[1])


def _glb(data):
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    n, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert n % 4 == 0
    assert 28 + size + n == len(data)
    return document, data[28 + size :]


def test_the_container_keeps_gltfs_rules(drawn):
    document, binary = _glb(glb_bytes(drawn[1]))
    assert document["asset"]["version"] == "2.0"
    assert 0 <= len(binary) - document["buffers"][0]["byteLength"] < 4
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
        n = {"VEC3": 3, "SCALAR": 1}[accessor["type"]] * accessor["count"]
        values = np.frombuffer(binary, "<f4" if accessor["componentType"] == 5126 else "<u4", n, view["byteOffset"])
        if accessor["type"] == "VEC3":
            rows = values.reshape(-1, 3)
            np.testing.assert_array_equal(rows.min(axis=0), np.float32(accessor["min"]))
            np.testing.assert_array_equal(rows.max(axis=0), np.float32(accessor["max"]))
    children = document["nodes"][0]["children"]
    assert sorted(children) == list(range(1, len(document["nodes"])))
    for node in document["nodes"]:
        if "matrix" in node:  # must be a translation, a rotation and a scale
            M = np.array(node["matrix"]).reshape(4, 4).T[:3, :3]
            M = M / np.linalg.norm(M, axis=0)
            np.testing.assert_allclose(M.T @ M, np.eye(3), atol=1e-12)
            assert np.linalg.det(M) > 0


def test_trimesh_opens_the_scene_and_finds_ellipsoids_of_the_right_size(drawn, trimesh):
    values, found = drawn
    opened = trimesh.load(io.BytesIO(glb_bytes(found)), file_type="glb")
    up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # z up to y up
    document, _ = _glb(glb_bytes(found))
    for node in (n for n in document["nodes"] if n["name"].startswith("ellipsoid")):
        point = node["name"].split()[1]
        transform, _ = opened.graph.get(node["name"])
        M = np.linalg.inv(up) @ transform
        np.testing.assert_allclose(M[:3, 3], values.point(point), atol=1e-9)
        cov = M[:3, :3] @ M[:3, :3].T / (CHI2_95 * found.enlarged**2)
        expected = values.cov("point", point)
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(cov / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6)
        np.testing.assert_allclose(np.reshape(node["extras"]["covariance_mm2"], (3, 3)), 1e6 * expected)
    assert set(found.ellipsoids) == {f"B{i}" for i in range(5)}


def test_the_cameras_of_the_scene_look_where_ours_look(drawn):
    values, found = drawn
    document, _ = _glb(glb_bytes(found))
    node = next(n for n in document["nodes"] if n["name"] == "camera right")
    M = np.array(node["matrix"]).reshape(4, 4).T
    pose = found.cameras["right"][1]
    np.testing.assert_allclose(-M[:3, 2], pose.rotation().matrix()[:, 2], atol=1e-14)  # along -z
    np.testing.assert_allclose(-M[:3, 1], pose.rotation().matrix()[:, 1], atol=1e-14)  # y up
    lens = values.lens(values.survey.cameras[1])
    yfov = document["cameras"][node["camera"]]["perspective"]["yfov"]
    assert np.tan(yfov / 2) == pytest.approx(480 / ((lens[0] + lens[1]) / 2))


def test_trimesh_opens_the_ply_with_all_points_and_closed_ellipsoids(drawn, trimesh):
    values, found = drawn
    data = ply_bytes(found)
    opened = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    unit, triangles = sphere()
    assert len(opened.vertices) == 5 + 30 + 2 + 5 * len(unit)
    assert len(opened.faces) == 5 * len(triangles)
    np.testing.assert_allclose(opened.vertices[:5], [values.point(f"B{i}") for i in range(5)])
    assert f"enlarged {found.enlarged:g} times".encode() in data[:400]


def test_the_sphere_is_closed_and_faces_outwards(trimesh):
    mesh = trimesh.Trimesh(*sphere(16), process=False)
    assert mesh.is_watertight
    assert 0.95 * 4 / 3 * np.pi < mesh.volume < 4 / 3 * np.pi
