"""Starts a module of this software in another Python process."""

from __future__ import annotations

import sys

# For Python 3.10, which has no option -P.  Only sys, which is built in, is imported before the
# current folder is taken off the path.  Python 3.13 imports more before it runs such a line.
RUN_MODULE = (
    "import sys; sys.path[:] = filter(None, sys.path); import runpy; "
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
)


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as `python -m` does, without the current folder's modules.

    `python -m` looks for every module in the current folder first: a numpy.py beside a downloaded
    recording would be run.  Option -I would ignore PYTHONPATH, too, by which ROS is found.
    """
    run = ["-P", "-m"] if sys.version_info >= (3, 11) else ["-c", RUN_MODULE]
    return [sys.executable, *run, module, *arguments]
