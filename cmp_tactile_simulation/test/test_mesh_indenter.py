"""Indenters from mesh files."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cmp_tactile_simulation import mesh_indenter
from cmp_tactile_simulation.errors import IndenterError
from cmp_tactile_simulation.height_field import HeightField
from cmp_tactile_simulation.mesh_indenter import MeshIndenter

RESOLUTION = 5e-5


@pytest.fixture
def write(tmp_path):
    def export(mesh, name="part.stl"):
        path = tmp_path / name
        mesh.export(path)
        return path

    return export


def underside(count=400, radius=3e-3, spread=0.7, seed=3):
    """Points under a ball."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-spread, spread, (count, 2)) * radius
    return xy, -np.sqrt(radius**2 - (xy**2).sum(axis=1))


@pytest.mark.parametrize("name", ["ball.stl", "ball.ply", "ball.obj", "ball.off", "ball.glb"])
def test_ball_has_the_distance_of_a_sphere_near_its_underside(write, name):
    """In every format, in mm as CAD programs write them."""
    path = write(trimesh.creation.icosphere(subdivisions=5, radius=3.0), name)
    indenter = MeshIndenter.load(path, scale=1e-3, resolution=RESOLUTION)
    xy, z = underside()
    away = np.linspace(-2e-5, 2e-5, len(xy))
    outward = np.column_stack([xy, z]) / 3e-3
    points = (3e-3 + away)[:, None] * outward
    gap, normal = indenter.distance(points)
    # Facets lie up to 0.8 um inside the ball, and the rounding by two grid points takes as much.
    assert np.abs(gap - away).max() < 2e-6
    # Facets are inclined by 0.02 rad.
    assert np.abs(normal - outward).max() < 0.03
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-12
    assert indenter.reach >= 3e-3
    assert indenter.name == name


def test_origin_is_the_middle_of_the_bounding_box(write):
    box = trimesh.creation.box((4e-3, 2e-3, 1e-3))
    box.apply_translation([0.01, -0.02, 0.03])
    indenter = MeshIndenter.load(write(box), resolution=RESOLUTION)
    gap, normal = indenter.distance(np.array([[0, 0, -6e-4], [1.5e-3, -8e-4, -4e-4]]))
    assert gap == pytest.approx([1e-4, -1e-4], abs=1e-9)
    assert normal == pytest.approx(np.array([[0, 0, -1], [0, 0, -1]]), abs=1e-9)


def test_walls_end_within_the_resolution_and_point_outwards(write):
    indenter = MeshIndenter.load(
        write(trimesh.creation.box((4e-3, 2e-3, 1e-3))), resolution=2e-5, edge_radius=0
    )
    gap, normal = indenter.distance(np.array([[2.1e-3, 0, -1e-4], [1.9e-3, 0, -1e-4]]))
    assert gap[0] > 0 > gap[1]
    assert normal[0] == pytest.approx([1, 0, 0], abs=0.03)


def test_edges_are_rounded_by_a_ball(write):
    radius = 4e-4
    indenter = MeshIndenter.load(
        write(trimesh.creation.box((4e-3, 4e-3, 2e-3))), resolution=2e-5, edge_radius=radius
    )
    # Points of the rounding above the lower edge, from the flat to 60 degrees.
    angle = np.linspace(0, np.pi / 3, 20)
    middle = np.array([2e-3 - radius, 0, -1e-3 + radius])
    outward = np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    gap, normal = indenter.distance(middle + radius * outward)
    # The wall leans by 1 / 50, and moves the rounding by that share of its radius.
    assert np.abs(gap).max() < radius / 40
    assert np.abs(normal - outward).max() < 0.06


def test_distance_is_the_gap_along_z_over_a_slope():
    triangles = np.array([[[0, 0, 0], [1e-2, 0, 5e-3], [0, 1e-2, 0]]])
    field = HeightField.of_triangles(triangles, 1e-4, 0.0)
    height, slope = field.at(np.array([[3e-3, 3e-3]]))
    assert height[0] == pytest.approx(1.5e-3, abs=1e-12)
    assert slope[0] == pytest.approx([0.5, 0], abs=1e-9)


