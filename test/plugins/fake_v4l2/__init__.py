"""A V4L2 capture device that is not there: what the kernel does, below linuxpy.

Devices are regular files below a folder that stands for /dev; their buffers are mapped from them
for real.  `fcntl.ioctl`, `open` and `select` of linuxpy are answered here, from and into the
structures of the kernel.  Nothing of linuxpy itself is replaced.
"""

from .camera import FakeCamera, webcam_controls
from .kernel import FakeKernel

__all__ = ["FakeCamera", "FakeKernel", "webcam_controls"]
