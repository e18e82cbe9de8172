"""The machine: what is in /dev and /sys, and the system calls that reach a camera."""

import errno
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import linuxpy.io
import linuxpy.ioctl

from cmp_tactile_driver.v4l2 import devices as v4l2_devices

from .camera import FakeCamera, fail
from .ioctls import HANDLERS, IOC


class FakeKernel:
    """The machine: a folder /dev, a folder /sys, and cameras that are plugged in."""

    def __init__(self, root: Path) -> None:
        self.dev, self.sys = root / "dev", root / "sys" / "class" / "video4linux"
        self.usb = root / "sys" / "devices" / "usb1"
        for folder in (self.dev / "v4l/by-id", self.dev / "v4l/by-path", self.sys, self.usb):
            folder.mkdir(parents=True)
        self.cameras: dict[str, FakeCamera] = {}

    def install(self, monkeypatch: Any) -> None:
        monkeypatch.setattr(v4l2_devices, "DEV", self.dev)
        monkeypatch.setattr(v4l2_devices, "SYS", self.sys)
        real_open = linuxpy.io.IO.open

        def opener(path: Path, *args: Any, **kwargs: Any) -> Any:
            camera = self.cameras.get(Path(path).name)
            if camera is not None and camera.openable:
                raise fail(camera.openable)
            return real_open(path, *args, **kwargs)

        monkeypatch.setattr(linuxpy.io.IO, "open", opener)
        monkeypatch.setattr(linuxpy.io.IO, "select", SimpleNamespace(select=self.select))
        monkeypatch.setattr(linuxpy.ioctl, "fcntl", SimpleNamespace(ioctl=self.ioctl))

    def plug(self, camera: FakeCamera, number: int = 0, port: str = "1-2") -> Path:
        """The camera appears as /dev/videoN, with the files of a USB device in /sys."""
        node = self.dev / f"video{number}"
        node.touch()
        device = self.usb / port
        interface = device / f"{port}:1.0"
        entry = interface / "video4linux" / node.name
        entry.mkdir(parents=True, exist_ok=True)
        (device / "idVendor").write_text("1bcf\n")
        if camera.serial:
            (device / "serial").write_text(camera.serial + "\n")
        (entry / "name").write_text("Tactile: Camera\n")
        (entry / "index").write_text("0\n")
        (entry / "device").symlink_to(interface)
        (self.sys / node.name).symlink_to(entry)
        for kind, name in (("by-id", f"usb-Tactile_{camera.serial}"), ("by-path", f"usb-{port}")):
            link = self.dev / "v4l" / kind / f"{name}-video-index0"
            link.unlink(missing_ok=True)  # of two devices of one serial the last has the link
            link.symlink_to(node)
        camera.node = node
        self.cameras[node.name] = camera
        return node

    def unplug(self, camera: FakeCamera) -> None:
        """The node and its links vanish; who has it open gets ENODEV."""
        assert camera.node is not None
        with camera.changed:
            node = camera.node
            del self.cameras[node.name]
            links = [*self.dev.glob("v4l/*/*")]
            for path in [link for link in links if link.resolve() == node]:
                path.unlink()
            entry = (self.sys / node.name).resolve()
            (self.sys / node.name).unlink()
            for path in (entry / "device", entry / "name", entry / "index"):
                path.unlink()
            (entry.parents[2] / "serial").unlink(missing_ok=True)
            node.unlink()
            camera.unplug_state()
            camera.changed.notify_all()

    def select(self, readers: Any, _writers: Any, _errors: Any, timeout: float) -> Any:
        (reader,) = readers
        camera = self._camera(reader.fileno())
        if camera is None:
            return readers, (), ()
        with camera.changed:
            camera.changed.wait_for(lambda: camera.done or camera.node is None, timeout)
            # An error is what a device is ready for, too.
            ready = camera.done or camera.node is None or IOC.DQBUF in camera.fault
            return (readers if ready else ()), (), ()

    def _camera(self, number: int) -> FakeCamera | None:
        path = str(Path(f"/proc/self/fd/{number}").readlink())
        return self.cameras.get(Path(path).name) if "(deleted)" not in path else None

    def ioctl(self, device: Any, request: int, argument: Any) -> int:
        number = device.fileno()
        camera = self._camera(number)
        if camera is None:
            raise fail(errno.ENODEV)
        with camera.changed:
            if request in camera.fault:
                raise fail(camera.fault[request])
            handler = HANDLERS.get(request)
            if handler is None:
                raise fail(errno.ENOTTY)
            handler(camera, argument, number)
        return 0
