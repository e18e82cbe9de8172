"""V.A: the plain search finds dots."""

import cv2
import numpy as np

from paper.experiments.speed import find_plainly


def _dots(shift: float) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:4, :5].reshape(2, -1)
    centres = np.column_stack([30 + 25 * x + shift, 20 + 25 * y])
    image = np.full((120, 160), 200, np.uint8)
    for cx, cy in centres:
        cv2.circle(image, (round(16 * cx), round(16 * cy)), 16 * 6, 40, -1, cv2.LINE_AA, 4)
    return image, centres


def test_dots_are_found_and_keep_the_order_of_the_frame_before() -> None:
    image, centres = _dots(0.0)
    first = find_plainly(image, np.empty((0, 2)))
    order = np.argmin(np.linalg.norm(first[:, None] - centres, axis=-1), axis=1)
    assert sorted(order) == list(range(20))
    moved, at = _dots(6.0)
    # Whole pixels count the same: a tenth of a pixel is the drawing's.
    np.testing.assert_allclose(find_plainly(moved, first), at[order], atol=0.2)