def test_lowest_of_several_surfaces_counts(write):
    lower = trimesh.creation.box((2e-3, 2e-3, 1e-3))
    upper = trimesh.creation.box((6e-3, 6e-3, 1e-3))
    upper.apply_translation([0, 0, 2e-3])
    indenter = MeshIndenter.load(write(trimesh.util.concatenate([upper, lower])), resolution=5e-5)
    # The box of both reaches from -0.5 to 2.5 mm, so that its middle is at 1 mm.
    gap, _ = indenter.distance(np.array([[0, 0, -1.6e-3], [2.5e-3, 0, -1.6e-3]]))
    assert gap[0] == pytest.approx(1e-4, abs=1e-9)
    assert gap[1] == pytest.approx(2.1e-3, abs=1e-9)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(IndenterError, match=r"none.stl: mesh file: No such file"):
        MeshIndenter.load(tmp_path / "none.stl")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.stl", b""),
        ("noise.stl", b"noise" * 100),
        ("cut.stl", b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 100),
        ("text.obj", b"hello"),
        ("half.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("part.xyz", b"0 0 0\n1 1 1\n"),
        ("part.step", b"ISO-10303-21;"),
    ],
)
def test_file_without_a_mesh_is_named(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(IndenterError, match=rf"{name}: (mesh file: cannot be read|no mesh: found)"):
        MeshIndenter.load(path)


def test_open_mesh_is_refused(write):
    mesh = trimesh.creation.box((4e-3, 2e-3, 1e-3))
    mesh.faces = mesh.faces[:-2]
    with pytest.raises(IndenterError, match=r"not watertight: found [1-9]\d* edges"):
        MeshIndenter.load(write(mesh))


def test_flat_mesh_is_refused(write):
    """Two triangles back to back are closed but no body."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1e-2, 0, 0], [0, 1e-2, 0]], [[0, 1, 2], [0, 2, 1]])
    with pytest.raises(IndenterError, match="found a volume of 0"):
        MeshIndenter.load(write(mesh, "flat.off"))


def test_mesh_that_is_far_too_fine_is_refused(write, monkeypatch):
    monkeypatch.setattr(mesh_indenter, "MAX_FACES", 100)
    path = write(trimesh.creation.icosphere(subdivisions=2, radius=3e-3))
    with pytest.raises(IndenterError, match="far too fine: found 320 faces, expected 1 to 100"):
        MeshIndenter.load(path)


def test_file_that_is_far_too_large_is_not_even_read(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_indenter, "MAX_FILE_BYTES", 10)
    (tmp_path / "large.stl").write_bytes(b"x" * 11)
    with pytest.raises(IndenterError, match="far too fine: found 11 bytes, expected at most 10"):
        MeshIndenter.load(tmp_path / "large.stl")


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_mistaken_unit_is_told(write, scale):
    path = write(trimesh.creation.box((20.0, 10.0, 10.0)))
    with pytest.raises(IndenterError, match=r"size: found .* m along .* a file in mm needs scale"):
        MeshIndenter.load(path, scale=scale)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_impossible_scale_is_refused(write, scale):
    with pytest.raises(IndenterError, match="size: found"):
        MeshIndenter.load(write(trimesh.creation.box((20.0, 10.0, 10.0))), scale=scale)


@pytest.mark.parametrize("resolution", [0.0, -1e-3, 1e-7, float("nan")])
def test_impossible_resolution_is_refused(write, resolution):
    path = write(trimesh.creation.box((2e-2, 1e-2, 1e-2)))
    with pytest.raises(IndenterError, match=r"resolution: found .* expected at least about"):
        MeshIndenter.load(path, resolution=resolution)


def test_impossible_edge_radius_is_refused(write):
    with pytest.raises(IndenterError, match=r"edge_radius: found 0.02 m, expected 0 to 0.01 m"):
        MeshIndenter.load(write(trimesh.creation.box((2e-2, 1e-2, 1e-2))), edge_radius=0.02)


def test_solid_smaller_than_the_grid_is_refused(write):
    path = write(trimesh.creation.box((2e-4, 2e-4, 2e-4)))
    with pytest.raises(IndenterError, match="resolution: no point of a grid"):
        MeshIndenter.load(path, resolution=1e-2)
