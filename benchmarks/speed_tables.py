"""Make the tables of speed.md beside this script, from what the benchmarks of speed have written.

The rows of README are printed.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tables import head, line

from cmp_tactile_processing.sensor.parameter_table import with_generated_section

FOLDER = Path(__file__).resolve().parent
RESULTS, PAGE = FOLDER / "results", FOLDER / "speed.md"
MARKER = "<!-- made by benchmarks/speed_tables.py from here on -->"
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


def offline_rows(results: Results) -> list[str]:
    """Median / 99 %, ms, and the median divided by that of OpenCV's detector, by input."""
    inputs = [name for name in INPUTS if name in results]
    rows = [head("", *(INPUTS[name] for name in inputs))]
    for label, row in OFFLINE.items():
        cells = []
        for name in inputs:
            found = results[name][row]
            cell = f"{found['median_ms']:.1f} / {found['p99_ms']:.1f}"
            ratio = results[name][PEER]["median_ms"] < FOUND_MS
            cells.append(f"{cell} ({found['ratio']:.2f})" if ratio else cell)
        rows.append(line(label, *cells))
    return rows


def live_rows(results: Results) -> list[str]:
    """Wrenches of live sensors that replay `grasp`, by rate."""
    rows = [
        head("", "Hz asked", "Hz", "passed over", "median ms", "p99 ms", "processors", "MB each")
    ]
    for key, (sensors, asked) in LIVE.items():
        found = results["grasp"][key]
        cells = [sensors, asked, f"{found['rate_hz']:.0f}"]
        cells += [f"{found['lost']} of {found['sent']}", f"{found['median_ms']:.0f}"]
        cells += [f"{found['p99_ms']:.0f}", f"{found['cores']:.2f}", f"{found['memory_mb']:.0f}"]
        rows.append(line(*cells))
    return rows


def busy_rows(results: Results) -> list[str]:
    """One and two sensors at 60 Hz each: Hz, frames passed over, median / 99 %, ms, by input."""
    inputs = [name for name in INPUTS if name in results]
    rows = [head("", *(INPUTS[name] for name in inputs))]
    for key, label in (("one_60", "one sensor at 60 Hz"), ("two_60", "two sensors at 60 Hz each")):
        cells = [
            f"{found['rate_hz']:.0f}; {found['lost']} of {found['sent']}; "
            f"{found['median_ms']:.0f} / {found['p99_ms']:.0f}"
            for found in (results[name][key] for name in inputs)
        ]
        rows.append(line(label, *cells))
    return rows


def start_rows(offline: Results, live: Results) -> list[str]:
    """From the start to the first wrench, and what compiling takes of it once."""
    found, compiling = live["grasp"], offline["compiling"]
    return [
        head("", "s"),
        line("everything in the caches", f"{found['start_warm']['first_wrench_s']:.1f}"),
        line("after `make build`", f"{found['start_built']['first_wrench_s']:.1f}"),
        line("compiling, once, on one core", f"{compiling['compiling_s']:.0f}"),
    ]


def container_rows(live: Results) -> list[str]:
    """Processor time of a frame in a container, and in `Pipeline` alone."""
    found = live["grasp"]
    return [
        head("at 30 Hz", "processor time of a frame, ms"),
        line("a container, with camera and subscriber", f"{found['one_30']['frame_ms']:.1f}"),
        line("`Pipeline.process`", f"{found['beside']['pipeline_ms']:.1f}"),
        line("OpenCV classic + cornerSubPix", f"{found['beside']['opencv_ms']:.1f}"),
    ]


def summary_rows(offline: Results, live: Results) -> list[str]:
    """The rows of README."""
    chosen = ("grasp", "data/grasp", "plate:20x20")
    ratios = ", ".join(f"{offline[name][f'{FRAME}, in contact']['ratio']:.1f}" for name in chosen)
    inputs = ", ".join(INPUTS[name] for name in chosen)
    what = f"{FRAME} in contact, divided by that of OpenCV's detector on both views ({inputs})"
    one, two = live["grasp"]["one_60"], live["grasp"]["two_60"]
    times = [f"{item['median_ms']:.0f} and {item['p99_ms']:.0f} ms" for item in (one, two)]
    live_one = "one live sensor at 60 Hz on 2 cores: wrenches, latency median and 99 %"
    return [
        line(what, ratios),
        line(live_one, f"{one['rate_hz']:.0f} Hz; {times[0]}"),
        line("two live sensors at 60 Hz on the same", f"{two['rate_hz']:.0f} Hz each; {times[1]}"),
    ]


def page() -> str:
    """The text of speed.md with its tables made again."""
    offline, live = read("pipeline_speed"), read("real_time")
    tables = {
        "One process without ROS": offline_rows(offline),
        "Live sensors": live_rows(live),
        "Other inputs, live": busy_rows(live),
        "What the container adds": container_rows(live),
        "From the start to the first wrench": start_rows(offline, live),
    }
    parts = ("\n".join((f"## {title}\n", *rows)) for title, rows in tables.items())
    return with_generated_section(PAGE, MARKER, "\n\n".join(parts) + "\n")


def measure() -> None:
    """Run the benchmarks of speed; what they keep is in `results`."""
    for script, *options in (["pipeline_speed.py", "--compile"], ["ros/real_time.py"]):
        kept = RESULTS / Path(script).with_suffix(".json").name
        words = [sys.executable, str(FOLDER / script), *options, "--json", str(kept)]
        subprocess.run(words, check=True)


def main() -> None:
    """Measure if asked to, renew the page, and print the rows of README."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--measure", action="store_true", help="run the benchmarks first, on an idle machine"
    )
    if parser.parse_args().measure:
        measure()
    PAGE.write_text(page(), encoding="utf-8")
    print("\n".join(summary_rows(read("pipeline_speed"), read("real_time"))))


if __name__ == "__main__":
    main()
