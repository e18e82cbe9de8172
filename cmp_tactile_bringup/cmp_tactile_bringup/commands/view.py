"""`cmp_tactile view`: a recording or results in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Command, Number, argument, option
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    from cmp_tactile_viewer.page.page import Page
    from cmp_tactile_viewer.page.server import Access
    from cmp_tactile_viewer.snapshot import Source

_page = partial(option, group="Page")


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Show a recording in a browser: the gel's surface with forces and contacts in 3-D, the camera
    image with gridlines, plots of forces and slip, and warnings. A slider selects the frame.
    Camera frames are processed when they are shown; stored results of `cmp_tactile process` or of
    a recorded sensor are shown as they are. Ctrl-C ends it. Needs no running ROS and no internet.

    To show a running sensor, give view:=true to a launch file or to a command that starts nodes.
    """

    source: Annotated[
        Path,
        argument(
            "SOURCE",
            "a ROS 2 bag, results of `cmp_tactile process`, a folder of images, one image, a "
            "video, or a packaged scene, such as grasp",
        ),
    ]
    sensor: Annotated[
        list[str] | None,
        option(
            "sensor description: a file or a packaged name; not needed for a packaged scene, for "
            "results, or with descriptions in the recording's folder: sensor.yaml, or NAME.yaml of "
            "each sensor; may be repeated for a bag of several sensors",
            metavar="SENSOR",
        ),
    ] = None
    topic: Annotated[
        str,
        option(
            "image topic, if the bag has several; LEFT,RIGHT for two cameras: topics, or "
            "recordings in the folder"
        ),
    ] = ""
    paused: Annotated[bool, option("begin paused, at the first frame")] = False
    host: Annotated[str, _page("address to listen on; 0.0.0.0 for the whole network")] = "127.0.0.1"
    port: Annotated[
        int | None,
        _page(
            "port to listen on (default: the first free one from 8080)", Number(1, 65535, kind=int)
        ),
    ] = None
    token: Annotated[str, _page("secret word in the address; keeps others on the network out")] = ""
    read_only: Annotated[bool, _page("page without buttons and parameters")] = False
    allow_host: Annotated[
        list[str] | None,
        _page(
            "another name of this machine or of a proxy in browsers, as robot.lab.example; may "
            "be repeated",
            metavar="NAME",
        ),
    ] = None
    open: Annotated[bool, _page("open the page in this machine's browser")] = False

    def run(self) -> int:
        """Serve the page until a signal comes."""
        from cmp_tactile_bringup.recordings.library import (
            check_source,
            is_packaged,
            recorded_source,
            required_sensors,
        )
        from cmp_tactile_bringup.terminal import shown_stages
        from cmp_tactile_processing.sensor.description import load_sensor

        check_source(self.source)
        files = self.sensor or required_sensors(self.source)
        sensors = [load_sensor(file) for file in files]
        path = expanded_path(self.source)
        if is_packaged(self.source):
            with shown_stages() as on_stage:
                path = recorded_source(self.source, on_stage)
        from cmp_tactile_viewer.page.server import Access
        from cmp_tactile_viewer.recording import open_source

        source = open_source(path, *sensors, topic=self.topic)
        source.playback.playing = not self.paused
        access = Access(
            self.host, self.port, self.token, self.read_only, tuple(self.allow_host or ())
        )
        return serve(source, access, open_browser=self.open)


def serve(source: Source, access: Access, *, open_browser: bool = False) -> int:
    """Serve a page until SIGINT or SIGTERM, and say where; raises CmpTactileError."""
    from cmp_tactile_processing.processes import StopSignal
    from cmp_tactile_viewer.page.page import Page

    stop = StopSignal()
    with Page(source, access) as page:
        _say_where(page, access)
        if open_browser:
            import webbrowser

            webbrowser.open(page.url)
        stop.wait()
    return 0


def _say_where(page: Page, access: Access) -> None:
    from cmp_tactile_bringup.terminal import print_findings
    from cmp_tactile_processing.errors import warnings_of

    print(f"Open {page.url} in a browser. Ctrl-C ends it.", flush=True)
    if not access.is_local and not access.read_only:
        who = "anyone who has this address" if access.token else "anyone on that network"
        text = (
            f"listening on {access.host}, port {page.port}: {who} can press the buttons; "
            "--read-only removes them" + ("" if access.token else ", --token sets a secret word")
        )
        print_findings(warnings_of(text))
