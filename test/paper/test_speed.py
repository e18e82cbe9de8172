"""V.A: the plain search finds dots, and the claim is compared with it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from paper.experiments.speed import claims, find_plainly
from paper.page import Page


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


@pytest.mark.parametrize(
    ("extraction", "chain", "met"),
    [(10.0, 20.0, [True, True]), (10.0, 11.0, [True, False]), (50.0, 60.0, [False, False])],
)
def test_the_claim_is_compared_with_the_least_that_dots_take(
    extraction: float, chain: float, met: list[bool], tmp_path: Path
) -> None:
    data = {"plain_dots_extraction": np.full(3, 6.0), "plain_found": np.array([400, 400])}
    for key in ("cmp", "cmp_paper", "dmp_nearest", "dmp_grid", "dmp_flow"):
        data[f"{key}_extraction"] = np.full(3, extraction)
        data[f"{key}_chain"] = np.full(3, chain)
    page = Page(tmp_path)
    claims(data, page)
    assert [claim.met for claim in page.claims] == met
