"""Print sheets as files.

In: sheets of `cmp_tactile_processing.printing`.
Out: PDF, SVG and DXF, and facts about the print.
"""
