"""Separate contacts: their number, wrench, area, centre and outline, against known loads."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.force.contact_regions import ContactRegions, basins, material_covariance
from cmp_tactile_processing.measured import Contact, SurfaceGrid

Array = NDArray[np.float64]

NODES = SurfaceGrid(16, 20, (0.019, 0.015))
SPACING = 1e-3
AREA = np.full(16 * 20, SPACING**2)
# Areas from nodes 1 mm apart, over contacts of a few nodes across.
AREA_RTOL = 0.1
# Share of the peak above which a node is in contact, as in the force stage.
THRESHOLD = 0.08


def found(
    regions: ContactRegions, force: Array, mask: NDArray[np.bool_], place: Array, *known: Array
) -> tuple[Contact, ...]:
    """The contacts, of known covariances by noise and beyond; without these of none."""
    hills = regions.hills(force, mask, place)
    pair = known or (np.zeros((6, 6)), np.zeros((6, 6)))
    return regions.contacts(hills, [(pair[0], pair[1])] * len(hills.nodes))


def surface() -> Array:
    """Undeformed places of the nodes on a plane 2 mm above the origin."""
    points = NODES.points
    return np.concatenate([points, np.full((len(points), 1), 2e-3)], axis=1)


def blurred(newton: float, pressure: Callable[[Array, Array], Array]) -> Array:
    """Normal force (M,) of a pressure over (x, y) mm, as a reconstruction has it: over hats."""
    fine = np.linspace(-0.95, 0.95, 20)
    hat = 1 - np.abs(fine)
    x = NODES.x[None, :, None, None] * 1e3 + fine[None, :]
    y = NODES.y[:, None, None, None] * 1e3 + fine[:, None]
    share = np.einsum("ijab,a,b->ij", pressure(x, y), hat, hat).ravel()
    return -newton * share / share.sum()


def hertz(centre_mm: tuple[float, float], radius_mm: float, newton: float) -> Array:
    """Normal force (M,) under a sphere."""

    def pressure(x: Array, y: Array) -> Array:
        square = (x - centre_mm[0]) ** 2 + (y - centre_mm[1]) ** 2
        return np.sqrt(np.maximum(0, 1 - square / radius_mm**2))

    return blurred(newton, pressure)


def ring(inner_mm: float, outer_mm: float) -> Array:
    """Normal force (M,) of 5 N over a ring about the middle."""

    def pressure(x: Array, y: Array) -> Array:
        radius = np.hypot(x, y)
        return np.sqrt(np.maximum(0, (radius - inner_mm) * (outer_mm - radius)))

    return blurred(5.0, pressure)


def punch(radius_mm: float) -> Array:
    """Normal force (M,) of 5 N that is the same all over a disc."""
    return blurred(5.0, lambda x, y: 1.0 * (np.hypot(x - 0.3, y + 0.2) < radius_mm))


def load(normal: Array, shear: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Nodal forces (M, 3), with so much shear per normal force."""
    return np.stack([-shear[0] * normal, -shear[1] * normal, normal], axis=1)


def find(force: Array, place: Array | None = None) -> tuple[Contact, ...]:
    """The contacts of nodal forces."""
    mask = -force[:, 2] > THRESHOLD * -force[:, 2].min()
    place = surface() if place is None else place
    return found(ContactRegions(NODES, AREA), force, mask, place)


def enclosed(outline: Array) -> float:
    """Signed area of a closed polygon seen along z, m^2."""
    x, y = outline[:, 0], outline[:, 1]
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.parametrize("radius_mm", [1.6, 2.6, 4.5])
def test_outline_and_area_are_those_of_a_sphere(radius_mm: float) -> None:
    """Nodes counted whole would miss the area by more than this at some radius and place."""
    (contact,) = find(load(hertz((0.3, -0.2), radius_mm, 8.0)))
    true = np.pi * (radius_mm * 1e-3) ** 2
    assert contact.area == pytest.approx(true, rel=AREA_RTOL)
    assert enclosed(contact.outline) == pytest.approx(contact.area, rel=1e-9)
    radii = np.linalg.norm(contact.outline[:, :2] - [0.3e-3, -0.2e-3], axis=1)
    np.testing.assert_allclose(radii, radius_mm * 1e-3, atol=0.3 * SPACING)
    np.testing.assert_allclose(contact.outline[:, 2], 2e-3, rtol=1e-12)
    np.testing.assert_allclose(
        contact.centre_of_pressure, [0.3e-3, -0.2e-3, 2e-3], atol=0.05 * SPACING
    )
    assert not contact.at_border


def test_wrenches_act_on_the_deformed_surface_and_add_up() -> None:
    """Strongest first; the moment is about the origin, from where the nodes have moved to."""
    force = load(hertz((-5, 1), 2.2, 2.0), (0.4, 0.1)) + load(hertz((4, -2), 2.5, 6.0))
    place = surface() + np.random.default_rng(2).normal(size=(len(AREA), 3)) * 1e-4
    strong, weak = find(force, place)
    assert strong.wrench[2] == pytest.approx(-6.0)
    np.testing.assert_allclose(weak.wrench[:3], [0.8, 0.2, -2.0], rtol=1e-9)
    total = np.concatenate([force.sum(axis=0), np.cross(place, force).sum(axis=0)])
    np.testing.assert_allclose(strong.wrench + weak.wrench, total, rtol=1e-9, atol=1e-12)
    assert not set(strong.nodes) & set(weak.nodes)


