#!/usr/bin/env python3
"""Write the layouts of Foxglove for the topics of one sensor and of two fingers.

pip install foxglove-sdk, then: python3 docs/foxglove_layouts.py cmp_tactile_bringup/foxglove

The classes of the SDK are the documented options of panels: a wrong one is an error here.  They are
written in the form that the program exports, which Lichtblick reads, too.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from foxglove.layouts import (
    BaseRendererPointCloudTopicSettings,
    BaseRendererRosMarkerTopicSettings,
    DiagnosticsSummaryConfig,
    DiagnosticsSummaryPanel,
    ImageConfig,
    ImageModeConfig,
    ImagePanel,
    Layout,
    Panel,
    PlotConfig,
    PlotPanel,
    PlotSeries,
    SplitContainer,
    SplitItem,
    ThreeDeeCameraState,
    ThreeDeeConfig,
    ThreeDeePanel,
)

# Of the page in the browser: to be told apart by the colour-blind, too.
COLOURS = {"x": "#0072b2", "y": "#e69f00", "z": "#009e73"}
# In exported layouts, where they differ.
PANEL_NAMES = {"ThreeDee": "3D", "DiagnosticsSummary": "DiagnosticSummary"}
SLIP_COLOUR, TRACTION_COLOUR = "#d55e00", "#cc79a7"


def scene(sensors: list[str], frame: str) -> ThreeDeePanel:
    """Surface, forces and contacts of sensors, in a frame."""
    topics = {
        f"/{name}/markers": BaseRendererRosMarkerTopicSettings(visible=True) for name in sensors
    }
    clouds = {
        f"/{name}/surface_points": BaseRendererPointCloudTopicSettings(visible=False)
        for name in sensors
    }
    camera = ThreeDeeCameraState(
        distance=0.045 * len(sensors),
        perspective=True,
        phi=50.0,
        theta_offset=20.0,
        target_offset=(0.0, 0.0, 0.0),
        near=0.001,
        far=10.0,
    )
    config = ThreeDeeConfig(
        follow_tf=frame, follow_mode="follow-pose", camera_state=camera, topics={**topics, **clouds}
    )
    return ThreeDeePanel(config=config, title="Surface, force and contacts")


def picture(sensor: str, topic: str) -> ImagePanel:
    """One image topic."""
    mode = ImageModeConfig(image_topic=f"/{sensor}/{topic}")
    return ImagePanel(config=ImageConfig(image_mode=mode), title=f"{sensor}: {topic}")


def plot(title: str, unit: str, series: list[tuple[str, str, str]]) -> PlotPanel:
    """Values over the time of their frames: path, label and colour of each."""
    paths = [
        PlotSeries(
            value=path, label=label, color=colour, enabled=True, timestamp_method="headerStamp"
        )
        for path, label, colour in series
    ]
    config = PlotConfig(
        paths=paths, show_legend=True, y_axis_label=unit, is_synced=True, following_view_width=20.0
    )
    return PlotPanel(config=config, title=title)


def force(sensor: str) -> PlotPanel:
    """The resultant."""
    axes = [(f"/{sensor}/wrench.wrench.force.{k}", f"F{k}", COLOURS[k]) for k in "xyz"]
    return plot(f"{sensor}: force", "N", axes)


def slip(sensor: str) -> PlotPanel:
    """How much of the contact slides, and which friction is used."""
    field = f"/{sensor}/force_field"
    shares = [
        (f"{field}.slip_ratio", "slip ratio", SLIP_COLOUR),
        (f"{field}.traction_ratio", "traction ratio", TRACTION_COLOUR),
    ]
    return plot(f"{sensor}: slip", "", shares)


def column(*panels: Panel) -> SplitContainer:
    """Panels below one another."""
    return SplitContainer(direction="column", items=[SplitItem(content=item) for item in panels])


def content(sensors: list[str], frame: str) -> SplitContainer:
    """The scene on the left, images, plots and health on the right."""
    health = DiagnosticsSummaryPanel(
        config=DiagnosticsSummaryConfig(
            topic_to_render="/diagnostics", min_level=0, sort_by_level=True
        ),
        title="Health",
    )
    if len(sensors) == 1:
        (name,) = sensors
        images = SplitContainer(
            direction="row",
            items=[
                SplitItem(content=picture(name, f"{view}/grid_overlay"))
                for view in ("left", "right")
            ],
        )
        columns = [column(scene(sensors, frame), images), column(force(name), slip(name), health)]
    else:
        beside = [column(picture(name, "image_raw"), force(name), slip(name)) for name in sensors]
        columns = [column(scene(sensors, frame), health), *beside]
    shares = [2.0, *(1.0 for _ in columns[1:])]
    items = [
        SplitItem(proportion=share, content=item)
        for share, item in zip(shares, columns, strict=True)
    ]
    return SplitContainer(direction="row", items=items)


def exported(content: dict[str, Any]) -> dict[str, Any]:
    """A layout as the program exports it: options by panel, and the panels in halves of halves."""
    options: dict[str, Any] = {}

    def place(item: dict[str, Any]) -> Any:
        if item["type"] == "panel":
            name = f"{PANEL_NAMES.get(item['panelType'], item['panelType'])}!{len(options)}"
            options[name] = {**item["config"], "foxglovePanelTitle": item["title"]}
            return name
        return halves(item["direction"], item["items"])

    def halves(direction: str, items: list[dict[str, Any]]) -> Any:
        first, *others = items
        if not others:
            return place(first["content"])
        share = first["proportion"] / sum(item["proportion"] for item in items)
        return {
            "first": place(first["content"]),
            "second": halves(direction, others),
            "direction": direction,
            "splitPercentage": round(100 * share, 1),
        }

    placed = place(content)
    return {
        "configById": options,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": placed,
    }


def main() -> None:
    """Write both."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    made = {
        "cmp_tactile": content(["sample_rig"], "sample_rig_gel_frame"),
        "gripper": content(["left_finger", "right_finger"], "gripper"),
    }
    for name, item in made.items():
        found = exported(json.loads(Layout(content=item).to_json())["content"])
        (folder / f"{name}.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
