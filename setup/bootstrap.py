#!/usr/bin/env python3
"""Makes a checkout ready to use: ROS 2 (from wheels where none is sourced) and a built workspace.

Run it as often as you like: it does what is missing or has changed, and nothing else.
"""

import sys

# This file alone is read by every Python, so that an old one gets an answer and not a traceback.
if sys.version_info < (3, 8):
    sys.exit(
        "set-up: Python %d.%d is too old: install one of Python 3.10 to 3.14 and name it, for "
        "example 'make build PYTHON=python3.12'" % sys.version_info[:2]
    )

from cmp_tactile_setup.checkout import main

if __name__ == "__main__":
    sys.exit(main(__file__))
