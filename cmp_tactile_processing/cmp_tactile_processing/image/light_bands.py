"""Bands of light that move from frame to frame: flicker of lamps, seen by a rolling shutter."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# A row changes where it loses more of the light than this; noise of 16 grey levels and a gel that
# moves by 0.5 px make 0.03, but for rows along the pattern's border.
MIN_LOSS = 0.05
# A darker frame shows no pattern, and nothing of the light: mean, grey levels.
MIN_LEVEL = 5.0
# Fewer rows than this share of all may change without bands: the pattern's border moves.
MIN_ROWS_SHARE = 0.04


class LightBands:
    """The light in each of the rows of an image, over several frames."""

    def __init__(self, rows: int) -> None:
        self._low, self._high = np.full(rows, np.inf), np.zeros(rows)

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take in a frame, (rows, W) or (rows, W, 3), unless it is black."""
        if image.mean() >= MIN_LEVEL:
            level = _row_levels(image)
            self._low, self._high = np.minimum(self._low, level), np.maximum(self._high, level)

    @property
    def changing(self) -> NDArray[np.bool_]:
        """Rows (rows,) in which the light changes; none where there are too few for bands."""
        found = self._low < (1 - MIN_LOSS) * self._high
        return np.asarray(found & (found.mean() > MIN_ROWS_SHARE))

    @property
    def loss(self) -> float:
        """Largest share of the light that a row loses in some frame, 0 without bands."""
        changing = self.changing
        return float((1 - self._low[changing] / self._high[changing]).max(initial=0.0))

    @property
    def report(self) -> str:
        """What is to be said of them; empty without bands."""
        return flicker_report(self.loss)

    def take_out(self, image: NDArray[np.uint8]) -> None:
        """Change an image (rows, W) so that each row has the most light that it had in a frame.

        Checkers alternate along a row, so its mean hardly changes where the gel is pressed.
        """
        if self.loss:
            gain = (self._high / _row_levels(image)).astype(np.float32)
            np.copyto(image, np.rint(image * gain[:, None]).clip(0, 255), casting="unsafe")


def _row_levels(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Mean of each row (H,) over that of the image, a level added to both: black rows are alike."""
    rows = cv2.reduce(image.reshape(len(image), -1), 1, cv2.REDUCE_AVG, dtype=cv2.CV_64F)[:, 0]
    return np.asarray((rows + 1) / (rows.mean() + 1))


def flicker_report(loss: float) -> str:
    """What is to be said of bands that take so large a share of the light; empty without."""
    if not loss:
        return ""
    return (
        f"the light flickers: bands take up to {loss:.0%} of it, in other rows in each frame; set "
        "the exposure to a multiple of 10 ms (mains of 50 Hz) or 8.33 ms (60 Hz), or use DC light"
    )
