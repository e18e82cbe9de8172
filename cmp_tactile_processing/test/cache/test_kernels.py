"""Compiled functions run where what was compiled cannot be kept."""

from __future__ import annotations

import errno
import os

import numpy as np
from numba.core.caching import IndexDataCacheFile

from cmp_tactile_processing.cache.kernels import kernel


def test_a_kernel_runs_though_the_disk_is_full(monkeypatch, caplog):
    """A full home or quota; a node whose kernel was not compiled yet lost each frame.

    Reports: AcademySoftwareFoundation/rez 2014, GeoscienceAustralia/dea-notebooks 755; tried:
    every command ended with "No space left on device".
    """

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @kernel
    def doubled(values):
        return 2.0 * values

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    for kind in (np.float64, np.float32):
        assert doubled(np.ones(3, kind)).tolist() == [2.0] * 3
    assert caplog.text.count("compiled functions are not kept") == 1
