"""The tables of speed in the documents, from what the benchmarks wrote.

`python3 test/plugins/speed_tables.py` prints them, to be put into the documents.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
# Names of inputs in tables, by that in the results; the wide grasp lies beside a checkout.
INPUTS = {
    "grasp": "`grasp`",
    "slip": "`slip`",
    "data/grasp": "wide grasp",
    "plate:20x20": "plate, 10 N",
    "plate:36x36": "plate, 36 x 36",
}
LIVE = {
    "one_30": ("one sensor", "30"),
    "one_60": ("one sensor", "60"),
    "one_100": ("one sensor", "100"),
    "overload": ("one sensor", "200"),
    "two_30": ("two sensors, a container each", "30 each"),
    "two_60": ("two sensors, a container each", "60 each"),
}
PEER = "OpenCV classic + cornerSubPix, both views"
FRAME = "processor time of a frame to force and slip"
ONE_VIEW = "tracked, followed, one view"
OFFLINE = {
    PEER: PEER,
    "`Pipeline.process`, in contact": f"{FRAME}, in contact",
    "`Pipeline.process`, without contact": f"{FRAME}, without contact",
    "OpenCV classic + cornerSubPix, one view": "OpenCV classic + cornerSubPix, one view",
    "one view tracked, followed": "tracked, followed, one view",
    "one view tracked, from scratch": "tracked, from scratch, one view",
    "triangulation with covariance": "triangulation with covariance",
    "force and slip of a held contact": "force and slip of a held contact",
    "force and slip of a changing contact": "force and slip of a changing contact",
}
# Above this OpenCV's detector did not find the board: a ratio over its search would say nothing.
FOUND_MS = 50.0

Results = Mapping[str, Mapping[str, Mapping[str, Any]]]


def read(name: str) -> Results:
    """A file of results, by input."""
    found: Results = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return found


def line(cells: Sequence[str]) -> str:
    """A row of a table."""
    return f"| {' | '.join(cells)} |"


def offline_rows(results: Results) -> list[str]:
    """Median / 99 %, ms, and the median divided by that of OpenCV's detector, by input."""
    inputs = [name for name in INPUTS if name in results]
    rows = [line(["", *(INPUTS[name] for name in inputs)]), line(["---"] * (len(inputs) + 1))]
    for label, row in OFFLINE.items():
        cells = []
        for name in inputs:
            found = results[name][row]
            cell = f"{found['median_ms']:.1f} / {found['p99_ms']:.1f}"
            ratio = results[name][PEER]["median_ms"] < FOUND_MS
            cells.append(f"{cell} ({found['ratio']:.2f})" if ratio else cell)
        rows.append(line([label, *cells]))
    return rows


def live_rows(results: Results) -> list[str]:
    """Wrenches of live sensors, by rate."""
    rows = []
    for key, (sensors, asked) in LIVE.items():
        found = results["grasp"][key]
        cells = [sensors, asked, f"{found['rate_hz']:.0f}"]
        cells += [f"{found['lost']} of {found['sent']}", f"{found['median_ms']:.0f}"]
        cells += [f"{found['p99_ms']:.0f}", f"{found['cores']:.2f}", f"{found['memory_mb']:.0f}"]
        rows.append(line(cells))
    return rows


def busy_rows(results: Results) -> list[str]:
    """One and two sensors at 60 Hz each: Hz, frames passed over, median / 99 %, ms, by input."""
    inputs = [name for name in INPUTS if name in results]
    rows = [line(["", *(INPUTS[name] for name in inputs)]), line(["---"] * (len(inputs) + 1))]
    for key, label in (("one_60", "one sensor at 60 Hz"), ("two_60", "two sensors at 60 Hz each")):
        cells = [
            f"{found['rate_hz']:.0f}; {found['lost']} of {found['sent']}; "
            f"{found['median_ms']:.0f} / {found['p99_ms']:.0f}"
            for found in (results[name][key] for name in inputs)
        ]
        rows.append(line([label, *cells]))
    return rows


def summary_rows(offline: Results, live: Results) -> list[str]:
    """The rows of README and docs/figures.md."""
    chosen = ("grasp", "data/grasp", "plate:20x20")
    ratios = ", ".join(f"{offline[name][f'{FRAME}, in contact']['ratio']:.1f}" for name in chosen)
    peer = offline["grasp"][PEER]["median_ms"]
    inputs = ", ".join(INPUTS[name] for name in chosen)
    what = f"{FRAME} in contact, divided by that of OpenCV's detector on both views ({inputs})"
    one, two = live["grasp"]["one_60"], live["grasp"]["two_60"]
    times = [f"{item['median_ms']:.0f} and {item['p99_ms']:.0f} ms" for item in (one, two)]
    beside = f"OpenCV's detector: {live['grasp']['beside']['opencv_ms']:.0f} ms a frame"
    live_one = f"one live sensor at 60 Hz on 2 cores ({beside}): wrenches, latency median and 99 %"
    live_two = "two live sensors at 60 Hz on the same"
    tracked = ", ".join(f"{offline[name][ONE_VIEW]['ratio']:.2f}" for name in chosen)
    wide = offline["data/grasp"]
    held, changing = (
        wide[f"force and slip of a {kind} contact"]["median_ms"] for kind in ("held", "changing")
    )
    start, compiling = live["grasp"]["start_warm"], offline["compiling"]
    return [
        line([what, f"{ratios} (OpenCV: {peer:.1f} ms)"]),
        line(
            ["tracking of one view, divided by OpenCV's detector on it (the same inputs)", tracked]
        ),
        line(
            [
                "force and slip, wide grasp: held contact, changing contact",
                f"{held:.1f}, {changing:.1f} ms (OpenCV: {wide[PEER]['median_ms']:.1f} ms)",
            ]
        ),
        line([live_one, f"{one['rate_hz']:.0f} Hz; {times[0]}"]),
        line([live_two, f"{two['rate_hz']:.0f} Hz each; {times[1]}"]),
        line(["time from the start to the first wrench", f"{start['first_wrench_s']:.1f} s"]),
        line(["compiling, once, on one core", f"{compiling['compiling_s']:.0f} s"]),
    ]


if __name__ == "__main__":
    OFFLINE_RESULTS, LIVE_RESULTS = read("pipeline_speed"), read("real_time")
    for table in (
        summary_rows(OFFLINE_RESULTS, LIVE_RESULTS),
        live_rows(LIVE_RESULTS),
        busy_rows(LIVE_RESULTS),
        offline_rows(OFFLINE_RESULTS),
    ):
        sys.stdout.write("\n".join(table) + "\n\n")
