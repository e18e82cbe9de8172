"""The page in the browser, on viser: scene, camera image, plots, health, buttons.

In: snapshots and health lines of a source.
Out: a page that any number of browsers may look at, and what was pressed on it.
"""
