"""The node that serves the page for sensors that run.

In: topics and services of one or two sensors.
Out: a page in the browser.
"""
