"""Experiments that take no time, for the tests of what runs them."""

import base64
import os
import signal
import sys
import time

from paper.blocks import Claim, Deviation, Figure, Report, Table, Text
from paper.experiment import Case, Experiment, number

# A test that waits for nothing ends, s.
LONGEST = 30.0
# One grey pixel.
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNoAAAAggCBd81ytgAAAABJRU5ErkJggg=="
)


def half(place, value):
    """A result; each call leaves a line."""
    with (place.folder / "calls").open("a") as calls:
        calls.write(f"half {value}\n")
    return {"half": value / 2, "threads": os.environ["NUMBA_NUM_THREADS"]}


def fails(place):
    """No result."""
    msg = "no <luck> | here"
    raise RuntimeError(msg)


def dies(place):
    """As where memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def lasts(place):
    """Until it is ended, or the file `go_on` is there."""
    (place.folder / "lasts").touch()
    end = time.monotonic() + LONGEST
    while not (place.folder / "go_on").exists() and time.monotonic() < end:
        time.sleep(0.02)
    return {"half": 0.5}


def report(results, folder):
    """The sum of all halves."""
    total = sum(number(arrays, "half") for arrays in results.values())
    path = folder / "pixel.png"
    path.write_bytes(PNG)
    return Report(
        (
            Text("Halves of `a|b` & <c>."),
            Table(("a|b", "c"), (("x|y", "<z>"),)),
            Figure(path, "A pixel: that's all."),
        ),
        (Claim("IX", "halves | sum", "2", f"{total:g}", met=total == 2),),
        (Deviation("material", "steel", "<none>", "it is a test"),),
    )


def report_fails(results, folder):
    """No report."""
    msg = "no figure"
    raise ValueError(msg)


def good_cases(place):
    """Two, which make 2 in the full run."""
    return [Case("one", half, (1,)), Case("rest", half, (0 if place.fast else 3,))]


def bad_cases(place):
    """Beside one that ends well."""
    return [Case("one", half, (1,)), Case("bad", fails)]


def dying_cases(place):
    """The first takes its process with it."""
    return [Case("dies", dies, seconds=100.0), Case("one", half, (1,))]


def lasting_cases(place):
    """One is done when the other has begun."""
    return [Case("lasts", lasts, seconds=1.0), Case("one", half, (1,), seconds=100.0)]


GOOD = Experiment("good", "IX.A", "Halves & wholes", good_cases, report)
BAD = Experiment("bad", "IX.B", "Bad luck", bad_cases, report)
DYING = Experiment("dying", "IX.C", "Killed", dying_cases, report)
LASTING = Experiment("lasting", "IX.D", "Lasting", lasting_cases, report)
SPEECHLESS = Experiment("speechless", "", "No report", good_cases, report_fails)


def answer(value):
    """A task."""
    return value


def span(seconds):
    """When it began and ended, s."""
    began = time.monotonic()
    time.sleep(seconds)
    return began, time.monotonic()


def threads():
    """How many threads the libraries in the process may use."""
    import cv2

    return os.environ["OPENBLAS_NUM_THREADS"], cv2.getNumThreads()


def command():
    """What `python3 -m paper` does, with these experiments."""
    import paper.runner
    from paper.__main__ import main

    # There is nothing to compile.
    paper.runner.compile_ahead = lambda _: ""
    experiments = {each.key: each for each in (GOOD, BAD, DYING, LASTING)}
    return main(sys.argv[2:], [experiments[key] for key in sys.argv[1].split(",")])


if __name__ == "__main__":
    import paper_trial

    sys.exit(paper_trial.command())
