"""Arrows and ellipsoids of known meshes."""

import numpy as np
import pytest
from made_forces import made_contact, made_field
from scipy.spatial.transform import Rotation

from cmp_tactile_viewer import meshes


def test_an_arrow_ends_at_its_node_and_none_is_drawn_without_contact():
    position = np.array([[1e-3, 0, 0], [2e-3, 0, 0], [3e-3, 0, 0]])
    force = np.array([[0, 0, -0.2], [0, 0, -0.2], [0, 0, -1e-4]])
    contact = np.array([True, False, True])
    field = made_field(1, 3, position=position, force=force, contact=contact)
    (arrow,) = meshes.force_arrows(field, 2.0)
    assert arrow[1] == pytest.approx([1.0, 0, 0])
    assert arrow[0] == pytest.approx([1.0, 0, 2 * 0.2 * meshes.NODE_MM_PER_N])


def test_the_moment_is_about_the_centre_of_pressure():
    """A force alone has no moment there, whatever its moment about another point."""
    centre = np.array([2e-3, 1e-3, 0])
    force = np.array([0.5, 0, -3.0])
    wrench = np.concatenate([force, np.cross(centre, force)])
    contact = made_contact([0], wrench=wrench, centre_of_pressure=centre)
    assert len(meshes.moment_lines(contact, np.zeros(3), 1.0)) == 0
    turned = made_contact([0], wrench=wrench + (0, 0, 0, 0, 0, 5e-3), centre_of_pressure=centre)
    assert len(meshes.moment_lines(turned, np.zeros(3), 1.0)) > 0


def test_the_ellipsoid_has_the_axes_of_the_covariance():
    """95 % of a normal distribution in three dimensions lie within 2.796 deviations."""
    turn = Rotation.from_euler("xyz", (0.3, -0.5, 0.9)).as_matrix()
    deviations = np.array([0.01, 0.03, 0.2])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn @ np.diag(deviations**2) @ turn.T
    wrench = np.array([0.0, 0, -4, 0, 0, 0])
    found = meshes.error_ellipsoid(made_contact([0], covariance=covariance, wrench=wrench), 2.0)
    assert found is not None
    assert found.centre == pytest.approx([0, 0, 8 * meshes.CONTACT_MM_PER_N])
    w, x, y, z = found.orientation
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    shown = axes @ np.diag(found.half_axes**2) @ axes.T
    assert shown == pytest.approx((2.0 * 2.796) ** 2 * covariance[:3, :3], rel=1e-9)
