#!/usr/bin/env python3
"""What a camera's encoding costs: corners in sample frames that are sent in it, against the truth.

A mosaic is made of the grey frames with the gains that a gel's light and the filters give red and
blue beside green, and read as any frame is.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame, to_grey
from cmp_tactile_processing.image.compressed import decode_image
from cmp_tactile_processing.image.raw import BitDepth, decode_raw
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.tracker import GridTracker

FRAMES = ("rest", "press", "slide", "twist", "bumps", "slide_noise")
Image = NDArray[np.uint8]


def mosaic(frame: Image, red: float, blue: float) -> Image:
    """The samples of an RGGB mosaic: green as the frame, red and blue with gains."""
    samples = frame.astype(float)
    samples[::2, ::2] *= red
    samples[1::2, 1::2] *= blue
    return samples.round().astype(np.uint8)


def as_sent(frame: Image) -> dict[str, Image]:
    """The frame after it was sent in each encoding, by its name."""
    size, width = frame.shape[::-1], frame.shape[1]
    sent = {"mono8": frame}
    for red, blue in ((1.0, 1.0), (0.8, 0.6)):
        image = decode_raw(size, "bayer_rggb8", width, mosaic(frame, red, blue).ravel())
        sent[f"bayer_rggb8, red {red:g}, blue {blue:g}"] = to_grey(image)
    deep = (frame.astype("<u2") * 16).view(np.uint8).ravel()
    depth = BitDepth(say=str)
    sent["mono16, 12 bits used"] = decode_raw(size, "mono16", 2 * width, deep, depth=depth)
    for quality in (95, 80):
        content = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].ravel()
        sent[f"jpeg, quality {quality}"] = decode_image(content, "jpeg")
    return sent


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder of sample frames with their truth")
    data = parser.parse_args().data
    sensor = SensorDescription.load(data / "sensor.yaml")
    errors: dict[str, list[NDArray[np.float64]]] = {}
    lost: dict[str, int] = {}
    for name in FRAMES:
        frame = cv2.imread(str(data / "still" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        truth = np.load(data / "still" / f"{name}.npz")
        for encoding, image in as_sent(np.asarray(frame, np.uint8)).items():
            for view, geometry in build_views(sensor).items():
                grid = GridTracker(sensor, view=view).track(split_frame(image, geometry.placement))
                found = geometry.placement.to_frame(grid.corners)
                error = found - truth[f"corners_{view}_px"]
                seen = np.isfinite(error).all(axis=-1)
                errors.setdefault(encoding, []).append(error[seen])
                lost[encoding] = lost.get(encoding, 0) + int((~seen).sum())
    print("| encoding | corner RMS, px | lost corners |\n|---|---|---|")
    for encoding, parts in errors.items():
        rms = np.sqrt((np.concatenate(parts) ** 2).sum(axis=-1).mean())
        print(f"| {encoding} | {rms:.4f} | {lost[encoding]} |")


if __name__ == "__main__":
    main()