def test_contacts_with_touching_nodes_are_found_apart_and_a_wavy_one_is_not() -> None:
    """Two spheres whose masks share a side; noise of 25 % on one sphere."""
    two = find(load(hertz((-2.5, 0), 2.15, 3.0) + hertz((2.5, 0), 2.15, 3.0)))
    assert [round(float(item.wrench[2]), 1) for item in two] == [-3.0, -3.0]
    normal = hertz((0, 0), 4.5, 10.0)
    wavy = normal * np.random.default_rng(0).uniform(0.75, 1.25, len(normal))
    peaks, _ = basins(-wavy.reshape(16, 20), -wavy.reshape(16, 20) > 0, 0.999)
    assert peaks.max() > 2  # several hills, joined by shallow passes
    (one,) = find(load(wavy))
    assert one.wrench[2] == pytest.approx(wavy.sum())


@pytest.mark.parametrize("radius_mm", [3.0, 4.5, 6.0])
def test_a_pressure_that_ends_abruptly_has_its_edge_half_way_up(radius_mm: float) -> None:
    """The level that suits a sphere would make the narrowest of these a quarter too large."""
    (contact,) = find(load(punch(radius_mm)))
    assert contact.area == pytest.approx(np.pi * (radius_mm * 1e-3) ** 2, rel=AREA_RTOL)


def test_ring_is_one_contact_with_its_outer_edge_and_no_area_in_its_hole() -> None:
    """The outline goes around; the area of the hole is not counted."""
    (contact,) = find(load(ring(2.5, 6.0)))
    assert enclosed(contact.outline) == pytest.approx(np.pi * 6.0**2 * 1e-6, rel=AREA_RTOL)
    assert contact.area == pytest.approx(np.pi * (6.0**2 - 2.5**2) * 1e-6, rel=2 * AREA_RTOL)


def test_contact_over_the_border_is_closed_along_it_and_says_so() -> None:
    """A polygon that is left open, or leaves the grid, has another area or extent."""
    (contact,) = find(load(hertz((9.5, 0), 3.0, 4.0)))
    assert contact.at_border
    assert contact.outline[:, 0].max() == pytest.approx(NODES.x[-1])
    assert enclosed(contact.outline) == pytest.approx(np.pi * 9e-6 / 2, rel=0.15)
    (everywhere,) = find(load(np.full(len(AREA), -0.1)))
    assert enclosed(everywhere.outline) == pytest.approx(19e-3 * 15e-3)
    assert len(np.unique(everywhere.outline, axis=0)) == len(everywhere.outline)


def test_what_noise_or_ringing_makes_is_no_contact() -> None:
    """A node of 0.5 % of the force beside a contact, and one that its deviation explains."""
    force = load(hertz((0, 0), 2.0, 10.0))
    force[5, 2] = -0.05
    regions, mask = ContactRegions(NODES, AREA), force[:, 2] < 0
    (contact,) = found(regions, force, mask, surface())
    assert 5 not in contact.nodes
    force = np.zeros_like(force)
    force[100, 2] = -0.05
    for deviation, count in ((0.02, 0), (0.01, 1)):
        pair = np.diag([1.0, 1.0, deviation**2, 1.0, 1.0, 1.0]), np.eye(6)
        contacts = found(regions, force, force[:, 2] < 0, surface(), *pair)
        assert len(contacts) == count
        assert all((item.covariance == sum(pair)).all() for item in contacts)


def test_covariance_of_the_material_is_that_of_its_two_scales() -> None:
    """J C J^T, J by differences: normal and tangential forces off the origin, each with a scale."""
    place, force = np.array([3e-3, -5e-3, 2e-3]), np.array([0.4, -0.7, -3.0])
    std = np.array([0.1, 0.03])

    def wrench(scale: Array) -> Array:
        scaled = force * scale[[1, 1, 0]]
        return np.concatenate([scaled, np.cross(place, scaled)])

    jacobian = np.stack([wrench(1 + step) - wrench(1 - step) for step in np.eye(2) / 2], axis=1)
    np.testing.assert_allclose(
        material_covariance(wrench(np.ones(2)), place, *std),
        jacobian @ np.diag(std**2) @ jacobian.T,
        atol=1e-15,
    )


def test_any_field_of_forces_is_answered() -> None:
    """Nothing, one node, pulling nodes, NaN, infinity and noise everywhere: no exception."""
    regions, place = ContactRegions(NODES, AREA), surface()
    count = len(AREA)
    zero, noise = np.zeros((count, 3)), np.random.default_rng(1).normal(size=(count, 3))
    every, none = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    assert found(regions, noise, none, place) == ()
    assert found(regions, np.full((count, 3), np.nan), every, place) == ()
    assert found(regions, zero, every, place) == ()
    assert found(regions, -load(np.full(count, -1.0)), every, place) == ()
    assert found(regions, noise, every, np.full((count, 3), np.nan)) == ()
    single = zero.copy()
    single[45] = 0.1, 0.2, -1.0
    (one,) = found(regions, single, single[:, 2] < 0, place)
    np.testing.assert_allclose(one.centre_of_pressure, place[45])
    assert len(one.outline) == 4
    assert one.area > 0
    noise[::7], noise[3::11, 0] = np.nan, np.inf
    for contact in found(regions, noise, every, place):
        assert np.isfinite(contact.wrench).all()
        assert np.isfinite(contact.outline).all()
        assert contact.area >= 0
