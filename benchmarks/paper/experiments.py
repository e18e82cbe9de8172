"""All experiments, in the order of the page."""

from __future__ import annotations

from paper import (
    balls_report,
    density_report,
    grasp_report,
    objects_report,
    precision_report,
    probe_report,
    reliability_report,
    resolution_report,
    speed_report,
)
from paper.experiment import Experiment

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: tuple[Experiment, ...] = (
    objects_report.EXPERIMENT,
    precision_report.EXPERIMENT,
    resolution_report.EXPERIMENT,
    reliability_report.EXPERIMENT,
    speed_report.EXPERIMENT,
    balls_report.EXPERIMENT,
    probe_report.EXPERIMENT,
    grasp_report.EXPERIMENT,
    density_report.EXPERIMENT,
)
