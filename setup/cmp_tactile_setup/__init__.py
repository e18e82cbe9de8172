"""Set-up of a checkout: ROS 2 from wheels where there is none, then the build of the packages.

Standard library only: this runs before anything is installed.
"""
