"""`cmp_tactile info`: a sensor's description, what follows from it, and the installation."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["add_parser", "run"]


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "info",
        parents=[common],
        help="show a sensor and the installation",
        description="Show a sensor's description, the geometry that follows from it, the sensors "
        "that come with the package, and the versions of what is installed.",
    )
    parser.add_argument(
        "sensor",
        nargs="?",
        help="file of a sensor description or name of a packaged one (default: prototype)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the tables."""

    from cmp_tactile_bringup.report.sensor_facts import description_facts, geometry_facts
    from cmp_tactile_bringup.terminal.machine import machine_facts, ros_facts
    from cmp_tactile_bringup.terminal.tables import facts_table, output_console
    from cmp_tactile_processing.sensor.library import (
        DEFAULT_SENSOR,
        find_sensor_description,
        load_sensor,
        packaged_sensors,
    )

    name = arguments.sensor or DEFAULT_SENSOR
    sensor = load_sensor(name)
    facts = {"File": str(find_sensor_description(name)), **description_facts(sensor)}
    console = output_console()
    console.print(facts_table(f"Sensor {sensor.name}", facts))
    console.print(facts_table("What follows from it", geometry_facts(sensor)))
    packaged = {key: str(path) for key, path in packaged_sensors().items()}
    console.print(facts_table("Packaged sensors", packaged))
    console.print(facts_table("Installation", {**machine_facts(), **ros_facts()}))
    return 0
