"""A peer in a process of its own, which is ended when it takes too long."""

from __future__ import annotations

import multiprocessing
from multiprocessing.connection import Connection
from time import perf_counter
from typing import Any

import cv2
from extraction_detectors import Detection, Image, peers

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.sensor.description import SensorDescription

START_LIMIT_S = 60.0


def _work(connection: Connection, name: str) -> None:
    cv2.setNumThreads(1)
    peer = next(peer for peer in peers() if peer.name == name)
    connection.send(None)
    while True:
        connection.send(peer.detect(*connection.recv()))


class PeerProcess:
    """A detector like its peer, but of which no call takes longer than limit_s."""

    def __init__(self, peer: Any, limit_s: float) -> None:
        self.name, self.version, self.able = peer.name, peer.version, peer.able
        self._limit_s = limit_s
        self._process: Any = None
        self._connection: Any = None

    def detect(self, sensor: SensorDescription, view: str, image: Image, truth: Grid) -> Detection:
        """What the peer finds; nothing where it takes too long."""
        if self._process is None:
            self._start()
        began = perf_counter()
        self._connection.send((sensor, view, image, truth))
        if self._connection.poll(self._limit_s):
            detection: Detection = self._connection.recv()
            return detection
        self.stop()
        missing = Grid.missing(sensor.pattern.shape, "took too long", truth.placement)
        return Detection(missing, perf_counter() - began)

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, self.name), daemon=True)
        self._process.start()
        if not self._connection.poll(START_LIMIT_S):
            self.stop()
            msg = f"{self.name}: its process did not start within {START_LIMIT_S:g} s"
            raise TimeoutError(msg)
        self._connection.recv()
