"""Indenters from mesh files."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cmp_tactile_processing.errors import InputError
from cmp_tactile_simulation.indenters import MeshIndenter
from cmp_tactile_simulation.scenes.description import turned
from cmp_tactile_simulation.scenes.simulation import Simulation


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
    indenter = MeshIndenter.load(path, scale=1e-3)
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
    indenter = MeshIndenter.load(write(box))
    gap, normal = indenter.distance(np.array([[0, 0, -6e-4], [1.5e-3, -8e-4, -4e-4]]))
    assert gap == pytest.approx([1e-4, -1e-4], abs=1e-9)
    assert normal == pytest.approx(np.array([[0, 0, -1], [0, 0, -1]]), abs=1e-9)


def test_walls_end_within_the_resolution_and_point_outwards(write):
    indenter = MeshIndenter.load(write(trimesh.creation.box((4e-3, 2e-3, 1e-3))), edge_radius=0)
    gap, normal = indenter.distance(np.array([[2.1e-3, 0, -1e-4], [1.9e-3, 0, -1e-4]]))
    assert gap[0] > 0 > gap[1]
    assert normal[0] == pytest.approx([1, 0, 0], abs=0.03)


def test_edges_are_rounded_by_a_ball(write):
    radius = 4e-4
    indenter = MeshIndenter.load(
        write(trimesh.creation.box((4e-3, 4e-3, 2e-3))), edge_radius=radius
    )
    # Points of the rounding above the lower edge, from the flat to 60 degrees.
    angle = np.linspace(0, np.pi / 3, 20)
    middle = np.array([2e-3 - radius, 0, -1e-3 + radius])
    outward = np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    gap, normal = indenter.distance(middle + radius * outward)
    # The wall leans by 1 / 50, and moves the rounding by that share of its radius.
    assert np.abs(gap).max() < radius / 40
    assert np.abs(normal - outward).max() < 0.06


def test_lowest_of_several_surfaces_counts(write):
    lower = trimesh.creation.box((2e-3, 2e-3, 1e-3))
    upper = trimesh.creation.box((6e-3, 6e-3, 1e-3))
    upper.apply_translation([0, 0, 2e-3])
    indenter = MeshIndenter.load(write(trimesh.util.concatenate([upper, lower])))
    # The box of both reaches from -0.5 to 2.5 mm, so that its middle is at 1 mm.
    gap, _ = indenter.distance(np.array([[0, 0, -1.6e-3], [2.5e-3, 0, -1.6e-3]]))
    assert gap[0] == pytest.approx(1e-4, abs=1e-9)
    assert gap[1] == pytest.approx(2.1e-3, abs=1e-9)


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
    with pytest.raises(InputError, match=rf"{name}: (mesh file: cannot be read|no mesh: found)"):
        MeshIndenter.load(path)


def test_open_mesh_is_refused(write):
    mesh = trimesh.creation.box((4e-3, 2e-3, 1e-3))
    mesh.faces = mesh.faces[:-2]
    with pytest.raises(InputError, match=r"found [1-9]\d* edges .*watertight"):
        MeshIndenter.load(write(mesh))


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_mistaken_unit_is_reported(write, scale):
    path = write(trimesh.creation.box((20.0, 10.0, 10.0)))
    with pytest.raises(InputError, match=r"size: found .* m along .* a file in mm use scale"):
        MeshIndenter.load(path, scale=scale)


def test_edge_radius_that_would_leave_nothing_of_a_pin_is_refused(write):
    path = write(trimesh.creation.box((2.0, 2.0, 10.0)))
    with pytest.raises(InputError, match=r"edge_radius: found 0.0015 m, expected 0 to 0.001 m"):
        MeshIndenter.load(path, 1e-3, edge_radius=1.5e-3)
    lying = MeshIndenter.load(path, 1e-3, edge_radius=9e-4, rotation=turned((90, 0, 0)))
    assert lying.heights.height.min() == pytest.approx(-1e-3, abs=1e-9)


def test_turned_mesh_shows_the_side_that_faces_the_gel(write):
    """A wedge: flat below, and pointed above, whose own axes stay those of the indenter."""
    wedge = trimesh.convex.convex_hull(
        [[x, y, z] for x, y, z in [(-3, -2, -1), (3, -2, -1), (-3, 2, -1), (3, 2, -1)]]
        + [[0, -2, 1], [0, 2, 1]]
    )
    path = write(wedge)
    for rotation_deg, tip in (((0, 0, 0), (1, 0, -1)), ((180, 0, 0), (0, 0, 1))):
        rotation = turned(rotation_deg)
        indenter = MeshIndenter.load(path, 1e-3, edge_radius=0, rotation=rotation)
        down = np.array([0, 0, -1]) @ rotation
        surface = 1e-3 * np.array([tip], dtype=np.float64)
        gap, _ = indenter.distance(np.concatenate([surface + 1e-4 * down, surface - 1e-4 * down]))
        assert gap[0] > 0 > gap[1]
    # The slope towards +x, a rise of 2 in 3, upside down; the normal is in the mesh's own axes.
    gap, normal = indenter.distance(np.array([[1.5e-3, 0, 0]]))
    assert gap[0] == pytest.approx(0, abs=1e-8)
    assert normal[0] == pytest.approx(np.array([2, 0, 3]) / np.sqrt(13), abs=1e-4)


@pytest.mark.parametrize("start", [(90, 0, 0), (180, 0, 0), (0, -90, 0)])
def test_cube_presses_the_same_with_each_of_its_sides(write, small_scene, start):
    file = str(write(trimesh.creation.box((6.0, 6.0, 6.0))))
    wrenches = []
    for rotation_deg in ((0, 0, 0), start):
        scene = small_scene(
            indenter={"type": "mesh", "file": file, "scale": 1e-3},
            start={"touch": {"at": [0, 0]}, "rotation_deg": list(rotation_deg)},
            motion=[{"name": "press", "frames": 1, "by": {"position": [0, 0, -2e-4]}}],
        )
        (state,) = Simulation(scene).states()
        wrenches.append(state.contact.force.sum(axis=0))
    assert wrenches[0][2] < -0.1
    # Only digits of the single precision of STL, 1e-7, set them apart.
    assert wrenches[1] == pytest.approx(wrenches[0], abs=1e-4 * abs(wrenches[0][2]))
